"""What stands behind commands that are more than a few lines."""
