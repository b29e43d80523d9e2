"""Lenses: models to the edge of the image and beyond 90 degrees, and the formats that hold them."""
