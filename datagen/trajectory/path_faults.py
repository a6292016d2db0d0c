"""What can be wrong with a path in a scene, and what the image shows of its subject."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix, transform_points
from datagen.trajectory.frame_ranges import frame_ranges

MOST_FAULTS = 8
"""That one message names."""
GRID = 5
"""Points along each side of a bounding box."""
UNIT_GRID = np.stack(np.meshgrid(*[np.linspace(0, 1, GRID)] * 3), axis=-1).reshape(-1, 3)


@dataclass(frozen=True, kw_only=True)
class Box:
    """A bounding box: the unit cube, 0 to 1, taken to the world by the affine ``world_from_unit`` (4×4)."""

    name: str
    world_from_unit: Matrix

    @property
    def points_world(self) -> NDArray[np.float64]:
        """A grid of points in it (GRID³, 3), from corner to corner."""
        return transform_points(self.world_from_unit, UNIT_GRID)

    @cached_property
    def range_world(self) -> NDArray[np.float64]:
        """The smallest and the largest coordinates (2, 3) that it reaches."""
        edges, corner = self.world_from_unit[:3, :3], self.world_from_unit[:3, 3]
        return np.array([corner + np.minimum(edges, 0).sum(axis=1), corner + np.maximum(edges, 0).sum(axis=1)])


@dataclass(frozen=True, kw_only=True)
class Fault:
    """``frames`` in which ``what`` is wrong."""

    frames: tuple[int, ...]
    what: str

    def __str__(self) -> str:
        return f"{frame_ranges(self.frames)}: {self.what}"


def default_subjects(boxes: Sequence[Box], path: NDArray[np.float64]) -> tuple[Box, ...]:
    """Return the boxes that the camera does not move above, below or inside all the time, as floors and rooms."""
    places = path[:, :2, 3]
    return tuple(
        box for box in boxes if not ((places >= box.range_world[0, :2]) & (places <= box.range_world[1, :2])).all()
    )


def part_in_view(
    box: Box, path: NDArray[np.float64], camera: PinholeCamera, clip_range: tuple[float, float]
) -> NDArray[np.float64]:
    """Return for each pose of a path (N, 4, 4) what part of a box' points lies in the image and the clip range."""
    near, far = clip_range
    parts = np.zeros(len(path))
    maybe = np.flatnonzero(_may_be_in_view(box, path, camera))
    # The product from the right by a rotation is that by its inverse from the left.
    points_camera = (box.points_world - path[maybe, None, :3, 3]) @ path[maybe, :3, :3]
    seen = (points_camera[..., 2] >= near) & (points_camera[..., 2] <= far)
    points_camera[~seen, 2] = 1.0  # so that dividing by it is possible
    u, v = np.moveaxis(camera.project(points_camera), -1, 0)
    seen &= (u >= -0.5) & (u <= camera.width - 0.5) & (v >= -0.5) & (v <= camera.height - 0.5)
    parts[maybe] = seen.mean(axis=1)
    return parts


def _may_be_in_view(box: Box, path: NDArray[np.float64], camera: PinholeCamera) -> NDArray[np.bool_]:
    """Tell in which frames a ball around the box reaches the inner side of all four planes through the image's edges.

    Where it does not, no point of the box can be in the image.
    """
    low, high = box.range_world
    center_camera = np.einsum("ni,nij->nj", (low + high) / 2 - path[:, :3, 3], path[:, :3, :3])
    inwards = np.array(
        [
            [camera.fx, 0, camera.cx + 0.5],
            [-camera.fx, 0, camera.width - 0.5 - camera.cx],
            [0, camera.fy, camera.cy + 0.5],
            [0, -camera.fy, camera.height - 0.5 - camera.cy],
        ]
    )
    inwards /= np.linalg.norm(inwards, axis=1, keepdims=True)
    return (center_camera @ inwards.T >= -np.linalg.norm(high - low) / 2).all(axis=1)


def view_faults(
    boxes: Sequence[Box],
    path: NDArray[np.float64],
    camera: PinholeCamera,
    clip_range: tuple[float, float],
    *,
    subject: Sequence[str],
    min_in_view: float,
) -> list[Fault]:
    """Return the frames in which a named subject, or where none is named every object, is out of view.

    Boxes of one name, as those of one object's copies, count together.
    """
    if not min_in_view:
        return []
    chosen = [box for box in boxes if box.name in subject] if subject else default_subjects(boxes, path)
    together = "" if subject else _listed(sorted({box.name for box in chosen}))
    names = {box.name: together or repr(box.name) for box in chosen}
    in_view = {name: np.zeros(len(path)) for name in names.values()}
    for box in chosen:
        best = in_view[names[box.name]]
        missed = np.flatnonzero(best < min_in_view)
        if not len(missed):
            continue
        best[missed] = np.maximum(best[missed], part_in_view(box, path[missed], camera, clip_range))
    faults = []
    for name, part in in_view.items():
        frames = np.flatnonzero(part < min_in_view)
        if len(frames):
            what = (
                f"{part[frames].min():.0%} of {name} is in view, at least "
                f"{min_in_view:.0%} is asked for (trajectory.min_in_view)"
            )
            faults.append(Fault(frames=tuple(frames.tolist()), what=what))
    return faults


def describe_faults(faults: Sequence[Fault]) -> str:
    """Return what is wrong with a path and what would mend it, in one message."""
    named = [str(fault) for fault in faults[:MOST_FAULTS]]
    if len(faults) > MOST_FAULTS:
        named.append(f"and {len(faults) - MOST_FAULTS} faults more")
    return (
        f"the camera's path: {'; '.join(named)}. Move the path or the objects, name what is to be seen "
        "(trajectory.subject), or render it all the same (trajectory.check = false)"
    )


def _listed(names: Sequence[str]) -> str:
    if len(names) <= 1:
        return "".join(map(repr, names))
    more = f" and {len(names) - 3} more" if len(names) > 3 else ""
    return f"any of {', '.join(map(repr, names[:3]))}{more}"
