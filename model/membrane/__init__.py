"""Membrane."""
