"""How far vertices keep from the borders of their cells, so that sheets in neighbouring cells never touch."""

import numpy as np

from fusion.volume.tsdf_volume import Volume

_ROUNDING = 2.0**-23
"""Of its size: a coordinate is rounded to 24 bits on the lattice, and once more in metres."""
_ROUNDINGS = 4
_LEAST = 1e-4
"""About a step of the distances that packed voxels hold."""
_MOST = 0.1


def inset_for(volume: Volume) -> float:
    """Return how far, in voxels, vertices keep from the border of their cell, face or edge.

    Coordinates are rounded, by the more the farther they are from the world's origin: it is some times as much.
    """
    blocks = volume.table.blocks[: volume.table.count].numpy() if volume.table.count else np.zeros((1, 3), np.int32)
    farthest = 8.0 * (float(np.abs(blocks).max()) + 1.0)
    return float(np.clip(_ROUNDINGS * _ROUNDING * farthest, _LEAST, _MOST))
