"""Benchmarks that measure and report: error against run time of the solver, and its behaviour in extreme states."""
