"""Where the rays of pixels beside the model's silhouette come nearest to its surface, as seen in pixels.

The mesh tells which pixels are within: those whose rays hit it. A pixel next to one of them is beside, and the point of
the mesh that its ray comes nearest to is looked for from where the other's ray hits, by closest points of the mesh.
What lies between a volume's voxels, or beyond what was seen of them, has no say: the outline is that of what is meshed.
"""

import numpy as np
import warp as wp
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from fusion.devices import SlabLaunch
from fusion.pose.coverage_kernel import NearestApproach
from fusion.pose.model_field import ModelField, sample_volume
from fusion.pose.pose_model import PoseModel

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

NOWHERE = 1.0e30
_NOWHERE, _WITHIN = wp.constant(NOWHERE), wp.constant(-NOWHERE)
_STEPS = wp.constant(6)
_OTHER_LAYER = wp.constant(0.02)
"""Of the depth, from which on two neighbours' rays hit different parts of the model."""
_LEFT_PX, _ROUNDNESS = 0.01, 0.25
"""An approach is found when the distance is right to so many pixels, on a body of a radius of this share of the
model's diameter. Along a facet the slope stays the same: up to its length times that slope it may be off by more."""
_CORRECTION_VOXELS = 0.1
"""The most that a mesh between voxels is moved to where the surface is."""
_LEAST_SLOPE = wp.constant(0.1)


@wp.struct
class Passing:
    """A ray at the time ``t`` (planar depth): the mesh's ``foot`` closest to it, and their ``distance``, metres.

    ``slope`` is what the distance grows by with t.
    """

    foot: wp.vec3
    t: float
    distance: float
    slope: float


@wp.func
def ray_through(pixel: wp.vec2, intrinsics: wp.vec4, rotation: wp.mat33) -> wp.vec3:
    """Return the ray of a pixel, along the world's axes, one metre of planar depth long; intrinsics fx, fy, cx, cy."""
    x = (pixel[0] - intrinsics[2]) / intrinsics[0]
    y = (pixel[1] - intrinsics[3]) / intrinsics[1]
    return rotation * wp.vec3(x, y, 1.0)


@wp.func
def time_of(point: wp.vec3, eye: wp.vec3, ray: wp.vec3) -> float:
    """Return when a ray is closest to a point."""
    return wp.dot(point - eye, ray) / wp.dot(ray, ray)


@wp.func
def passing_at(mesh: wp.uint64, eye: wp.vec3, ray: wp.vec3, t: float, known: wp.vec3) -> Passing:
    """Return how the ray passes the mesh at a time; ``known`` is any point of the mesh, and the closer the better."""
    passing = Passing()
    point = eye + t * ray
    passing.t = t
    passing.foot = known
    found = wp.mesh_query_point_no_sign(mesh, point, 1.0001 * wp.length(point - known) + 1.0e-6)
    if found.result:
        passing.foot = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    away = point - passing.foot
    passing.distance = wp.length(away)
    passing.slope = wp.dot(away, ray) / wp.max(passing.distance, 1.0e-9)
    return passing


@wp.func
def closest_passing(mesh: wp.uint64, eye: wp.vec3, ray: wp.vec3, start: wp.vec3, enough: float) -> Passing:
    """Return how a ray passes the mesh where it is closest to it, near a point ``start`` of the mesh.

    ``enough``: a slope whose square is less than that times the depth is none.
    """
    before = passing_at(mesh, eye, ray, time_of(start, eye, ray), start)
    best = before
    after = before
    bracketed = int(0)
    for step in range(_STEPS):
        if best.slope * best.slope < enough * best.t:
            return best
        # Towards the tangent plane: beyond where the surface bends away, or ends.
        t = before.t - before.distance / before.slope
        if bracketed == 1 and step % 2 == 1:
            # Where the surface bends evenly a secant leads farther back, and where it ends the point that is closest.
            t = before.t - before.slope * (after.t - before.t) / (after.slope - before.slope)
            end = time_of(after.foot, eye, ray)
            if wp.abs(end - after.t) > wp.abs(t - after.t):
                t = end
        elif bracketed == 1:
            # Between two sides of a sharp edge: to where their planes are equally far.
            rise = after.distance - before.distance - after.slope * (after.t - before.t)
            t = before.t + rise / (before.slope - after.slope)
        now = passing_at(mesh, eye, ray, t, best.foot)
        if now.distance < best.distance:
            best = now
        if now.slope * before.slope <= 0.0:
            after = now
            bracketed = 1
        else:
            before = now
    return best


@wp.struct
class Neighbours:
    """Of a pixel's neighbours whose rays hit the mesh: the nearest and the farthest, perhaps of different parts of it.

    ``near`` and ``far`` are planar depths, metres, ``far`` 0 where there is none; the hits are in the world.
    """

    near: float
    near_hit: wp.vec3
    far: float
    far_hit: wp.vec3


@wp.func
def neighbours_within(
    pixels: wp.array(dtype=wp.vec2),
    place: wp.vec2i,
    held: wp.array2d(dtype=int),
    hits: wp.array(dtype=float),
    first_hit: int,
    intrinsics: wp.vec4,
    rotation: wp.mat33,
    eye: wp.vec3,
) -> Neighbours:
    """Return what the eight around a place hit; a pose's ``hits`` begin at ``first_hit``."""
    found = Neighbours()
    found.near = _NOWHERE
    for row in range(wp.max(place[0] - 1, 0), wp.min(place[0] + 2, held.shape[0])):
        for column in range(wp.max(place[1] - 1, 0), wp.min(place[1] + 2, held.shape[1])):
            neighbour = held[row, column]
            if neighbour >= 0:
                t = hits[first_hit + neighbour]
                if t > 0.0:
                    hit = eye + t * ray_through(pixels[neighbour], intrinsics, rotation)
                    if t < found.near:
                        found.near = t
                        found.near_hit = hit
                    if t > found.far:
                        found.far = t
                        found.far_hit = hit
    return found


@wp.kernel
def _find_hits(
    first: int,
    mesh: wp.uint64,
    pixels: wp.array(dtype=wp.vec2),
    intrinsics: wp.vec4,
    rotations: wp.array(dtype=wp.mat33),
    eyes: wp.array(dtype=wp.vec3),
    hits: wp.array(dtype=float),
) -> None:
    index = wp.tid() + first
    pose = index / pixels.shape[0]
    ray = ray_through(pixels[index % pixels.shape[0]], intrinsics, rotations[pose])
    length = wp.length(ray)
    hit = wp.mesh_query_ray(mesh, eyes[pose], ray / length, 1.0e6)
    hits[index] = wp.where(hit.result, hit.t / length, 0.0)


@wp.kernel
def _find_approaches(
    first: int,
    mesh: wp.uint64,
    field: ModelField,
    origin: wp.vec3,
    pixels: wp.array(dtype=wp.vec2),
    places: wp.array(dtype=wp.vec2i),
    held: wp.array2d(dtype=int),
    intrinsics: wp.vec4,
    rotations: wp.array(dtype=wp.mat33),
    eyes: wp.array(dtype=wp.vec3),
    hits: wp.array(dtype=float),
    enough: float,
    correction: float,
    approaches: wp.array(dtype=NearestApproach),
    edges_px: wp.array(dtype=float),
    slopes: wp.array(dtype=wp.vec2),
) -> None:
    index = wp.tid() + first
    pose = index / pixels.shape[0]
    pixel = index % pixels.shape[0]
    approaches[index] = NearestApproach()
    slopes[index] = wp.vec2()
    edges_px[index] = wp.where(hits[index] > 0.0, _WITHIN, _NOWHERE)
    if hits[index] > 0.0:
        return
    rotation = rotations[pose]
    eye = eyes[pose]
    beside = neighbours_within(pixels, places[pixel], held, hits, index - pixel, intrinsics, rotation, eye)
    if beside.far == 0.0:
        return
    ray = ray_through(pixels[pixel], intrinsics, rotation)
    passing = closest_passing(mesh, eye, ray, beside.near_hit, enough)
    if beside.far > (1.0 + _OTHER_LAYER) * beside.near:
        other = closest_passing(mesh, eye, ray, beside.far_hit, enough)
        if other.distance * passing.t < passing.distance * other.t:
            passing = other
    if passing.t <= 0.0 or passing.distance < 1.0e-6:
        return
    found = NearestApproach()
    found.point = eye + passing.t * ray - origin
    found.normal = (eye + passing.t * ray - passing.foot) / passing.distance
    found.foot = passing.foot - origin
    # A mesh lies a little below a surface that bends between the voxels; the volume knows by how much.
    sample = sample_volume(field, found.foot)
    if sample.source != 0:
        found.foot -= wp.clamp(sample.distance, -correction, correction) * found.normal
    across = wp.transpose(rotation) * found.normal
    focal = 0.5 * (intrinsics[0] + intrinsics[1])
    slope = wp.vec2(focal * across[0] / intrinsics[0], focal * across[1] / intrinsics[1])
    # Far from the image's middle a pixel is less than its share of the distance.
    steep = wp.max(wp.length(slope), _LEAST_SLOPE)
    found.pixels_per_metre = focal / (passing.t * steep)
    approaches[index] = found
    edges_px[index] = found.pixels_per_metre * wp.dot(found.normal, found.point - found.foot)
    slopes[index] = slope / steep


class ApproachFinder:
    """Finds where the rays of n pixels come nearest to a model, from k poses at a time, in arrays that are kept.

    ``pixels`` (n, 2), (u, v), are whole. After ``find`` the arrays (k · n,), pose by pose, on the model's device, hold:
    ``approaches`` the ``NearestApproach`` of pixels beside the silhouette; ``edges_px`` their distances from its edge,
    −NOWHERE of pixels within and NOWHERE of all others; ``slopes``, vec2, unit vectors of the image along which those
    grow. ``places`` (n,) are the pixels' rows and columns in ``held``, which has the number of the pixel at a place, −1
    where there is none.
    """

    def __init__(self, model: PoseModel, camera: PinholeCamera, pixels: NDArray[np.floating], *, poses: int) -> None:
        device, size = model.device, poses * len(pixels)
        places = np.rint(np.asarray(pixels)[:, ::-1]).astype(np.int32)
        places -= places.min(axis=0)
        held = np.full(places.max(axis=0) + 1, -1, np.int32)
        held[places[:, 0], places[:, 1]] = np.arange(len(places))
        self._rotations = wp.zeros(poses, dtype=wp.mat33, device=device)
        self._eyes = wp.zeros(poses, dtype=wp.vec3, device=device)
        self.places = wp.array(places, dtype=wp.vec2i, device=device)
        self.held = wp.array(held, dtype=int, device=device)
        self.approaches = wp.zeros(size, dtype=NearestApproach, device=device)
        self.edges_px = wp.zeros(size, dtype=float, device=device)
        self.slopes = wp.zeros(size, dtype=wp.vec2, device=device)
        at = wp.array(np.asarray(pixels, np.float32), dtype=wp.vec2, device=device)
        hits = wp.zeros(size, dtype=float, device=device)
        intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        mesh = model.outline_hierarchy.id
        correction = _CORRECTION_VOXELS * model.voxel_size if model.outline is model.mesh else 0.0
        # Off by δ along the ray, the distance is off by δ²/2R, and its slope is δ/R.
        enough = 2 * _LEFT_PX / (camera.fx * _ROUNDNESS * model.diameter)
        self._launches = [
            SlabLaunch(
                _find_hits,
                dim=size,
                inputs=[mesh, at, intrinsics, self._rotations, self._eyes],
                outputs=[hits],
                device=device,
                least_slab=128,
            ),
            SlabLaunch(
                _find_approaches,
                dim=size,
                inputs=[
                    *(mesh, model.field, wp.vec3(*model.origin_world.tolist()), at, self.places, self.held, intrinsics),
                    *(self._rotations, self._eyes, hits, enough, correction),
                ],
                outputs=[self.approaches, self.edges_px, self.slopes],
                device=device,
                least_slab=128,
            ),
        ]

    def find(self, world_from_camera: NDArray[np.float64]) -> None:
        """Look from poses (k, 4, 4)."""
        self._rotations.assign(world_from_camera[:, :3, :3].astype(np.float32))
        self._eyes.assign(world_from_camera[:, :3, 3].astype(np.float32))
        for launch in self._launches:
            launch.run()
