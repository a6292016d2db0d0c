"""A sphere, Suzanne and a table, with depth images that are exact at the pixels' centres."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
import warp as wp

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at
from fusion.devices import launch_in_slabs
from fusion.evaluation.evaluate import SurfaceSamples, sample_surface
from fusion.evaluation.observed_surface import PointMarks
from fusion.frames.frame_batch import MAX_BATCH, FrameUploader
from fusion.surface.closest_points import closest_points
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

wp.set_module_options({"enable_backward": False})

CAMERA = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
SAMPLES = 200_000
WELL_SEEN_VIEWS, WELL_SEEN_COSINE = 3, 0.3
SPHERE_CENTRE, SPHERE_RADIUS = np.array([0.013, -0.021, 0.034]), 0.25


@wp.kernel
def _see_points(
    first: int,
    mesh: wp.uint64,
    poses: wp.array(dtype=wp.mat44),
    camera_from_world: wp.array(dtype=wp.mat44),
    intrinsics: wp.vec4,
    width: float,
    height: float,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    least_cosine: float,
    enough: int,
    views: wp.array2d(dtype=int),
):
    index = wp.tid() + first
    for frame in range(poses.shape[0]):
        if views[index, 1] < enough:
            local = wp.transform_point(camera_from_world[frame], points[index])
            u = intrinsics[0] * local[0] / local[2] + intrinsics[2]
            v = intrinsics[1] * local[1] / local[2] + intrinsics[3]
            if local[2] > 0.0 and u > -0.5 and v > -0.5 and u < width - 0.5 and v < height - 0.5:
                origin = wp.transform_point(poses[frame], wp.vec3(0.0, 0.0, 0.0))
                way = points[index] - origin
                distance = wp.length(way)
                hit = wp.mesh_query_ray(mesh, origin, way / distance, distance - 1.0e-5)
                if not hit.result:
                    views[index, 0] += 1
                    if wp.abs(wp.dot(way, normals[index])) >= least_cosine * distance:
                        views[index, 1] += 1


@dataclass
class Scene(ABC):
    """The poses that a surface is seen from, and what the camera sees there, exactly."""

    name: str
    poses: list
    device: object
    camera: PinholeCamera = CAMERA

    @abstractmethod
    def depth(self, frame):
        """Return the depth image of a frame."""

    @cached_property
    def depths(self):
        return [self.depth(i) for i in range(len(self.poses))]

    @cached_property
    def colors(self):
        """By position: a cube of 0.5 m from black to white, and over again."""
        colors = []
        for depth, pose in zip(self.depths, self.poses, strict=True):
            points = self.camera.back_project(depth) @ pose[:3, :3].T + pose[:3, 3]
            colors.append(np.uint8(255 * np.abs((2 * points) % 2 - 1)))
        return colors


class TrueScene(Scene):
    """A scene that knows its surface, so that a mesh can be held against it."""

    @abstractmethod
    def distances(self, points):
        """Return distances (n,) from points to the surface, and its unit normals (n, 3) there."""


class SphereScene(TrueScene):
    """In closed form, not by triangles."""

    def depth(self, frame):
        pose = self.poses[frame]
        rays = self.camera.back_project(np.ones((self.camera.height, self.camera.width))) @ pose[:3, :3].T
        offset = pose[:3, 3] - SPHERE_CENTRE
        a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - SPHERE_RADIUS**2
        root = b**2 - a * c
        return np.where(root > 0, (-b - np.sqrt(np.maximum(root, 0))) / a, 0).astype(np.float32)

    def distances(self, points):
        offsets = points - SPHERE_CENTRE
        radii = np.linalg.norm(offsets, axis=1)
        return np.abs(radii - SPHERE_RADIUS), offsets / radii[:, None]

    @cached_property
    def in_sight(self):
        directions = np.random.default_rng(0).normal(size=(SAMPLES, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return SurfaceSamples(points=SPHERE_CENTRE + SPHERE_RADIUS * directions, normals=directions)

    @property
    def is_observed(self):
        return np.ones(SAMPLES, dtype=bool)

    is_well_seen = is_observed

    @property
    def observed_area(self):
        return 4 * np.pi * SPHERE_RADIUS**2


class MeshScene(TrueScene):
    def __init__(self, name, mesh, poses, device, camera=CAMERA):
        super().__init__(name, poses, device, camera)
        self.mesh = mesh
        self._hierarchy = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=device),
            indices=wp.array(mesh.triangles.ravel(), dtype=int, device=device),
        )
        self._intrinsics = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        corners = mesh.vertices.astype(np.float64)[mesh.triangles]
        self._normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self.area = np.linalg.norm(self._normals, axis=1).sum() / 2
        self._normals /= np.maximum(np.linalg.norm(self._normals, axis=1, keepdims=True), 1e-300)

    def _matrices(self, matrices):
        return wp.array(np.stack(matrices).astype(np.float32), dtype=wp.mat44, device=self.device)

    def depth(self, frame):
        return self._depths[frame]

    @cached_property
    def _depths(self):
        hits = cast_rays_at_mesh(self.mesh, self.camera, self.poses, device=self.device, depth_only=True)
        return hits.depth.numpy()

    def distances(self, points):
        closest = closest_points(self.mesh, points, device=self.device)
        return closest.distances, self._normals[closest.triangles]

    @cached_property
    def _views(self):
        samples = sample_surface(self.mesh, SAMPLES, rng=np.random.default_rng(0))
        views = wp.zeros((SAMPLES, 2), dtype=int, device=self.device)
        inputs = [
            self._hierarchy.id,
            self._matrices(self.poses),
            self._matrices([inverse(pose) for pose in self.poses]),
            self._intrinsics,
            float(self.camera.width),
            float(self.camera.height),
            wp.array(samples.points.astype(np.float32), dtype=wp.vec3, device=self.device),
            wp.array(samples.normals.astype(np.float32), dtype=wp.vec3, device=self.device),
            WELL_SEEN_COSINE,
            WELL_SEEN_VIEWS,
        ]
        launch_in_slabs(_see_points, dim=SAMPLES, inputs=inputs, outputs=[views], device=self.device)
        return samples, views.numpy()

    @cached_property
    def in_sight(self):
        """What a line of sight from some camera reaches."""
        samples, views = self._views
        seen = views[:, 0] > 0
        return SurfaceSamples(points=samples.points[seen], normals=samples.normals[seen])

    @cached_property
    def is_observed(self):
        """Which of the samples in sight the depth images observed."""
        marks = PointMarks(self.in_sight.points, self.in_sight.normals, self.mesh, device=self.device)
        upload = FrameUploader(self.camera, device=self.device)
        for first in range(0, len(self.poses), MAX_BATCH):
            marks.mark(upload(self.depths[first : first + MAX_BATCH], self.poses[first : first + MAX_BATCH]))
        return marks.observed()

    @property
    def is_well_seen(self):
        """Which of the samples in sight."""
        _, views = self._views
        return views[views[:, 0] > 0, 1] >= WELL_SEEN_VIEWS

    @property
    def observed_area(self):
        return self.area * self.is_observed.sum() / SAMPLES


def poses_around(count, *, centre, nearest, farthest, lowest=-1.0, highest=1.0):
    """Return poses on a Fibonacci lattice between two heights of the unit sphere, at distances that vary."""
    index = np.arange(count) + 0.5
    height = lowest + (highest - lowest) * index / count
    azimuth = np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - height**2)
    directions = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), height], -1)
    distances = nearest + (farthest - nearest) * (0.5 + 0.5 * np.cos(2.4 * index))
    return [look_at(np.add(centre, d * way), centre) for d, way in zip(distances, directions, strict=True)]


def suzanne_mesh(path):
    """Return Blender's monkey, subdivided twice, 0.5 m wide; through bpy, or what a file holds."""
    if path:
        return read_mesh(path)
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.ops.mesh.primitive_monkey_add()
    monkey = bpy.context.object
    monkey.modifiers.new("subdivision", "SUBSURF").levels = 2
    evaluated = monkey.evaluated_get(bpy.context.evaluated_depsgraph_get()).to_mesh()
    evaluated.calc_loop_triangles()
    vertices = np.array([vertex.co for vertex in evaluated.vertices])
    triangles = np.array([triangle.vertices for triangle in evaluated.loop_triangles], dtype=np.int32)
    vertices *= 0.5 / np.ptp(vertices[:, 0])
    # Off the lattice, so that no plane of symmetry falls on voxel centres.
    return Mesh(vertices=(vertices + np.array([0.0013, 0.0021, 0.0007])).astype(np.float32), triangles=triangles)


def table_mesh():
    """Return a table 1 m wide with things on it, of closed parts that stand a little into each other."""
    rng = np.random.default_rng(3)

    def at(part, x, y, z, turn=0.0, tilt=0.0):
        part.apply_transform(trimesh.transformations.euler_matrix(tilt, 0.0, turn))
        part.apply_translation([x, y, z - part.bounds[0, 2]])
        return part

    box, top = trimesh.creation.box, 0.43
    parts = [at(box((1.0, 0.7, 0.03)), 0, 0, 0.4)]
    parts += [at(box((0.05, 0.05, 0.41)), x, y, 0) for x in (-0.45, 0.45) for y in (-0.3, 0.3)]
    profile = [(0.07 * np.sin(a), 0.07 - 0.07 * np.cos(a)) for a in np.linspace(0, np.pi / 2, 33)]
    inner = [(0.064 * np.sin(a), 0.07 - 0.064 * np.cos(a)) for a in np.linspace(np.pi / 2, 0, 33)]
    mug = trimesh.creation.annulus(r_min=0.036, r_max=0.041, height=0.1, sections=128)
    floor = trimesh.creation.cylinder(radius=0.038, height=0.006, sections=128)
    parts += [
        at(mug, -0.2, 0.1, top - 0.002),
        at(floor, -0.2, 0.1, top - 0.002),
        at(trimesh.creation.revolve(np.array(profile + inner), sections=128), 0.25, -0.12, top - 0.002),
        at(box((0.16, 0.1, 0.07)), 0.05, 0.2, top - 0.002, turn=0.4),
        at(box((0.06, 0.2, 0.025)), -0.05, -0.2, top - 0.002, turn=-0.9),
        at(box((0.05, 0.05, 0.12)), -0.38, -0.15, top - 0.002, turn=0.2),
        at(trimesh.creation.icosphere(subdivisions=5, radius=0.06), 0.33, 0.15, top - 0.002),
        at(trimesh.creation.cone(radius=0.05, height=0.12, sections=128), -0.36, 0.2, top - 0.002),
        at(trimesh.creation.capsule(height=0.1, radius=0.02, count=[64, 64]), 0.02, -0.02, top - 0.002, tilt=np.pi / 2),
    ]
    whole = trimesh.util.concatenate(parts)
    whole.apply_transform(trimesh.transformations.rotation_matrix(0.3, [0, 0, 1]))
    whole.apply_translation(rng.uniform(-0.004, 0.004, 3))
    return Mesh(vertices=whole.vertices.astype(np.float32), triangles=whole.faces.astype(np.int32))


def camera_of_width(width):
    """Return the camera with images of another width, and as many more or fewer rows."""
    scale = width / CAMERA.width
    return PinholeCamera(
        width=width,
        height=round(scale * CAMERA.height),
        fx=scale * CAMERA.fx,
        fy=scale * CAMERA.fy,
        cx=scale * (CAMERA.cx + 0.5) - 0.5,
        cy=scale * (CAMERA.cy + 0.5) - 0.5,
    )


def make_scene(name, options, device, *, camera=CAMERA, all_round=False):
    """Return a scene of ``options.views`` frames; a table is seen from above alone unless from ``all_round``."""
    if name == "sphere":
        poses = poses_around(options.views, centre=SPHERE_CENTRE, nearest=0.9, farthest=1.1)
        return SphereScene(name, poses, device, camera)
    if name == "suzanne":
        mesh = suzanne_mesh(options.mesh)
        centre = (mesh.vertices.max(0) + mesh.vertices.min(0)) / 2
        poses = poses_around(options.views, centre=centre, nearest=0.9, farthest=1.1)
        return MeshScene(name, mesh, poses, device, camera)
    around = {"centre": (0.0, 0.0, 0.42), "nearest": 0.6, "farthest": 1.5}
    around |= {"lowest": -0.97 if all_round else 0.05, "highest": 0.97}
    return MeshScene(name, table_mesh(), poses_around(options.views * 4 // 3, **around), device, camera)
