"""Sheets that take time: relaxation and cyclic tests -> law and Maxwell branches."""
