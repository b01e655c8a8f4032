"""Actuator."""
