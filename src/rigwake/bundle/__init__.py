"""Rig bundle adjustment: the rig from all observations at once."""
