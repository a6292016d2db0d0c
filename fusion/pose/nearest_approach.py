"""Where the rays of pixels come nearest to the model's surface, as seen in pixels.

By steps of the distance on the coarse grid, then, near the surface, by parabolas in the volume's field.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.rigid import Matrix
from fusion.devices import launch_in_slabs
from fusion.pose.coverage_kernel import FieldCell, NearestApproach, distance_at
from fusion.pose.model_field import ModelField, corners_in_volume, grid_terms, sample_field, sample_grid
from fusion.pose.pose_model import PoseModel
from fusion.volume.trilinear import gradient_of_terms, trilinear_terms

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_MOST_STEPS = wp.constant(400)
_FINE_STEPS = wp.constant(4)
NOWHERE = 1.0e30
_NOWHERE = wp.constant(NOWHERE)
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
    """Return the time when a ray comes nearest, within a cell of the grid from ``start``, by parabolas.

    Where it is found to be under the surface, how far does not matter.
    """
    t = float(start)
    reach = 1.0 / (field.nodes_per_metre * wp.length(ray))
    least = seen_distance(field, origin, ray, t)
    for _step in range(_FINE_STEPS):
        if least < 0.0:
            return t
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
def slope_in(cell: FieldCell) -> wp.vec3:
    """Return the field's gradient at a cell's point, metres a metre."""
    return cell.cells_per_metre * gradient_of_terms(cell.terms, cell.cells_per_metre * (cell.point - cell.low))


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
    # Beside a sharp edge the two slopes differ, and their mean is less than that of a distance, which is 1.
    slope = found.share * slope_in(found.before) + (1.0 - found.share) * slope_in(found.after)
    steeper = 1.0 / wp.clamp(wp.length(slope), _LEAST_SLOPE, 1.0)
    found.offset = at_middle / steeper - found.share * at_before - (1.0 - found.share) * at_after
    found.pixels_per_metre = steeper / t
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
    slopes: wp.array(dtype=wp.vec2),
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
    slopes[index] = wp.vec2()
    if t > 0.0:
        coarse = sample_grid(field, origin + t * ray)
        apart = 0.5 / (field.nodes_per_metre * wp.length(ray))
        if wp.abs(coarse.distance) * focal / t < fine_within_px + focal / (t * field.nodes_per_metre):
            t = nearest_about(field, origin, ray, t)
            apart = 0.5 / (field.voxels_per_metre * wp.length(ray))
        sample = sample_field(field, origin + t * ray)
        edge = focal * sample.distance / t
        if sample.source != 0:
            edges_px[index] = edge
            across = wp.transpose(rotation) * sample.normal
            slopes[index] = focal * wp.vec2(across[0] / intrinsics[0], across[1] / intrinsics[1])
        # Within the silhouette the pixels beside it tell.
        if sample.source != 0 and edge >= 0.0:
            found = approach_about(field, origin, ray, t, apart)
            found.pixels_per_metre = focal * found.pixels_per_metre
    approaches[index] = found


def nearest_approaches(
    model: PoseModel,
    camera: PinholeCamera,
    pixels: NDArray[np.floating],
    world_from_camera: Matrix,
    *,
    fine_within_px: float,
) -> tuple[wp.array, wp.array, wp.array]:
    """Return where the rays of ``pixels`` (n, 2) of ``camera`` come nearest: three arrays (n,) on the model's device.

    They are their ``NearestApproach``; distances from the silhouette's edge in pixels, and as exact as the volume where
    they are less than ``fine_within_px``; and slopes, vec2, by which these grow along u and v. The distance is negative
    where a ray meets the model: how far is not told, nor is the approach. It is NOWHERE where a ray comes near nowhere.
    """
    device = model.device
    local = model.local(world_from_camera)
    approaches = wp.empty(len(pixels), dtype=NearestApproach, device=device)
    edges_px = wp.empty(len(pixels), dtype=float, device=device)
    slopes = wp.empty(len(pixels), dtype=wp.vec2, device=device)
    launch_in_slabs(
        _find_approaches,
        dim=len(pixels),
        inputs=[
            model.field,
            wp.array(np.asarray(pixels, np.float32), dtype=wp.vec2, device=device),
            wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
            wp.mat33(*local[:3, :3].ravel().tolist()),
            wp.vec3(*local[:3, 3].tolist()),
            fine_within_px,
        ],
        outputs=[approaches, edges_px, slopes],
        device=device,
        least_slab=128,
    )
    return approaches, edges_px, slopes
