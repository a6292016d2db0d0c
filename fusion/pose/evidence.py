"""What a view says for and against a pose, measured the same way whatever stage found it.

The model is ray-cast from the pose and compared with the query pixel by pixel: does it cover what the mask shows, is
the measured depth the model's, do the surfaces have the model's slopes, and does the query look through places where
the model should stand in the way? What stands before the model hides it and says nothing, and neither do pixels at an
edge, where masks and depth cameras are off by a pixel or two.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.pose.object_window import depth_tolerance, object_window
from fusion.pose.pose_model import PoseModel
from fusion.pose.query import Query
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

MOST_PIXELS = 20000
"""That are compared, about."""

_EDGE_PX = 2.0
"""Of the query's image, by which a mask's or a depth edge may be off."""
_STEEPEST = 3.0
_SAME_SLOPE = np.cos(np.radians(25.0))
_FEWEST_NORMALS = 30

Image = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Shares from 0 to 1, None where the query has nothing to compare.

    ``covered``: of the mask, by the model; ``filled``: of the model's silhouette, but for what hides it, by the mask,
    or, where there is none, by pixels that have a depth.
    ``agreeing``: of the object's pixels (the mask's with a depth, or all with a depth), those at which the model has
    it too; ``free``: of the model's pixels that nothing hides, those that the query looks through; ``slopes``: of the
    pixels that agree, those whose surface slopes as the model's. ``residual_m`` is the median difference of depth
    where it agrees, ``tolerance_m`` the one up to which it does, at the object's middle. ``pixels`` of the object were
    compared; ``depth_pixels`` of them with a depth.
    """

    covered: float | None = None
    filled: float | None = None
    agreeing: float | None = None
    free: float | None = None
    slopes: float | None = None
    residual_m: float | None = None
    tolerance_m: float | None = None
    pixels: int = 0
    depth_pixels: int = 0


def gather_evidence(model: PoseModel, query: Query, world_from_camera: Matrix) -> Evidence:
    """Compare the query with the model seen from a pose, where either of them is."""
    window = object_window(model, query, world_from_camera, most=MOST_PIXELS)
    if window is None:
        return Evidence()
    rendered = cast_rays_at_mesh(
        model.mesh,
        window.camera,
        [world_from_camera],
        device=model.device,
        depth_only=True,
        hierarchy=model.hierarchy,
    ).depth.numpy()[0]
    mask = None if query.mask is None else window.of(query.mask)
    if query.depth is None:
        assert mask is not None, "without depth there is a window about the mask alone"
        # The outline is all that there is: it is taken as it is.
        covered, filled = _outline(rendered > 0, mask, np.zeros(rendered.shape, bool), 0)
        return Evidence(covered=covered, filled=filled, pixels=int(mask.sum()))
    depth = window.of(query.whole_depth())
    reach = max(round(_EDGE_PX / window.step), 1)
    # Distances are across the surface, depths along the view.
    slant = np.sqrt(1 + _steepness(rendered, window.camera) ** 2)
    return _compared(rendered, depth, mask, slant * depth_tolerance(model, query, depth), window.camera, reach)


def _compared(
    rendered: NDArray[np.float32],
    depth: NDArray[np.float32],
    mask: Image | None,
    tolerance: NDArray[np.float64],
    camera: PinholeCamera,
    reach: int,
) -> Evidence:
    seen, measured = rendered > 0, depth > 0
    difference = depth - rendered
    before = seen & measured & (difference < -tolerance)
    inside = np.ones(depth.shape, bool) if mask is None else mask
    hidden = before if mask is None else (before & ~mask)
    here = _within(measured & inside, _edges(depth), reach)
    agrees = here & seen & (np.abs(difference) < tolerance)
    # A mask cuts off what stands at the model's own depth, too, as far as it does: only what is behind speaks.
    through = _within(seen, _edges(rendered), reach) & ~_near_edge(depth, reach) & measured & (difference > tolerance)
    covered, filled = _outline(seen, mask, hidden, reach)
    if mask is None:
        filled = _share(_wider(measured, reach), seen & ~_wider(hidden, reach))
    judged = agrees.sum() + through.sum()
    return Evidence(
        covered=covered,
        filled=filled,
        agreeing=_share(agrees, here),
        free=float(through.sum() / judged) if judged else None,
        slopes=_same_slopes(depth, rendered, agrees, camera),
        residual_m=float(np.median(np.abs(difference[agrees]))) if agrees.any() else None,
        tolerance_m=float(np.median(tolerance[agrees])) if agrees.any() else None,
        pixels=int((inside if mask is not None else measured).sum()),
        depth_pixels=int((measured & inside).sum()),
    )


def _share(part: Image, whole: Image) -> float | None:
    return float((part & whole).sum() / whole.sum()) if whole.any() else None


def _edges(depth: NDArray[np.float32]) -> Image:
    """Return where depth (height, width) jumps, or ends."""
    near = cv2.erode(depth, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    far = cv2.dilate(depth, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(far - near > 0.03 * np.maximum(far, 1e-6) + 0.003)


def _near_edge(depth: NDArray[np.float32], reach: int) -> Image:
    return _wider(_edges(depth), reach - 1)


def _within(here: Image, edges: Image, reach: int) -> Image:
    """Return what of a region lies away from its border and from edges; all of it where too little would be left."""
    inner = ~_wider(~here, reach) & ~_wider(edges, reach - 1) & here
    return inner if inner.sum() > 0.25 * here.sum() else here


def _wider(image: Image, reach: int) -> Image:
    if reach < 1:
        return image
    return np.asarray(cv2.dilate(image.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0)


def _outline(seen: Image, mask: Image | None, hidden: Image, reach: int) -> tuple[float | None, float | None]:
    """Return the shares of the mask that the model covers and of the model that the mask fills, give or take edges."""
    if mask is None:
        return None, None
    visible = seen & ~_wider(hidden, reach)
    return _share(_wider(seen, reach), mask), _share(_wider(mask, reach), visible)


def _steepness(depth: NDArray[np.float32], camera: PinholeCamera) -> NDArray[np.float64]:
    """Return the change of depth (height, width) per metre sideways, at most 3; 0 where there is none."""
    z = np.where(depth > 0, depth, np.nan).astype(np.float64)
    across, down = np.gradient(z, axis=1) * camera.fx, np.gradient(z, axis=0) * camera.fy
    with np.errstate(invalid="ignore"):
        slope = np.hypot(across, down) / z
    # Where a neighbour is missing: as at any edge.
    return np.nan_to_num(np.minimum(slope, _STEEPEST), nan=0.0)


def _same_slopes(
    depth: NDArray[np.float32], rendered: NDArray[np.float32], agrees: Image, camera: PinholeCamera
) -> float | None:
    """Return the share of the pixels whose normals agree, of those with neighbours that all agree in depth."""
    whole = ~_wider(~agrees, 3)
    if whole.sum() < _FEWEST_NORMALS:
        return None
    ours, theirs = _normals(np.where(agrees, depth, rendered), camera), _normals(rendered, camera)
    return float(((ours * theirs).sum(axis=-1)[whole] > _SAME_SLOPE).mean())


def _normals(depth: NDArray[np.float32], camera: PinholeCamera) -> NDArray[np.float64]:
    """Return unit normals (height, width, 3), towards the camera, of smoothed depth; meaningful within surfaces."""
    smooth = np.asarray(cv2.blur(depth, (3, 3), borderType=cv2.BORDER_REPLICATE), np.float64)
    points = camera.back_project(smooth)
    across, down = np.zeros_like(points), np.zeros_like(points)
    across[:, 2:-2] = points[:, 4:] - points[:, :-4]
    down[2:-2] = points[4:] - points[:-4]
    normal = np.cross(down, across)
    return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
