"""Physics only: NumPy and SciPy, no I/O, no hardware."""
