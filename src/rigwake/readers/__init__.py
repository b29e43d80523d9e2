"""Readers: every recording and trajectory format, turned into the same values."""
