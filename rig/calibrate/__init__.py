"""Guided calibration of the bench's own instruments: what is applied, how it is run, and what its log says."""
