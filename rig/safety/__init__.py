"""What keeps the rig safe: limits, and the guard that alone commands high voltage."""
