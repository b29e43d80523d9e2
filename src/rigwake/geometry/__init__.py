"""Rigid-body and projective geometry: transforms, interpolation, alignment, two views, the Earth."""
