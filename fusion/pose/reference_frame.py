"""The fused frames that lie nearest to a query, as the stages are given them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix


@dataclass(frozen=True, kw_only=True, eq=False)
class ReferenceFrame:
    """A fused frame and its pose.

    ``color`` (height, width, 3) uint8 RGB, ``depth`` (height, width) planar metres, 0 = invalid.
    """

    camera: PinholeCamera
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    world_from_camera: Matrix
