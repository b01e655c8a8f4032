"""A log in place of the hardware: verified against the drivers, run again, or served as a bench."""
