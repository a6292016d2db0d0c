"""The other way round: the model's surface, seen from a pose, against the query's depth.

A point of the model that faces the camera is matched where the query measures the same depth, hidden where it measures
something nearer, and missing where it looks through the place. Hidden points say nothing, missing ones speak against
the pose.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from fusion.devices import launch_in_slabs
from fusion.pose.pose_model import PoseModel, poses_on
from fusion.pose.query import Query

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_RUN = 128
_FACING = wp.constant(-0.3)
"""Cosine between ray and normal up to which a surface is seen well enough to be expected in the query."""

MATCHED, HIDDEN, MISSING, UNKNOWN = 0, 1, 2, 3


@dataclass(frozen=True, kw_only=True, eq=False)
class QueryView:
    """A query's depth on a device: ``depth`` (height, width) metres, and ``object_here`` (height, width) 0 or 1."""

    depth: wp.array
    object_here: wp.array
    masked: bool
    intrinsics: wp.vec4


def query_view(query: Query, *, model: PoseModel) -> QueryView:
    """Return a query's depth, of all that it sees, on the model's device."""
    assert query.depth is not None, "a query without depth is not compared by depth"
    depth = np.where(np.isfinite(query.depth) & (query.depth > 0), query.depth, 0).astype(np.float32)
    here = np.ones(depth.shape, np.uint8) if query.mask is None else query.mask.astype(np.uint8)
    camera = query.camera
    return QueryView(
        depth=wp.array(depth, dtype=float, device=model.device),
        object_here=wp.array(here, dtype=wp.uint8, device=model.device),
        masked=query.mask is not None,
        intrinsics=wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
    )


@wp.kernel
def _classify(
    first: int,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    count: int,
    runs: int,
    depth: wp.array2d(dtype=float),
    object_here: wp.array2d(dtype=wp.uint8),
    masked: bool,
    intrinsics: wp.vec4,
    rotations: wp.array(dtype=wp.mat33),
    translations: wp.array(dtype=wp.vec3),
    within: float,
    within_per_square: float,
    counts: wp.array2d(dtype=int),
) -> None:
    index = wp.tid() + first
    pose = index / runs
    run = index % runs
    back = wp.transpose(rotations[pose])
    total = wp.vec4i()
    for i in range(run * _RUN, wp.min(run * _RUN + _RUN, count)):
        ray = points[i] - translations[pose]
        camera = back * ray
        slant = wp.dot(normals[i], ray) / wp.length(ray)
        if camera[2] <= 0.0 or slant > _FACING:
            continue
        u = int(wp.floor(intrinsics[0] * camera[0] / camera[2] + intrinsics[2] + 0.5))
        v = int(wp.floor(intrinsics[1] * camera[1] / camera[2] + intrinsics[3] + 0.5))
        if u < 0 or v < 0 or u >= depth.shape[1] or v >= depth.shape[0]:
            continue
        seen = depth[v, u]
        tolerance = (within + within_per_square * camera[2] * camera[2]) / wp.abs(slant)
        here = object_here[v, u] != wp.uint8(0)
        kind = int(3)
        if seen > 0.0 and seen < camera[2] - tolerance:
            kind = 1
        elif seen > 0.0 and seen <= camera[2] + tolerance:
            kind = wp.where(here, 0, 1)  # a mask cuts off what occludes at the same depth, too
        elif seen > 0.0 or (masked and not here):
            kind = 2
        total[kind] += 1
    for k in range(4):
        counts[index, k] = total[k]


def overlap(
    model: PoseModel,
    view: QueryView,
    poses: NDArray[np.float64],
    *,
    within: float,
    within_per_square: float = 0.0,
    most: int | None = None,
) -> NDArray[np.int64]:
    """Count the model's points that are matched, hidden, missing and unknown at each of ``poses`` (n, 4, 4).

    Depths agree ``within`` + ``within_per_square`` · z² metres, measured across the surface. ``most`` of the points
    are asked, all of them without it. Returns (n, 4).
    """
    count = int(model.surface_points.shape[0])
    count = count if most is None else min(count, most)
    runs = -(-count // _RUN)
    counts = wp.empty((len(poses) * runs, 4), dtype=int, device=model.device)
    launch_in_slabs(
        _classify,
        dim=len(poses) * runs,
        inputs=[
            *(model.surface_points, model.surface_normals, count, runs),
            *(view.depth, view.object_here, view.masked, view.intrinsics),
            *poses_on(model.device, model.local(poses)),
            *(within, within_per_square),
        ],
        outputs=[counts],
        device=model.device,
        least_slab=16,
    )
    return counts.numpy().reshape(len(poses), runs, 4).sum(axis=1, dtype=np.int64)


def agreement(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return matched / (matched + missing) of counts (n, 4); 0 where nothing of the model should be seen."""
    judged = counts[:, MATCHED] + counts[:, MISSING]
    return counts[:, MATCHED] / np.maximum(judged, 1)
