"""What is in a recording, and whether it is enough to calibrate."""
