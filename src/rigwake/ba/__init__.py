"""Bundle adjustment: the least-squares solver, and the rig problem built on it."""
