"""The history of a vessel's calibrations in one file."""
