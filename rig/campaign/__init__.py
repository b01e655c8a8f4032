"""Many specimens, one after the other: what is done with which, what has been done, what comes next."""
