"""Least squares over trajectory states, landmarks and shared parameters, for one camera or a whole rig."""
