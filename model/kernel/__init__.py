"""The membrane solver in C: how it is built and found. Without it the NumPy code answers."""
