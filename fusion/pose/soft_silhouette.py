"""The model's silhouette with a soft edge, rendered so that it can be differentiated by the pose.

For each pixel beside the silhouette the ray's nearest approach to the surface is found; the distance there, seen as
pixels, is the pixel's distance s from the silhouette's edge. A pixel within takes that of the nearest one beside it,
less the way between them: what is under the surface, thick or thin, has no part in the silhouette. Coverage is Φ(−s/σ),
Φ the normal distribution: that of a sharp silhouette blurred by a Gaussian of σ pixels, where its edge is straight.
Where a ray comes nearest does not change the distance in first order, so the derivative is that of the distance at a
fixed place of the ray; Warp's tape takes it, for all six parameters of the pose.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import launch_in_slabs
from fusion.pose.coverage_kernel import COVERAGE_KERNEL, FieldCell, NearestApproach, distance_at
from fusion.pose.model_field import ModelField, corners_in_volume, grid_terms, sample_grid
from fusion.pose.pose_model import PoseModel
from fusion.volume.trilinear import gradient_of_terms, trilinear_terms

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_MOST_STEPS = wp.constant(400)
_FINE_STEPS = wp.constant(4)
_NOWHERE = wp.constant(1.0e30)
_LEAST_SLOPE = wp.constant(0.4)


@wp.func
def box_times(field: ModelField, origin: wp.vec3, ray: wp.vec3) -> wp.vec2:
    """Return when a ray enters and leaves the grid's box; the second is the less where it misses it."""
    enter = float(0.0)
    leave = float(1.0e30)
    for axis in range(3):
        direction = ray[axis]
        if wp.abs(direction) < 1.0e-9:
            direction = 1.0e-9
        low = field.grid_origin[axis] + 1.0e-3 / field.nodes_per_metre
        high = field.grid_origin[axis] + (float(field.grid.shape[axis] - 1) - 1.0e-3) / field.nodes_per_metre
        one = (low - origin[axis]) / direction
        other = (high - origin[axis]) / direction
        enter = wp.max(enter, wp.min(one, other))
        leave = wp.min(leave, wp.max(one, other))
    return wp.vec2(enter, leave)


@wp.func
def nearest_on_grid(field: ModelField, origin: wp.vec3, ray: wp.vec3, enough: float) -> float:
    """Return the time, metres of planar depth, when a ray comes nearest to the surface as seen in pixels; −1: never.

    It advances by the distance to the surface, which it cannot come nearer than, and by a cell at least. Where it is
    under the surface by more than ``enough``, metres a metre of depth, it is not followed on.
    """
    times = box_times(field, origin, ray)
    speed = wp.length(ray)
    t = times[0] + 1.0e-6
    best = float(-1.0)
    least = float(_NOWHERE)
    step = int(0)
    while t < times[1] and step < _MOST_STEPS and least > -enough:
        sample = sample_grid(field, origin + t * ray)
        ahead = 1.0 / field.nodes_per_metre
        if sample.source != 0:
            seen = sample.distance / t
            if seen < least:
                least = seen
                best = t
            ahead = wp.max(ahead, 0.9 * sample.distance)
        t += ahead / speed
        step += 1
    return best


@wp.func
def cell_around(field: ModelField, point: wp.vec3) -> FieldCell:
    """Return the trilinear cell around a local point, from the volume where it knows, else from the grid."""
    found = FieldCell()
    found.point = point
    scaled = field.voxels_per_metre * point
    cell = wp.vec3i(int(wp.floor(scaled[0])), int(wp.floor(scaled[1])), int(wp.floor(scaled[2])))
    corners, known = corners_in_volume(field, cell)
    if known:
        terms = trilinear_terms(corners)
        low = wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
        slope = wp.length(field.truncation * field.voxels_per_metre * gradient_of_terms(terms, scaled - low))
        if slope > _LEAST_SLOPE:
            found.terms = field.truncation / slope * terms
            found.low = low / field.voxels_per_metre
            found.cells_per_metre = field.voxels_per_metre
            found.known = 1
            return found
    scaled = field.nodes_per_metre * (point - field.grid_origin)
    cell = wp.vec3i(int(wp.floor(scaled[0])), int(wp.floor(scaled[1])), int(wp.floor(scaled[2])))
    for axis in range(3):
        if cell[axis] < 0 or cell[axis] > field.grid.shape[axis] - 2:
            return found
    found.terms = grid_terms(field, cell)
    found.low = field.grid_origin + wp.vec3(float(cell[0]), float(cell[1]), float(cell[2])) / field.nodes_per_metre
    found.cells_per_metre = field.nodes_per_metre
    found.known = 1
    return found


@wp.func
def seen_distance(field: ModelField, origin: wp.vec3, ray: wp.vec3, t: float) -> float:
    """Return the distance over the depth at a time of a ray, from the finest source."""
    point = origin + t * ray
    cell = cell_around(field, point)
    if cell.known == 0:
        return _NOWHERE
    return distance_at(cell, point) / t


@wp.func
def nearest_about(field: ModelField, origin: wp.vec3, ray: wp.vec3, start: float) -> float:
    """Return the time when a ray comes nearest, within a cell of the grid from ``start``, by parabolas."""
    t = float(start)
    reach = 1.0 / (field.nodes_per_metre * wp.length(ray))
    least = seen_distance(field, origin, ray, t)
    for _step in range(_FINE_STEPS):
        centre = t
        at_centre = least
        before = seen_distance(field, origin, ray, centre - reach)
        after = seen_distance(field, origin, ray, centre + reach)
        bend = before + after - 2.0 * at_centre
        turn = wp.where(before < after, -1.0, 1.0)
        if bend > 0.0:
            turn = wp.clamp(0.5 * (before - after) / bend, -1.0, 1.0)
        value = seen_distance(field, origin, ray, centre + turn * reach)
        if value < least:
            least = value
            t = centre + turn * reach
        reach = 0.3 * reach
    return t


@wp.func
def approach_about(field: ModelField, origin: wp.vec3, ray: wp.vec3, t: float, apart: float) -> NearestApproach:
    """Return the approach at time t, told by the field at a time ``apart`` before and after."""
    found = NearestApproach()
    found.before = cell_around(field, origin + (t - apart) * ray)
    found.after = cell_around(field, origin + (t + apart) * ray)
    middle = cell_around(field, origin + t * ray)
    if found.before.known * found.after.known * middle.known == 0:
        return found
    at_before = distance_at(found.before, found.before.point)
    at_after = distance_at(found.after, found.after.point)
    at_middle = distance_at(middle, middle.point)
    falls = wp.max(at_before - at_middle, 0.0)
    rises = wp.max(at_after - at_middle, 0.0)
    found.share = 0.5
    if falls + rises > 0.0:
        found.share = rises / (falls + rises)
    found.offset = at_middle - found.share * at_before - (1.0 - found.share) * at_after
    found.pixels_per_metre = 1.0 / t
    return found


@wp.kernel
def _find_approaches(
    first: int,
    field: ModelField,
    pixels: wp.array(dtype=wp.vec2),
    intrinsics: wp.vec4,
    rotation: wp.mat33,
    origin: wp.vec3,
    fine_within_px: float,
    approaches: wp.array(dtype=NearestApproach),
    edges_px: wp.array(dtype=float),
) -> None:
    index = wp.tid() + first
    pixel = pixels[index]
    x = (pixel[0] - intrinsics[2]) / intrinsics[0]
    y = (pixel[1] - intrinsics[3]) / intrinsics[1]
    ray = rotation * wp.vec3(x, y, 1.0)
    focal = 0.5 * (intrinsics[0] + intrinsics[1])
    t = nearest_on_grid(field, origin, ray, 1.0 / field.nodes_per_metre)
    found = NearestApproach()
    edges_px[index] = _NOWHERE
    if t > 0.0:
        coarse = sample_grid(field, origin + t * ray)
        apart = 0.5 / (field.nodes_per_metre * wp.length(ray))
        if wp.abs(coarse.distance) * focal / t < fine_within_px + focal / (t * field.nodes_per_metre):
            t = nearest_about(field, origin, ray, t)
            apart = 0.5 / (field.voxels_per_metre * wp.length(ray))
        found = approach_about(field, origin, ray, t, apart)
        found.pixels_per_metre = focal * found.pixels_per_metre
        edges_px[index] = focal * seen_distance(field, origin, ray, t)
    approaches[index] = found


@dataclass(frozen=True, kw_only=True, eq=False)
class SoftSilhouette:
    """The silhouette at n pixels.

    ``coverage`` (n,) from 0 to 1; ``jacobian`` (n, 6) its derivative by the twist of the pose along the world's axes
    about the pivot, from the tape; empty where it was not asked for. ``edge_px`` (n,) is the distance from the edge in
    pixels, negative within, infinite where the ray never comes near.
    """

    coverage: NDArray[np.float64]
    jacobian: NDArray[np.float64]
    edge_px: NDArray[np.float64]


def soft_silhouette(
    model: PoseModel,
    camera: PinholeCamera,
    pixels: NDArray[np.floating],
    world_from_camera: Matrix,
    *,
    softness_px: float,
    pivot_world: NDArray[np.float64],
    with_jacobian: bool = True,
) -> SoftSilhouette:
    """Render the soft silhouette of ``model`` at ``pixels`` (n, 2), (u, v) of ``camera``, seen from a pose.

    The pixels are whole ones, and those beside the silhouette have to be among them. ``softness_px`` is σ, in the
    camera's pixels.
    """
    device = model.device
    local = model.local(world_from_camera)
    count = len(pixels)
    approaches = wp.empty(count, dtype=NearestApproach, device=device)
    edges_px = wp.empty(count, dtype=float, device=device)
    launch_in_slabs(
        _find_approaches,
        dim=count,
        inputs=[
            model.field,
            wp.array(np.asarray(pixels, np.float32), dtype=wp.vec2, device=device),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            wp.mat33(*local[:3, :3].ravel().tolist()),
            wp.vec3(*local[:3, 3].tolist()),
            4 * softness_px,
        ],
        outputs=[approaches, edges_px],
        device=device,
        least_slab=128,
    )
    nearest, within_px = _nearest_beside(np.asarray(pixels), edges_px.numpy())
    twists = wp.zeros(count, dtype=wp.spatial_vector, device=device, requires_grad=with_jacobian)
    coverage = wp.empty(count, dtype=float, device=device, requires_grad=with_jacobian)
    edge = wp.empty(count, dtype=float, device=device)
    pivot = wp.vec3(*(pivot_world - model.origin_world).tolist())
    inputs: list[Any] = [
        approaches,
        wp.array(nearest, dtype=int, device=device),
        wp.array(within_px, dtype=float, device=device),
        *(twists, pivot, softness_px),
    ]
    jacobian = np.empty((0, 6))
    # Each pixel has six parameters to itself: one pass back through the tape gives all rows of the Jacobian.
    tape = wp.Tape()
    with tape:
        wp.launch(COVERAGE_KERNEL, dim=count, inputs=inputs, outputs=[coverage, edge], device=device)
    if with_jacobian:
        tape.backward(grads={coverage: wp.ones(count, dtype=float, device=device)})
        jacobian = twists.grad.numpy().astype(np.float64)
    return SoftSilhouette(
        coverage=coverage.numpy().astype(np.float64), jacobian=jacobian, edge_px=edge.numpy().astype(np.float64)
    )


def _nearest_beside(
    pixels: NDArray[np.floating], edges_px: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Tell how far within the silhouette pixels are.

    ``pixels`` (n, 2) are whole, ``edges_px`` (n,) their distances from the edge, right where they are positive. Returns
    for each pixel the index of the one beside the silhouette that tells of it, itself if it is one, and how far that is
    (n,); where no pixel is beside the silhouette the distance is infinite.
    """
    index = np.arange(len(pixels), dtype=np.int32)
    inside = edges_px < 0
    if inside.all() or not inside.any():
        return index, np.where(inside, np.inf, 0).astype(np.float32)
    columns, rows = np.rint(pixels).astype(int).T
    columns, rows = columns - columns.min(), rows - rows.min()
    held = np.full((rows.max() + 1, columns.max() + 1), -1, np.int32)
    held[rows, columns] = index
    beside = np.ones(held.shape, np.uint8)
    beside[rows[~inside], columns[~inside]] = 0
    _distance, labels = cv2.distanceTransformWithLabels(
        beside, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    by_label = np.zeros(labels.max() + 1, np.int32)
    by_label[labels[beside == 0]] = held[beside == 0]
    nearest = by_label[labels[rows, columns]]
    squares = ((pixels - pixels[nearest]) ** 2).sum(axis=1)
    # The nearest pixel's centre lies beside the perpendicular: by up to half a pixel, squared a twelfth on average; a
    # direct neighbour at up to 45°, whose cosine is 0.9 on average.
    ways = np.where(squares < 1.5, 0.9 * np.sqrt(squares), np.sqrt(np.maximum(squares - 1 / 12, 0)))
    return nearest, np.where(inside, ways, 0).astype(np.float32)
