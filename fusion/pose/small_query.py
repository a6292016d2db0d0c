"""A query as small as the views that it is compared with."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.errors import InputError
from fusion.pose.view_index import ViewIndex


@dataclass(frozen=True, kw_only=True, eq=False)
class SmallQuery:
    """A query as small as the index's views: ``depth`` (height, width) planar metres, 0 where there is no surface.

    ``known`` (height, width) is False where the query says nothing: outside a mask, where something else may stand
    before the model. ``points`` (m, 3) are those to align, in the query's frame, ``middle`` (3,) their median, and
    ``typical_depth`` its depth. ``points_there``, ``depth_there`` and ``known_there`` are the same on the index's
    device.
    """

    depth: NDArray[np.float32]
    known: NDArray[np.bool_]
    points: NDArray[np.float64]
    middle: NDArray[np.float64]
    points_there: wp.array
    depth_there: wp.array
    known_there: wp.array

    @property
    def typical_depth(self) -> float:
        """How far away the surface is, metres."""
        return float(self.middle[2])


def small_query(index: ViewIndex, depth: NDArray[np.float32], mask: NDArray[np.bool_] | None) -> SmallQuery:
    """Return a query's depth, and its mask if it has one, (height, width), as small as the index's views.

    Raises InputError where no pixel has a valid depth.
    """
    small = depth[:: index.step, :: index.step].astype(np.float32)
    known = np.ones(small.shape, bool)
    if mask is not None:
        known = mask[:: index.step, :: index.step]
        small = np.where(known, small, np.float32(0))
    points = index.points(small)
    if len(points) == 0:
        where = "" if mask is None else " inside the mask"
        raise InputError(f"no pixel{where} has a valid depth, so there is no surface to compare")
    return SmallQuery(
        depth=small,
        known=known,
        points=points,
        middle=np.median(points, axis=0),
        points_there=wp.array(points.astype(np.float32), dtype=wp.vec3, device=index.device),
        depth_there=wp.array(small, dtype=float, device=index.device),
        known_there=wp.array(known.astype(np.uint8), dtype=wp.uint8, device=index.device),
    )
