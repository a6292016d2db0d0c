"""A CAD mesh, or the points of a model's surface, as what views are located in: seen from around."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import Matrix, look_at
from fusion.devices import Device
from fusion.pose.se3 import exp_se3
from fusion.pose.shape_volume import volume_from_mesh, volume_from_points
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import Hierarchy, cast_rays_at_mesh, mesh_hierarchy
from fusion.volume.tsdf_volume import Volume

MESH_SUFFIXES = (".ply", ".obj", ".glb", ".gltf", ".stl", ".off", ".xyz")
VOXELS_ACROSS = 128
"""Of the volume that stands for the model, along its box's diagonal."""

DIRECTIONS, ROLLS = 100, 8
"""Views that a model is looked at from: some 20° apart, each turned about its line of sight by 45°."""

_FILLED = 0.8
"""Of the image's shorter side, by the model."""
_SIDES_ASKED = 12
_PLAIN = 170
_LIGHT_FROM_CAMERA = 0.75


@dataclass(frozen=True, kw_only=True, eq=False)
class CadModel:
    """A model's surface, metres, in its file's frame (glTF's turned so that z is up).

    ``mesh`` has triangles but where only ``points`` (n, 3) are known. ``texture`` (h, w, 3) uint8 RGB with ``uv``
    (vertices, 2), origin at the lower left, where it has one.
    """

    source: str
    mesh: Mesh | None
    points: NDArray[np.float64]
    texture: NDArray[np.uint8] | None = None
    uv: NDArray[np.float64] | None = None

    @property
    def diameter(self) -> float:
        """The diagonal of its box, metres."""
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    @property
    def colored(self) -> bool:
        """Whether it has colours in which features can be found."""
        return self.texture is not None or (self.mesh is not None and self.mesh.colors is not None)

    def volume(self, *, device: Device, voxels_across: int = VOXELS_ACROSS) -> Volume:
        """Return the volume of its shape; raises InputError for points that do not tell a surface."""
        voxel_size = self.diameter / voxels_across
        if self.mesh is None:
            return volume_from_points(self.points, voxel_size=voxel_size, device=device)
        return volume_from_mesh(_outside_out(self.mesh), voxel_size=voxel_size, device=device)

    def kept_by(self, surface: Mesh, *, within: float, device: Device) -> float:
        """Return the share of what is seen of it that ``surface`` shows ``within`` metres; 1 for points alone."""
        if self.mesh is None:
            return 1.0
        camera = PinholeCamera(width=96, height=96, fx=150.0, fy=150.0, cx=47.5, cy=47.5)
        middle = (self.points.min(axis=0) + self.points.max(axis=0)) / 2
        poses = views_around(middle, self.diameter, camera, directions=_SIDES_ASKED)[::ROLLS]
        ours, theirs = (
            cast_rays_at_mesh(mesh, camera, poses, device=device, depth_only=True).depth.numpy()
            for mesh in (self.mesh, surface)
        )
        seen = ours > 0
        return float((np.abs(ours - theirs)[seen] < within).mean()) if seen.any() else 0.0


def check_size(model: CadModel, typical_depth: float | None) -> None:
    """Refuse a model whose size cannot be meant: ``typical_depth`` is how far away, metres, the query's object is.

    Raises InputError that names the scale to give.
    """
    size = model.diameter
    reach = 5.0 if typical_depth is None else typical_depth
    if size > 20 * reach:
        raise InputError(
            f"{model.source}: the model is {size:.4g} m large, and the query sees things {reach:.2g} m away; if its"
            f" file is in millimetres, as BOP's are, give --model-scale 0.001"
        )
    if size < reach / 1000:
        raise InputError(
            f"{model.source}: the model is {1000 * size:.3g} mm large, and the query sees things {reach:.2g} m away:"
            " too small to be seen; give --model-scale with the metres a unit of its file, 1 where that is metres"
        )


def views_around(
    centre: NDArray[np.float64], diameter: float, camera: PinholeCamera, *, directions: int = DIRECTIONS
) -> list[Matrix]:
    """Return world_from_camera poses that see a model whole from all around, each at ``ROLLS`` turns of the camera.

    The directions are a Fibonacci lattice on the sphere.
    """
    half_angle = np.arctan(_FILLED / 2 * min(camera.width / camera.fx, camera.height / camera.fy))
    distance = diameter / 2 / np.sin(half_angle)
    index = np.arange(directions) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / directions), np.pi * (1 + 5**0.5) * index
    ways = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    rolls = exp_se3(np.outer(2 * np.pi * np.arange(ROLLS) / ROLLS, (0, 0, 0, 0, 0, 1)))
    poses = []
    for way in ways:
        pose = look_at(centre + distance * way, centre)
        # The model is in the middle of the image, wherever the principal point is.
        middle = ((camera.width - 1) / 2 - camera.cx) / camera.fx, ((camera.height - 1) / 2 - camera.cy) / camera.fy
        poses += [pose @ roll @ _aside(-distance * middle[0], -distance * middle[1]) for roll in rolls]
    return poses


@dataclass(frozen=True, kw_only=True, eq=False)
class Renderer:
    """Renders a model's colours and depth with our ray caster, under a light at the camera."""

    model: CadModel
    mesh: Mesh
    hierarchy: Hierarchy
    device: Device

    @classmethod
    def of(cls, model: CadModel, surface: Mesh, *, device: Device) -> "Renderer":
        """Make one of a model; ``surface`` is taken where it has points alone."""
        mesh = model.mesh or surface
        return cls(model=model, mesh=mesh, hierarchy=mesh_hierarchy(mesh, device=device), device=device)

    def view(self, camera: PinholeCamera, pose: Matrix) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colour (height, width, 3) uint8 RGB, and planar depth (height, width) metres, from world_from_camera.

        Where nothing is, both are 0.
        """
        hits = cast_rays_at_mesh(self.mesh, camera, [pose], device=self.device, hierarchy=self.hierarchy)
        depth, triangles = hits.depth.numpy()[0], hits.triangles.numpy()[0]
        at, seen = hits.barycentric.numpy()[0].astype(np.float64), triangles >= 0
        weights = np.concatenate([at, 1 - at.sum(axis=-1, keepdims=True)], axis=-1)[seen]
        corners = self.mesh.triangles[triangles[seen]]
        color = np.zeros((*depth.shape, 3), np.uint8)
        color[seen] = self._colors(corners, weights, pose)
        return color, depth

    def _colors(self, corners: NDArray[np.int32], weights: NDArray[np.float64], pose: Matrix) -> NDArray[np.float64]:
        if self.model.texture is not None and self.model.uv is not None:
            return _lookup(self.model.texture, np.einsum("nk,nkd->nd", weights, self.model.uv[corners]))
        if self.mesh.colors is not None:
            return np.einsum("nk,nkd->nd", weights, self.mesh.colors[corners].astype(np.float64))
        places = self.mesh.vertices[corners].astype(np.float64)
        normals = np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        ways = np.einsum("nk,nkd->nd", weights, places) - pose[:3, 3]
        cosines = np.abs((normals * ways).sum(axis=1)) / np.maximum(np.linalg.norm(ways, axis=1), 1e-30)
        shade = _PLAIN * (1 - _LIGHT_FROM_CAMERA + _LIGHT_FROM_CAMERA * cosines)
        return np.repeat(shade[:, None], 3, axis=1)


def _lookup(texture: NDArray[np.uint8], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return texture colours (n, 3), bilinear, at uv (n, 2), which repeat; (0, 0) is the lower left corner."""
    height, width = texture.shape[:2]
    x, y = (uv[:, 0] % 1) * width - 0.5, (1 - uv[:, 1] % 1) * height - 0.5
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    a, b = (x - left)[:, None], (y - top)[:, None]

    def at(dx: int, dy: int) -> NDArray[np.float64]:
        return texture[(top + dy) % height, (left + dx) % width].astype(np.float64)

    return (1 - b) * ((1 - a) * at(0, 0) + a * at(1, 0)) + b * ((1 - a) * at(0, 1) + a * at(1, 1))


def _aside(x: float, y: float) -> Matrix:
    shift = np.eye(4)
    shift[:2, 3] = x, y
    return shift


def _outside_out(mesh: Mesh) -> Mesh:
    """Return a mesh whose volume is positive: one wound the other way round has its inside outside."""
    corners = (mesh.vertices[mesh.triangles] - mesh.vertices.mean(axis=0)).astype(np.float64)
    signed = np.einsum("ni,ni->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return mesh if signed >= 0 else replace(mesh, triangles=np.ascontiguousarray(mesh.triangles[:, ::-1]))
