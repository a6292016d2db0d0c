"""Frames whose every pixel is known in closed form: a sphere before a wall, ray-cast with NumPy."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Frame
from datagen.dataset_format import FRAMES_FOLDER, Intrinsics, Metadata, write_metadata
from datagen.dataset_writer import write_frame
from datagen.rigid import Matrix, look_at

CAMERA = PinholeCamera(width=160, height=120, fx=170.0, fy=165.0, cx=81.3, cy=58.6)
DEPTH_SCALE = 0.0001


@dataclass(frozen=True)
class SphereScene:
    """A sphere, its red and blue halves divided at x = centre.

    If wanted there is a green wall too: the part within 2 m of the plane z = ``wall_z``.
    """

    centre: tuple[float, float, float] = (0.1, -0.05, 0.2)
    radius: float = 0.3
    wall_z: float | None = None

    def frame(self, frame_id: int, world_from_camera: Matrix, camera: PinholeCamera = CAMERA) -> Frame:
        """Ray-cast one frame; depth is exact to float32."""
        rays_camera = camera.back_project(np.ones((camera.height, camera.width)))
        rays = rays_camera @ world_from_camera[:3, :3].T
        origin = world_from_camera[:3, 3]
        depth = np.full(rays.shape[:2], np.inf)
        color = np.zeros((*rays.shape[:2], 3), np.uint8)
        offset = origin - np.array(self.centre)
        a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - self.radius**2
        discriminant = b**2 - a * c
        hit = discriminant > 0
        # The rays have z = 1 in the camera: the ray's parameter is planar depth.
        depth[hit] = ((-b - np.sqrt(np.where(hit, discriminant, 0))) / a)[hit]
        if self.wall_z is not None:
            with np.errstate(divide="ignore", invalid="ignore"):
                wall = (self.wall_z - origin[2]) / rays[..., 2]
                reach = np.linalg.norm(origin + rays * wall[..., None] - self.centre, axis=-1)
            nearer = (wall > 0) & (wall < depth) & (reach < 2)
            depth[nearer] = wall[nearer]
            color[nearer] = (20, 200, 20)
            hit = hit & ~nearer
        red = (origin[0] + rays[..., 0] * np.where(hit, depth, 0)) > self.centre[0]
        color[hit & red] = (200, 40, 20)
        color[hit & ~red] = (20, 40, 200)
        depth[~np.isfinite(depth)] = 0
        return Frame(
            frame_id=frame_id, color=color, depth=depth.astype(np.float32), world_from_camera=world_from_camera
        )

    def poses_around(self, count: int, *, distance: float = 1.0) -> list[Matrix]:
        """Return camera poses spread over the whole sphere of directions (a Fibonacci lattice), all facing it."""
        index = np.arange(count) + 0.5
        polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
        directions = np.stack(
            [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1
        )
        return [look_at(np.array(self.centre) + distance * way, self.centre) for way in directions]

    def frames_around(self, count: int, *, distance: float = 1.0) -> list[Frame]:
        return [self.frame(i, pose) for i, pose in enumerate(self.poses_around(count, distance=distance))]


def write_dataset(
    folder: Path,
    frames: list[Frame],
    camera: PinholeCamera = CAMERA,
    *,
    depth_scale: float = DEPTH_SCALE,
    **metadata: object,
) -> Path:
    """Write frames as a dataset in our format."""
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    for frame in frames:
        write_frame(
            folder / FRAMES_FOLDER,
            frame.frame_id,
            color=frame.color,
            depth=frame.depth,
            world_from_camera=frame.world_from_camera,
            depth_scale=depth_scale,
        )
    fields = {
        "frame_count": len(frames),
        "intrinsics": Intrinsics(**intrinsics),
        "depth_scale": depth_scale,
        "frames_per_second": 30.0,
        "recipe": {},
        "provenance": {},
    }
    write_metadata(folder, Metadata(**(fields | metadata)))
    return folder


def icosphere(scene: SphereScene, subdivisions: int = 5) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the sphere's vertices (n, 3) in the world and triangles (m, 3)."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=scene.radius)
    return mesh.vertices + np.array(scene.centre), mesh.faces
