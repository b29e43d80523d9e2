"""The harbour simulator: recordings with known truth."""
