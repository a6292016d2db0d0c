"""Poses about a given one from which a view is refined, where that one alone may be too far off."""

import numpy as np
from numpy.typing import NDArray

from datagen.rigid import Matrix, inverse, transform_points
from fusion.pose.pose_model import PoseModel
from fusion.pose.se3 import perturb

TURN_WITH_DEPTH_DEG, TURN_BY_OUTLINE_DEG = 35.0, 30.0

ALL_TURNS_DEG, TURNS_APART_DEG = 45.0, 30.0
ALL_SHIFTS = 0.12
"""Metres: with these turns, from which as large an error of a camera within a scene comes right."""

_POINTS, _CELLS_ACROSS, _CELLS = 2000, 16, 128
"""The model's points that tell which of it is seen, directions into which it is divided for that, and how many of those
about its middle are told from those beyond."""


def ring_of_turns(turn_deg: float) -> NDArray[np.float64]:
    """Return the twists (13, 6) of no turn, and of turns by an angle about the twelve corners of an icosahedron."""
    golden = (1 + 5**0.5) / 2
    axes = np.array([np.roll((0, a, b * golden), k) for k in range(3) for a in (-1, 1) for b in (-1, 1)], np.float64)
    twists = np.zeros((len(axes) + 1, 6))
    twists[1:, 3:] = np.radians(turn_deg) * axes / np.linalg.norm(axes[0])
    return twists


def starts_about(model: PoseModel, start: Matrix, points_camera: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return the start and poses (n, 4, 4) about it, turned about the model's middle.

    Each is there as it is and shifted so that the model is where the depth is: ``points_camera`` (n, 3) are the
    query's, None where they do not tell, since only a part of the model is in the image.
    """
    if points_camera is None:
        return perturb(ring_of_turns(TURN_WITH_DEPTH_DEG), start, pivot_world=model.centre_world)
    shifted = shifted_onto_depth(model, start[None], points_camera)
    ring = perturb(ring_of_turns(TURN_WITH_DEPTH_DEG), shifted[0], pivot_world=model.centre_world)
    return np.concatenate([start[None], shifted_onto_depth(model, ring, points_camera), ring[1:]])


def starts_all_about(model: PoseModel, start: Matrix, points_camera: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """Return poses (n, 4, 4) that leave no gap about the start, turned by all that is likely.

    Where depth does not tell where the model has to go (see ``starts_about``), they are also shifted to six sides.
    """
    turns = turns_within(ALL_TURNS_DEG, apart_deg=TURNS_APART_DEG)
    if points_camera is not None:
        shifted = shifted_onto_depth(model, start[None], points_camera)[0]
        return shifted_onto_depth(model, perturb(turns, shifted, pivot_world=model.centre_world), points_camera)
    return shifted_to_six_sides(perturb(turns, start, pivot_world=model.centre_world))


def shifted_to_six_sides(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each of the poses (n, 4, 4) as it is and shifted along the world's axes, both ways (7 n, 4, 4)."""
    shifted = np.repeat(poses[:, None], 7, axis=1)
    shifted[:, 1:, :3, 3] += ALL_SHIFTS * np.concatenate([np.eye(3), -np.eye(3)])
    return shifted.reshape(-1, 4, 4)


def turns_within(most_deg: float, *, apart_deg: float) -> NDArray[np.float64]:
    """Return the twists (n, 6) of turns of up to an angle: any such turn is within about half of ``apart_deg`` of one.

    Rotation vectors on a body-centred cubic lattice, which covers space with the fewest balls (Bambah 1954): for
    a cube of side a they have the radius a √5/4.
    """
    side = 4 / 5**0.5 * apart_deg / 2
    steps = np.arange(-int(most_deg / side) - 1, int(most_deg / side) + 2)
    corners = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    vectors = side * np.concatenate([corners, corners + 0.5])
    lengths = np.linalg.norm(vectors, axis=1)
    # Those just outside cover what is just inside: they are drawn in to the largest angle.
    near = vectors[lengths < most_deg + apart_deg / 3]
    near *= np.minimum(1, most_deg / np.maximum(np.linalg.norm(near, axis=1), 1e-12))[:, None]
    twists = np.zeros((len(near), 6))
    twists[:, 3:] = np.radians(near)
    return twists


def shifted_onto_depth(
    model: PoseModel, poses: NDArray[np.float64], points_camera: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Shift poses (n, 4, 4) so that the middle of what they should see of the model is that of the query's points."""
    points = model.surface_points.numpy()[:_POINTS] + model.origin_world
    normals = model.surface_normals.numpy()[:_POINTS]
    middle_camera = np.median(points_camera[:_POINTS], axis=0)
    result = poses.copy()
    for pose in result:
        arms = points - pose[:3, 3]
        facing = np.einsum("ij,ij->i", arms, normals) < 0
        seen = _in_front(arms[facing] @ pose[:3, :3], model.diameter)
        middle = np.median(seen, axis=0) if len(seen) else transform_points(inverse(pose), model.centre_world)
        pose[:3, 3] += pose[:3, :3] @ (middle - middle_camera)
    return result


def _in_front(points_camera: NDArray[np.float64], diameter: float) -> NDArray[np.float64]:
    """Return those of the points (n, 3), a surface's, that no others hide: the first in each direction, about."""
    points = points_camera[points_camera[:, 2] > 0]
    if not len(points):
        return points
    directions = points[:, :2] / points[:, 2:]
    cells = directions * (np.median(points[:, 2]) * _CELLS_ACROSS / diameter)
    cells = np.clip(np.floor(cells - cells.mean(axis=0)) + _CELLS // 2, 0, _CELLS - 1).astype(int)
    cell_of = cells[:, 0] * _CELLS + cells[:, 1]
    nearest = np.full(_CELLS**2, np.inf)
    np.minimum.at(nearest, cell_of, points[:, 2])
    return points[points[:, 2] < nearest[cell_of] + diameter / _CELLS_ACROSS]
