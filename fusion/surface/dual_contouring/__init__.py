"""Dual contouring: a vertex within each cell, a quad around each voxel edge that the surface crosses."""
