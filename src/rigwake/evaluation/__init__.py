"""Errors against a known truth: trajectories and rigs."""
