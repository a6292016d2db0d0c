"""The model's outline drawn over a query: whether a pose is right, to the eye.

Drawn are the silhouette and the edges within it where one part of the model hides another, as a ray caster sees them.
"""

from collections.abc import Sequence
from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import Device
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

Rgb: TypeAlias = tuple[int, int, int]

BEFORE: Rgb = (255, 80, 40)
AFTER: Rgb = (40, 230, 90)

_STEP_IN_DEPTH = 0.04
"""Of the depth that the model spans in a view, by which the next pixel lies behind this one's plane at an edge."""
_LEAST_STEP = 0.01
"""And of the depth itself."""
_DIMMED = 0.7
_PIXELS_A_LINE = 400
"""For every so many pixels of the image's width a line is a pixel wider."""
_GAP_PX = 4


def model_edges(
    mesh: Mesh, camera: PinholeCamera, world_from_camera: Matrix, *, device: Device, step: float = _STEP_IN_DEPTH
) -> NDArray[np.bool_]:
    """Return where ``mesh``, world frame, has its silhouette and its occluding edges (height, width), a pixel wide.

    The pixels are the outermost of the nearer surface. An occluding edge is where the next pixel's surface lies behind
    the plane through this one and its other neighbour by ``step`` of the depth that the model spans in this view.
    Nothing is True where the model is not seen.
    """
    depth = cast_rays_at_mesh(mesh, camera, [world_from_camera], device=device, depth_only=True).depth.numpy()[0]
    seen = depth > 0
    if not seen.any():
        return seen
    # Along a line of pixels the inverse depth of a plane is linear. The border is repeated: a model that is cut off by
    # the image's border has no outline there.
    near = np.pad(np.divide(1, depth, where=seen, out=np.zeros_like(depth)), 1, mode="edge")
    here = 2 * near[1:-1, 1:-1]
    bend = np.maximum(here - near[1:-1, :-2] - near[1:-1, 2:], here - near[:-2, 1:-1] - near[2:, 1:-1])
    threshold = np.maximum(step * np.ptp(depth[seen]), _LEAST_STEP * depth)
    return np.asarray(seen & (bend * depth**2 > threshold))


def draw_edges(image: NDArray[np.uint8], edges: NDArray[np.bool_], *, color: Rgb = AFTER) -> NDArray[np.uint8]:
    """Return an RGB image (height, width, 3) uint8 with ``edges`` (height, width) in ``color``, as wide as it needs."""
    width = 1 + image.shape[1] // _PIXELS_A_LINE
    drawn = cv2.dilate(edges.astype(np.uint8), np.ones((width, width), np.uint8)) > 0
    result = image.copy()
    result[drawn] = color
    return result


def draw_pose(
    image: NDArray[np.uint8],
    mesh: Mesh,
    camera: PinholeCamera,
    world_from_camera: Matrix,
    *,
    device: Device,
    color: Rgb = AFTER,
) -> NDArray[np.uint8]:
    """Return a query's RGB image (height, width, 3) uint8, dimmed, with the model's edges as seen from a pose."""
    dimmed = (image * _DIMMED).astype(np.uint8)
    return draw_edges(dimmed, model_edges(mesh, camera, world_from_camera, device=device), color=color)


def before_and_after(
    image: NDArray[np.uint8],
    mesh: Mesh,
    camera: PinholeCamera,
    before: Matrix,
    after: Matrix,
    *,
    device: Device,
    titles: tuple[str, str] = ("before", "after"),
) -> NDArray[np.uint8]:
    """Return a query's image twice side by side: left the model's edges from ``before``, right from ``after``.

    ``image`` (height, width, 3) uint8 RGB is of ``camera``; the poses are world_from_camera. ``titles`` stand in the
    upper left corners, in ASCII. The result is (height, 2 · width + gap, 3).
    """
    left = with_title(draw_pose(image, mesh, camera, before, device=device, color=BEFORE), titles[0], color=BEFORE)
    right = with_title(draw_pose(image, mesh, camera, after, device=device, color=AFTER), titles[1], color=AFTER)
    return np.hstack([left, np.full((len(image), _GAP_PX, 3), 255, np.uint8), right])


def with_title(image: NDArray[np.uint8], title: str, *, color: Rgb = (255, 255, 255)) -> NDArray[np.uint8]:
    """Return an RGB image with a line of ASCII text in its upper left corner, on a dark ground so that it is read."""
    if not title:
        return image
    scale = max(image.shape[1] / 900, 0.35)
    (width, height), below = cv2.getTextSize(title, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    result = image.copy()
    ground = result[: height + below + 8, : width + 12]
    ground[:] = ground // 4
    cv2.putText(result, title, (6, height + 5), cv2.FONT_HERSHEY_SIMPLEX, scale, color, 1, cv2.LINE_AA)
    return result


def stacked(pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.uint8]:
    """Return pictures (height, width, 3) of one width one below the other, with gaps between them."""
    gap = np.full((_GAP_PX, pictures[0].shape[1], 3), 255, np.uint8)
    rows = [part for picture in pictures for part in (picture, gap)]
    return np.vstack(rows[:-1])


def depth_as_grey(depth: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return planar depth (height, width) as an RGB image, near bright, black where invalid: for lack of a colour."""
    valid = depth > 0
    if not valid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = np.percentile(depth[valid], (1, 99))
    share = np.clip((far - depth) / max(far - near, 1e-6), 0, 1)
    grey = np.where(valid, 60 + 180 * share, 0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)
