"""What the current of the supply says of a film: its permittivity by its capacitance, its leakage."""
