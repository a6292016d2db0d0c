"""Where the rays of pixels come nearest to the model's surface, as seen in pixels.

By steps of the distance on the coarse grid, then, near the surface, by parabolas in the volume's field.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from fusion.devices import SlabLaunch
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
def grid_distance(field: ModelField, point: wp.vec3) -> float:
    """Return the distance that the grid has at a local point, metres, without its slope; NOWHERE off the grid."""
    scaled = field.nodes_per_metre * (point - field.grid_origin)
    x = int(wp.floor(scaled[0]))
    y = int(wp.floor(scaled[1]))
    z = int(wp.floor(scaled[2]))
    if x < 0 or y < 0 or z < 0:
        return _NOWHERE
    if x > field.grid.shape[0] - 2 or y > field.grid.shape[1] - 2 or z > field.grid.shape[2] - 2:
        return _NOWHERE
    a = scaled[0] - float(x)
    b = scaled[1] - float(y)
    c = scaled[2] - float(z)
    near = wp.lerp(
        wp.lerp(field.grid[x, y, z], field.grid[x + 1, y, z], a),
        wp.lerp(field.grid[x, y + 1, z], field.grid[x + 1, y + 1, z], a),
        b,
    )
    far = wp.lerp(
        wp.lerp(field.grid[x, y, z + 1], field.grid[x + 1, y, z + 1], a),
        wp.lerp(field.grid[x, y + 1, z + 1], field.grid[x + 1, y + 1, z + 1], a),
        b,
    )
    return wp.lerp(near, far, c)


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
        point = origin + t * ray
        distance = grid_distance(field, point)
        ahead = 1.0 / field.nodes_per_metre
        if distance < _NOWHERE:
            seen = distance / t
            # Only what comes nearer than all before is asked for its slope: without one there is no side to be on.
            if seen < least and sample_grid(field, point).source != 0:
                least = seen
                best = t
            ahead = wp.max(ahead, 0.9 * distance)
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
    rotations: wp.array(dtype=wp.mat33),
    origins: wp.array(dtype=wp.vec3),
    fine_within_px: float,
    reach_px: float,
    approaches: wp.array(dtype=NearestApproach),
    edges_px: wp.array(dtype=float),
    slopes: wp.array(dtype=wp.vec2),
) -> None:
    index = wp.tid() + first
    pose = index / pixels.shape[0]
    pixel = pixels[index % pixels.shape[0]]
    x = (pixel[0] - intrinsics[2]) / intrinsics[0]
    y = (pixel[1] - intrinsics[3]) / intrinsics[1]
    ray = rotations[pose] * wp.vec3(x, y, 1.0)
    origin = origins[pose]
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
        if sample.source != 0:
            edge = focal * sample.distance / t
            edges_px[index] = edge
            across = wp.transpose(rotations[pose]) * sample.normal
            slopes[index] = focal * wp.vec2(across[0] / intrinsics[0], across[1] / intrinsics[1])
            # Within the silhouette the pixels beside it tell; far from it nothing changes.
            if edge >= 0.0 and edge < reach_px:
                found = approach_about(field, origin, ray, t, apart)
                found.pixels_per_metre = focal * found.pixels_per_metre
    approaches[index] = found


class ApproachFinder:
    """Finds where the rays of n pixels come nearest to a model, from k poses at a time, in arrays that are kept.

    After ``find`` the arrays (k · n,), pose by pose, on the model's device, hold: ``approaches`` the pixels'
    ``NearestApproach``; ``edges_px`` distances from the silhouette's edge, as exact as the volume where they are less
    than ``fine_within_px``; ``slopes``, vec2, by which these grow along u and v. The distance is negative where a ray
    meets the model: how far is not told, nor is the approach, nor is that of a ray that stays ``reach_px`` away. It is
    NOWHERE where a ray comes near nowhere.
    """

    def __init__(
        self,
        model: PoseModel,
        camera: PinholeCamera,
        pixels: NDArray[np.floating],
        *,
        poses: int,
        fine_within_px: float,
        reach_px: float,
    ) -> None:
        device, size = model.device, poses * len(pixels)
        self._model = model
        self._rotations = wp.zeros(poses, dtype=wp.mat33, device=device)
        self._origins = wp.zeros(poses, dtype=wp.vec3, device=device)
        self.approaches = wp.zeros(size, dtype=NearestApproach, device=device)
        self.edges_px = wp.zeros(size, dtype=float, device=device)
        self.slopes = wp.zeros(size, dtype=wp.vec2, device=device)
        self._launch = SlabLaunch(
            _find_approaches,
            dim=size,
            inputs=[
                model.field,
                wp.array(np.asarray(pixels, np.float32), dtype=wp.vec2, device=device),
                wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy),
                *(self._rotations, self._origins, fine_within_px, reach_px),
            ],
            outputs=[self.approaches, self.edges_px, self.slopes],
            device=device,
            least_slab=128,
        )

    def find(self, world_from_camera: NDArray[np.float64]) -> None:
        """Look from poses (k, 4, 4)."""
        local = self._model.local(world_from_camera)
        self._rotations.assign(local[:, :3, :3].astype(np.float32))
        self._origins.assign(local[:, :3, 3].astype(np.float32))
        self._launch.run()
