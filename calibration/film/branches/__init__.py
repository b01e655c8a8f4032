"""Films that take time: Maxwell branches identified from the whole history of a run."""
