"""Camera models: projection, unprojection and their derivatives."""
