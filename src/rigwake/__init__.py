"""rigwake: calibrate a camera rig from the wake it leaves."""

__version__ = "0.1.0"
