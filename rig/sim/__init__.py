"""The simulated bench: specimen physics and one wire-level instrument per driver."""
