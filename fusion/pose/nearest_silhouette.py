"""The nearest view by the outline alone: where a query has a mask and no depth.

Masks are compared in a window of their own, its middle on theirs and its size from their area, so that neither the
place in the image nor the distance matters. The views that are most alike, some way apart from each other, are
candidates: their outlines are brought onto the mask, and the best fit is the answer.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.pose.refinement import Refinement
from fusion.pose.silhouette_refinement import SilhouetteRefinementOptions, refine_with_silhouette
from fusion.pose.view_index import ViewIndex

WINDOW = 32
"""Pixels a side of the window; it is twice as wide as a square of the mask's area."""

CANDIDATES = 4
_APART_DEG = 20.0
_AMBIGUOUS_OVERLAP = 0.02
"""A candidate whose outline fits by no more than this worse, elsewhere, is as good."""


@dataclass(frozen=True, kw_only=True, eq=False)
class NearestOutline:
    """``indices`` (k,) of the views most alike, best first, with their ``overlaps`` (k,), intersection over union.

    ``estimate`` is world_from_camera of the query, its outline on the mask; ``overlap`` its fit; ``ambiguous`` where
    another candidate, elsewhere, fits as well.
    """

    indices: NDArray[np.int64]
    overlaps: NDArray[np.float64]
    estimate: Matrix
    overlap: float
    ambiguous: bool


def find_nearest_outline(index: ViewIndex, model: PoseModel, query: Query, *, count: int = 5) -> NearestOutline:
    """Return the views whose outline is most like the query's mask, and the pose that the best of them leads to.

    Raises InputError for a query without a mask, or with an empty one.
    """
    if query.mask is None:
        raise InputError("the query has neither depth nor mask, so there is nothing to locate it by; give --mask")
    if not query.mask.any():
        raise InputError("the mask is empty, so there is no outline to compare")
    ours = outline_window(query.mask)
    views = index.depth.numpy() > 0
    theirs = np.stack([outline_window(outline) for outline in views])
    both, either = (ours & theirs).sum(axis=(1, 2)), (ours | theirs).sum(axis=(1, 2))
    overlaps = both / np.maximum(either, 1)
    order = np.argsort(-overlaps, kind="stable")
    poses = index.world_from_camera
    tried: list[tuple[float, Matrix]] = []
    for view in _apart(order, poses):
        start = _brought_onto(query, index.camera, views[view], poses[view], model.centre_world)
        found = refine_with_silhouette(model, query, start, options=SilhouetteRefinementOptions(starts="one"))
        tried.append((_fit(found), found.world_from_camera))
    tried.sort(key=lambda one: -one[0])
    best, estimate = tried[0]
    turns = [np.trace(estimate[:3, :3].T @ pose[:3, :3]) for _, pose in tried]
    elsewhere = [fit for (fit, _), trace in zip(tried, turns, strict=True) if trace < _trace(_APART_DEG / 2)]
    return NearestOutline(
        indices=order[:count],
        overlaps=overlaps[order[:count]],
        estimate=estimate,
        overlap=best,
        ambiguous=bool(elsewhere) and max(elsewhere) > best - _AMBIGUOUS_OVERLAP,
    )


def outline_window(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (height, width) in its own window (WINDOW, WINDOW); nothing is True where it is empty."""
    v, u = np.nonzero(mask)
    if not len(u):
        return np.zeros((WINDOW, WINDOW), bool)
    side = np.sqrt(len(u))
    scale = WINDOW / 2 / side
    place = np.array(
        [[scale, 0, WINDOW / 2 - 0.5 - scale * u.mean()], [0, scale, WINDOW / 2 - 0.5 - scale * v.mean()]], np.float64
    )
    # Averaged before it is made smaller, or thin parts would come and go.
    soft = cv2.GaussianBlur(mask.astype(np.float32), (0, 0), 0.4 / scale) if scale < 1 else mask.astype(np.float32)
    return np.asarray(cv2.warpAffine(soft, place, (WINDOW, WINDOW), flags=cv2.INTER_LINEAR) > 0.5)


def _fit(found: Refinement) -> float:
    return 0.0 if found.declined else found.overlap or 0.0


def _trace(angle_deg: float) -> float:
    return 1 + 2 * float(np.cos(np.radians(angle_deg)))


def _apart(order: NDArray[np.int64], poses: NDArray[np.float64]) -> list[int]:
    """Return the first views of ``order`` that look from directions some way from each other."""
    chosen: list[int] = []
    for view in order:
        turns = [np.trace(poses[view, :3, :3].T @ poses[other, :3, :3]) for other in chosen]
        if all(turn < _trace(_APART_DEG) for turn in turns):
            chosen.append(int(view))
        if len(chosen) == CANDIDATES:
            break
    return chosen


def _brought_onto(
    query: Query, view_camera: PinholeCamera, outline: NDArray[np.bool_], pose: Matrix, centre_world: NDArray
) -> Matrix:
    """Return the view's pose turned and shifted so that its outline's middle and area are the mask's.

    The model keeps the side that it shows: it is turned with the line of sight to it.
    """
    assert query.mask is not None
    if not outline.any():
        return pose
    camera = query.camera
    (v, u), (row, column) = np.nonzero(query.mask), np.nonzero(outline)
    ours = np.array([(u.mean() - camera.cx) / camera.fx, (v.mean() - camera.cy) / camera.fy, 1.0])
    theirs = np.array(
        [
            (column.mean() - view_camera.cx) / view_camera.fx,
            (row.mean() - view_camera.cy) / view_camera.fy,
            1.0,
        ]
    )
    areas = len(u) / (camera.fx * camera.fy), len(row) / (view_camera.fx * view_camera.fy)
    middle = pose[:3, :3].T @ (centre_world - pose[:3, 3])
    turned = _turn(theirs, ours) @ middle
    zoom = np.sqrt(areas[1] / areas[0])
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ _turn(theirs, ours).T
    result[:3, 3] = centre_world - result[:3, :3] @ (zoom * turned)
    return result


def _turn(start: NDArray[np.float64], end: NDArray[np.float64]) -> NDArray[np.float64]:
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    return np.asarray(cv2.Rodrigues(axis / sine * np.arctan2(sine, a @ b))[0], np.float64)
