"""The nearest already-fused pose: least mean squared error over TSDF surface points, geometry only (section IV-C).

Where the query was taken from a fused frame's pose, its depth points lie on the surface that the volume holds there,
and the field is 0 at each. So every candidate pose puts the query's points into the world and is scored by the mean
squared distance that the field has there; space that nobody saw counts as a whole truncation distance off.
"""

from dataclasses import dataclass

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.devices import launch_in_slabs
from fusion.field import Field, field_of, sample_distance
from fusion.volume import Volume

wp.set_module_options({"enable_backward": False})

QUERY_POINTS = 4000


@dataclass(frozen=True, kw_only=True)
class NearestPose:
    """The best of the candidates: its ``index``, and ``scores`` (candidates,) of all, in m²; less is nearer."""

    index: int
    scores: NDArray[np.float64]


@wp.kernel
def _score_candidates(
    first: int,
    field: Field,
    truncation: float,
    points_camera: wp.array(dtype=wp.vec3),
    world_from_camera: wp.array(dtype=wp.mat44),
    scores: wp.array(dtype=float),
) -> None:
    candidate = wp.tid() + first
    pose = world_from_camera[candidate]
    total = float(0.0)
    for i in range(points_camera.shape[0]):
        distance = truncation * sample_distance(field, wp.transform_point(pose, points_camera[i]))
        total += distance * distance
    scores[candidate] = total / float(points_camera.shape[0])


def surface_points(camera: PinholeCamera, depth: NDArray[np.float32], *, most: int) -> NDArray[np.float64]:
    """Return at most ``most`` points (n, 3), camera frame, of a depth image, spread evenly over its valid pixels."""
    points = camera.back_project(depth)[depth > 0]
    return points[:: max(-(-len(points) // most), 1)]


def find_nearest_pose(
    volume: Volume, camera: PinholeCamera, depth: NDArray[np.float32], candidates: list[Matrix]
) -> NearestPose:
    """Score candidate poses (world_from_camera) for a query's planar depth (height, width), metres.

    Raises InputError where the query has no valid depth.
    """
    points = surface_points(camera, depth, most=QUERY_POINTS)
    if len(points) == 0:
        raise InputError("no pixel has a valid depth, so there is no surface to compare")
    device = volume.device
    scores = wp.empty(len(candidates), dtype=float, device=device)
    launch_in_slabs(
        _score_candidates,
        dim=len(candidates),
        inputs=[
            field_of(volume),
            volume.truncation,
            wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(np.stack(candidates).astype(np.float32), dtype=wp.mat44, device=device),
        ],
        outputs=[scores],
        device=device,
    )
    found = scores.numpy().astype(np.float64)
    return NearestPose(index=int(found.argmin()), scores=found)
