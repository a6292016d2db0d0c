"""Triangle meshes with vertex colours and normals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """A triangle mesh in the world frame.

    ``vertices`` (n, 3) float32 metres; ``triangles`` (m, 3) int32, counter-clockwise seen from outside; ``colors``
    (n, 3) uint8 RGB, sRGB-encoded as in the images, or None; ``normals`` (n, 3) float32 of length 1, pointing outside,
    or None.
    """

    vertices: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None
    normals: NDArray[np.float32] | None = None
