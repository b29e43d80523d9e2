"""Feature tracks: observations of the same point over time, as pixels and unit bearings."""
