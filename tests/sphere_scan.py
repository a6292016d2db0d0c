"""A reconstruction of a coloured sphere, written by independent tools."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from datagen.camera import PinholeCamera
from datagen.dataset_format import FRAMES_FOLDER, Intrinsics, Metadata, frame_file, write_metadata
from datagen.images import write_color, write_depth
from datagen.rigid import look_at

CENTRE_WORLD = np.array([0.1, -0.2, 0.3])
RADIUS_M = 0.5
CAMERA = PinholeCamera(width=160, height=120, fx=151.0, fy=148.5, cx=82.3, cy=56.1)
BACKGROUND_SRGB = 225
FRAMES = 12
QUERIES = (5, 8)


@dataclass(frozen=True)
class SphereScan:
    """A reconstruction folder of a sphere and what was written into it."""

    folder: Path
    dataset: Path
    mesh: trimesh.Trimesh
    camera: PinholeCamera
    record: dict[str, Any]
    poses: list[dict[str, Any]]

    def rewrite(self) -> None:
        (self.folder / "reconstruction.json").write_text(json.dumps(self.record))
        (self.folder / "poses.json").write_text(json.dumps(self.poses))


def make_sphere_scan(folder: Path) -> SphereScan:
    """Write a reconstruction into ``folder``, which is made, its dataset within."""
    dataset = folder / "dataset"
    cameras = [_ring_pose(frame) for frame in range(FRAMES)]
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS_M)
    mesh.visual.vertex_colors = np.column_stack([_color(mesh.vertices), np.full(len(mesh.vertices), 255, np.uint8)])
    mesh.apply_translation(CENTRE_WORLD)
    folder.mkdir()
    mesh.export(folder / "mesh.ply")
    _write_dataset(dataset, cameras)
    fused = [frame for frame in range(FRAMES) if frame not in QUERIES]
    record = {
        "format": "scanback-reconstruction",
        "version": 1,
        "dataset": "dataset",
        "frames": len(fused),
        "camera": Intrinsics(**vars(CAMERA)).model_dump(),
        "trajectory": [{"frame": i, "world_from_camera": cameras[i].tolist()} for i in fused],
    }
    poses = [
        {"query": i, "nearest": i - 1, "score": 0.01 / i, "world_from_camera": cameras[i - 1].tolist()} for i in QUERIES
    ]
    poses[0] |= {"rotation_error_deg": 20.5, "translation_error_m": 0.25}
    scan = SphereScan(folder, dataset, mesh, CAMERA, record, poses)
    scan.rewrite()
    return scan


def _ring_pose(frame: int) -> np.ndarray:
    angle = 2 * np.pi * frame / FRAMES
    offset = np.array([1.8 * np.cos(angle), 1.8 * np.sin(angle), 0.7 + 0.1 * np.sin(3 * angle)])
    return look_at(CENTRE_WORLD + offset, CENTRE_WORLD)


def _color(directions: np.ndarray) -> np.ndarray:
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    return np.rint(127.5 + 120 * np.sin(2.5 * unit + (0, 1, 2))).astype(np.uint8)


def _write_dataset(folder: Path, cameras: list[np.ndarray]) -> None:
    frames = folder / FRAMES_FOLDER
    for i, world_from_camera in enumerate(cameras):
        color, depth = _photograph(world_from_camera)
        write_color(frame_file(frames, i, "color.png"), color)
        write_depth(frame_file(frames, i, "depth.png"), depth, metres_per_step=1e-4)
        np.savetxt(frame_file(frames, i, "pose.txt"), world_from_camera, fmt="%.17g")
    metadata = Metadata(
        frame_count=len(cameras),
        intrinsics=Intrinsics(**vars(CAMERA)),
        depth_scale=1e-4,
        frames_per_second=24.0,
        recipe={},
        provenance={},
    )
    write_metadata(folder, metadata)


def _photograph(world_from_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return colour and planar depth of the sphere, from the quadratic for the ray through each pixel's centre."""
    rays = CAMERA.back_project(np.ones((CAMERA.height, CAMERA.width))) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3] - CENTRE_WORLD
    a, b, c = (rays * rays).sum(-1), rays @ origin, origin @ origin - RADIUS_M**2
    discriminant = b * b - a * c
    hit = discriminant > 0
    depth = np.where(hit, (-b - np.sqrt(np.maximum(discriminant, 0))) / a, 0)
    color = np.full((*hit.shape, 3), BACKGROUND_SRGB, dtype=np.uint8)
    color[hit] = _color((origin + depth[..., None] * rays)[hit])
    return color, depth
