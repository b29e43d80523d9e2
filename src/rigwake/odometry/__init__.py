"""Odometry: from tracks, inertial and satellite measurements to one trajectory per camera."""
