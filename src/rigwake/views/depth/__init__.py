"""How far away things are: pairs of cameras, a sweep of spheres, and the water plane, fused."""
