"""Hand-eye calibration: the rig from trajectories."""
