"""Recordings of random scenes made of primitives, ray-cast with Embree: exact depth, colour, poses and mesh.

And what can be wrong with a recording: each corruption is what a careless exporter does.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, Part
from datagen.dataset_check.ray_casting import MeshRays
from datagen.dataset_format import FRAMES_FOLDER, GROUND_TRUTH_FILE, Intrinsics, Metadata, write_metadata
from datagen.dataset_writer import write_frame
from datagen.rigid import Matrix, inverse, look_at

SCENES = ("table", "object", "room")
SIZES = ((160, 120), (128, 96), (200, 150), (120, 160))
BACKGROUND = (90, 110, 140)


@dataclass(frozen=True, kw_only=True)
class Recording:
    """A dataset before it is written: what the files will say."""

    camera: PinholeCamera
    depth_scale: float
    colors: tuple[NDArray[np.uint8], ...]
    depths: tuple[NDArray[np.float32], ...]
    poses: tuple[Matrix, ...]
    mesh: trimesh.Trimesh
    true_depth_scale: float

    def in_memory(self, mesh: Path | None) -> "MemoryDataset":
        """The dataset that ``write`` would make, without the files; ``mesh`` is a file of the ground truth."""
        return MemoryDataset(
            folder=Path("in memory"),
            format_name="memory",
            frames=dict.fromkeys(range(len(self.poses))),
            camera=self.camera,
            depth_scale=self.depth_scale,
            ground_truth_mesh=mesh,
            recording=self,
        )

    def write(self, folder: Path, *, with_mesh: bool) -> Path:
        for i, (color, depth, pose) in enumerate(zip(self.colors, self.depths, self.poses, strict=True)):
            write_frame(
                folder / FRAMES_FOLDER,
                i,
                color=color,
                depth=depth,
                world_from_camera=pose,
                depth_scale=self.true_depth_scale,
            )
        if with_mesh:
            (folder / GROUND_TRUTH_FILE).parent.mkdir(parents=True, exist_ok=True)
            self.mesh.export(folder / GROUND_TRUTH_FILE)
        self.write_metadata(folder, with_mesh=with_mesh)
        return folder

    def write_metadata(self, folder: Path, *, with_mesh: bool) -> None:
        names = ("width", "height", "fx", "fy", "cx", "cy")
        metadata = Metadata(
            frame_count=len(self.poses),
            intrinsics=Intrinsics(**{name: getattr(self.camera, name) for name in names}),
            depth_scale=self.depth_scale,
            frames_per_second=30.0,
            ground_truth_mesh=GROUND_TRUTH_FILE if with_mesh else None,
            recipe={},
            provenance={},
        )
        write_metadata(folder, metadata)


@dataclass(frozen=True, kw_only=True, eq=False)
class MemoryDataset(Dataset):
    """A recording that is a dataset without having been written."""

    recording: Recording

    def color(self, frame_id: int) -> NDArray[np.uint8]:
        return self.recording.colors[frame_id]

    def depth(self, frame_id: int) -> NDArray[np.float32]:
        steps = np.rint(self.recording.depths[frame_id].astype(np.float64) / self.recording.true_depth_scale)
        return steps.astype(np.float32) * np.float32(self.depth_scale)

    def world_from_camera(self, frame_id: int) -> Matrix:
        return self.recording.poses[frame_id]

    def has(self, frame_id: int, part: Part) -> bool:  # noqa: ARG002
        return True


# --- scenes -----------------------------------------------------------------------------------------------------------


def _blob(rng: np.random.Generator) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=4)
    bumps = sum(
        amplitude * np.sin(mesh.vertices @ direction + phase)
        for amplitude, direction, phase in zip(
            rng.uniform(0.03, 0.12, 5), rng.normal(0, 2.5, (5, 3)), rng.uniform(0, 6, 5), strict=True
        )
    )
    return trimesh.Trimesh(mesh.vertices * (1 + bumps)[:, None], mesh.faces, process=False)


def _primitive(rng: np.random.Generator, size: float) -> trimesh.Trimesh:
    create = trimesh.creation
    makers: tuple[Callable[[], trimesh.Trimesh], ...] = (
        lambda: create.box(rng.uniform(0.8, 2, 3)),
        lambda: create.cylinder(radius=rng.uniform(0.5, 1), height=rng.uniform(1, 2), sections=48),
        lambda: create.torus(major_radius=1.0, minor_radius=rng.uniform(0.25, 0.5)),
        lambda: create.cone(radius=1.0, height=rng.uniform(1, 2), sections=48),
        lambda: create.capsule(radius=0.6, height=rng.uniform(0.5, 1.5)),
        lambda: _blob(rng),
    )
    mesh = makers[rng.integers(len(makers))]()
    mesh.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    mesh.apply_scale(size)
    return mesh


def _scene_parts(kind: str, rng: np.random.Generator) -> list[trimesh.Trimesh]:
    if kind == "object":
        parts = [_primitive(rng, 0.2) for _ in range(3)]
        for part in parts:
            part.apply_translation(rng.uniform(-0.15, 0.15, 3))
        return parts
    parts = [_primitive(rng, rng.uniform(0.08, 0.2)) for _ in range(7)]
    for part in parts:
        part.apply_translation([*rng.uniform(-0.6, 0.6, 2), -part.bounds[0, 2]])
    if kind == "table":
        floor = trimesh.creation.box((2.4, 2.0, 0.05))
        floor.apply_translation((0, 0, -0.025))
        return [*parts, floor]
    walls = trimesh.creation.box((4.0, 3.4, 2.4))
    walls.apply_translation((0, 0, 1.2))
    furniture = [trimesh.creation.box(rng.uniform(0.3, 1.0, 3)) for _ in range(6)]
    for box in furniture:
        angle = rng.uniform(0, 2 * np.pi)
        box.apply_translation((1.6 * np.cos(angle), 1.3 * np.sin(angle), rng.uniform(0.1, 1.2)))
    return [*parts, walls, *furniture]


def _path(kind: str, count: int, rng: np.random.Generator) -> tuple[Matrix, ...]:
    """Handheld: an arc of uneven speed, with sway, around what is looked at, or about the middle of the room."""
    time = np.linspace(0, 1, count)

    def sway(size: float, fastest: float = 5.0) -> NDArray[np.float64]:
        waves = [rng.normal() * np.sin(2 * np.pi * rng.uniform(0.5, fastest) * time + rng.uniform(0, 6)) for _ in "abc"]
        return size * sum(waves)

    arc = rng.uniform(1.0, 5.0) * (1 if rng.random() < 0.5 else -1)
    azimuth = rng.uniform(0, 6) + arc * (time + 0.08 * np.sin(2 * np.pi * time * rng.uniform(1, 3))) + sway(0.02)
    elevation = rng.uniform(0.4, 0.8) + sway(0.08, 2.0)
    distance = {"object": 0.9, "table": 1.5, "room": 1.2}[kind] * rng.uniform(0.9, 1.2) + sway(0.03, 2.0)
    if kind == "room":
        elevation = elevation + 0.2
    position = distance * np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    target = np.array([sway(0.03), sway(0.03), sway(0.03)])
    roll = sway(0.03)
    poses = []
    for i in range(count):
        pose = look_at(position[:, i], target[:, i])
        if kind == "room" and arc > 0:  # looks outwards, at walls and furniture
            pose = look_at(position[:, i] * (0.5, 0.5, 1), position[:, i] * (1.5, 1.5, 0.6) + target[:, i])
        c, s = np.cos(roll[i]), np.sin(roll[i])
        pose[:3, :3] = pose[:3, :3] @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        poses.append(pose)
    return tuple(poses)


def record(seed: int, *, frames: int = 40, kind: str | None = None, size: tuple[int, int] | None = None) -> Recording:
    """Make a random clean recording; every third is without texture."""
    rng = np.random.default_rng([seed, 71])
    kind = kind or SCENES[seed % len(SCENES)]
    width, height = size or SIZES[rng.integers(len(SIZES))]
    focal = max(width, height) * rng.uniform(0.8, 1.3)
    camera = PinholeCamera(
        width=width,
        height=height,
        fx=focal,
        fy=focal * rng.uniform(0.97, 1.03),
        cx=(width - 1) / 2 + rng.uniform(-4, 4),
        cy=(height - 1) / 2 + rng.uniform(-4, 4),
    )
    parts = _scene_parts(kind, rng)
    mesh = trimesh.util.concatenate(parts)
    part_of_triangle = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
    poses = _path(kind, frames, rng)
    palette = rng.uniform(60, 220, (len(parts), 3))
    waves = rng.normal(0, 25, (3, 3)) if rng.random() < 2 / 3 else np.zeros((3, 3))
    rays = MeshRays(mesh.vertices, mesh.faces)
    images = [_ray_cast(rays, mesh, camera, pose, palette[part_of_triangle], waves) for pose in poses]
    scale = 0.0002 if kind == "room" else 0.0001
    return Recording(
        camera=camera,
        depth_scale=scale,
        true_depth_scale=scale,
        colors=tuple(color for color, _ in images),
        depths=tuple(depth for _, depth in images),
        poses=poses,
        mesh=mesh,
    )


def _ray_cast(
    mesh_rays: MeshRays,
    mesh: trimesh.Trimesh,
    camera: PinholeCamera,
    pose: Matrix,
    triangle_colors: NDArray[np.float64],
    waves: NDArray[np.float64],
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    rays = (camera.back_project(np.ones((camera.height, camera.width))) @ pose[:3, :3].T).reshape(-1, 3)
    depth, triangle = mesh_rays.cast(np.broadcast_to(pose[:3, 3], rays.shape), rays)
    hit = np.isfinite(depth)
    color = np.tile(np.array(BACKGROUND, np.float64), (len(rays), 1))
    points = pose[:3, 3] + rays[hit] * depth[hit, None]
    light = 0.55 + 0.45 * np.abs(mesh.face_normals[triangle[hit]] @ np.array([0.36, 0.48, 0.8]))
    pattern = 1 + 0.35 * np.sign(np.sin(points @ waves)).prod(axis=1) * (waves != 0).any()
    color[hit] = triangle_colors[triangle[hit]] * (light * pattern)[:, None]
    shape = (camera.height, camera.width)
    depth = np.where(hit, depth, 0).reshape(shape).astype(np.float32)
    return np.clip(color, 0, 255).astype(np.uint8).reshape(*shape, 3), depth


# --- what goes wrong --------------------------------------------------------------------------------------------------


def half_pixel(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """Pixel centres at +0.5 taken for integer ones, or the other way round."""
    shift = float(rng.choice((-0.5, 0.5)))
    camera = replace(clean.camera, cx=clean.camera.cx + shift, cy=clean.camera.cy + shift)
    return replace(clean, camera=camera), f"{shift:+}"


def flipped_axis(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """Camera axes of OpenGL, or other two flipped; or images stored with rows or columns running backwards."""
    case = rng.integers(5)
    if case < 3:
        axes = ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))[case if rng.random() < 0.5 else 0]
        return replace(clean, poses=tuple(pose @ np.diag([*axes, 1.0]) for pose in clean.poses)), f"axes {axes}"
    rows = case == 3

    def turn(image: NDArray) -> NDArray:
        return np.ascontiguousarray(image[::-1] if rows else image[:, ::-1])

    return (
        replace(clean, colors=tuple(map(turn, clean.colors)), depths=tuple(map(turn, clean.depths))),
        "rows backwards" if rows else "columns backwards",
    )


def inverse_pose(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """camera_from_world stored as world_from_camera."""
    return replace(clean, poses=tuple(inverse(pose) for pose in clean.poses)), ""


def ray_distance(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """The length along the ray in place of planar depth."""
    length = np.linalg.norm(clean.camera.back_project(np.ones(clean.depths[0].shape)), axis=-1)
    return replace(clean, depths=tuple((depth * length).astype(np.float32) for depth in clean.depths)), ""


def depth_scale(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """1 to 20 per cent off, or 1000 and 5000 steps a metre confused."""
    factor = float(np.exp(rng.choice((-1, 1)) * rng.uniform(np.log(1.01), np.log(1.2))))
    if rng.random() < 0.25:
        factor = float(rng.choice((0.2, 5.0)))
    return replace(clean, depth_scale=clean.depth_scale * factor), f"×{factor:.4f}"


def focal_length(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """2 to 20 per cent off: both, or one alone."""
    factor = float(np.exp(rng.choice((-1, 1)) * rng.uniform(np.log(1.02), np.log(1.2))))
    which = ("both", "fx", "fy")[rng.integers(3)]
    camera = clean.camera
    fx = camera.fx * (factor if which != "fy" else 1)
    fy = camera.fy * (factor if which != "fx" else 1)
    return replace(clean, camera=replace(camera, fx=fx, fy=fy)), f"{which} ×{factor:.4f}"


def color_offset(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """Colour 2 to 8 px beside depth."""
    angle, size = rng.uniform(0, 2 * np.pi), rng.uniform(2, 8)
    dx, dy = round(size * np.cos(angle)), round(size * np.sin(angle))
    height, width = clean.depths[0].shape
    rows = np.clip(np.arange(height) - dy, 0, height - 1)
    columns = np.clip(np.arange(width) - dx, 0, width - 1)
    return replace(clean, colors=tuple(color[rows][:, columns] for color in clean.colors)), f"({dx}, {dy}) px"


def time_shift(clean: Recording, rng: np.random.Generator) -> tuple[Recording, str]:
    """Poses 1 to 5 frames early or late."""
    shift = int(rng.integers(1, 6))
    if rng.random() < 0.5:
        return replace(clean, colors=clean.colors[shift:], depths=clean.depths[shift:], poses=clean.poses[:-shift]), (
            f"poses {shift} late"
        )
    return replace(clean, colors=clean.colors[:-shift], depths=clean.depths[:-shift], poses=clean.poses[shift:]), (
        f"poses {shift} early"
    )


CORRUPTIONS = {
    "half-pixel": half_pixel,
    "flipped-axis": flipped_axis,
    "inverse-pose": inverse_pose,
    "ray-distance": ray_distance,
    "depth-scale": depth_scale,
    "focal-length": focal_length,
    "color-offset": color_offset,
    "time-shift": time_shift,
}
"""By the kind of the finding that must name it."""


def with_sensor_noise(clean: Recording, rng: np.random.Generator) -> Recording:
    """As a structured-light camera would see it: noise growing with depth squared, disparity steps, lost edges."""
    depths = []
    for depth in clean.depths:
        seen = depth > 0
        noisy = depth + rng.normal(size=depth.shape) * (0.0008 + 0.0016 * np.maximum(depth - 0.4, 0) ** 2)
        step = 2.0e-3 * depth**2
        noisy = np.where(seen, np.rint(noisy / np.maximum(step, 1e-6)) * step, 0)
        slope = np.hypot(*np.gradient(depth)) > 0.03 * depth
        noisy[slope | (rng.random(depth.shape) < 0.01)] = 0
        depths.append(noisy.astype(np.float32))
    return replace(clean, depths=tuple(depths))
