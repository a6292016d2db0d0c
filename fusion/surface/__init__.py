"""From a volume to surfaces: marching cubes, points, ray casting."""
