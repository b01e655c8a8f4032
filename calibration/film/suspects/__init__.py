"""Imperfections that may hide in a fit, one file a family; `calibration.film.suspects.registry` finds them."""
