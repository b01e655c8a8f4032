"""Scenes, protocols, calibrations and recorded logs with known truth; read through importlib.resources."""
