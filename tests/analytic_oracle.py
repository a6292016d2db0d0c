"""Solids in closed form, for NumPy and as an oracle: boxes, spheres, cylinders, joined, cut off and cut together."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import warp as wp
from analytic_volume import analytic_volume

from fusion.surface.dual_contouring.oracle import Oracle

BOX, SPHERE, CYLINDER = 0, 1, 2
UNION, CUT_OFF, CUT_TOGETHER = 0, 1, 2


@wp.struct
class SolidState:
    """By part: world_from_part rotations, centres and half sizes (metres), what it is, and how it is joined."""

    rotations: wp.array(dtype=wp.mat33)
    centres: wp.array(dtype=wp.vec3)
    halves: wp.array(dtype=wp.vec3)
    kinds: wp.array(dtype=int)
    ways: wp.array(dtype=int)
    voxel_size: float


@wp.func
def part_distance(kind: int, half: wp.vec3, p: wp.vec3) -> float:
    if kind == SPHERE:
        return wp.length(p) - half[0]
    q = wp.vec3(wp.abs(p[0]) - half[0], wp.abs(p[1]) - half[1], wp.abs(p[2]) - half[2])
    if kind == CYLINDER:
        across = wp.length(wp.vec2(p[0], p[1])) - half[0]
        corner = wp.vec2(wp.max(across, 0.0), wp.max(q[2], 0.0))
        return wp.min(wp.max(across, q[2]), 0.0) + wp.length(corner)
    outside = wp.vec3(wp.max(q[0], 0.0), wp.max(q[1], 0.0), wp.max(q[2], 0.0))
    return wp.min(wp.max(q[0], wp.max(q[1], q[2])), 0.0) + wp.length(outside)


@wp.func
def solid_value(state: SolidState, number: int, point: wp.vec3) -> float:
    distance = float(1.0e3)
    for i in range(state.centres.shape[0]):
        local = wp.transpose(state.rotations[i]) * (state.voxel_size * point - state.centres[i])
        part = part_distance(state.kinds[i], state.halves[i], local)
        if state.ways[i] == UNION:
            distance = wp.min(distance, part)
        elif state.ways[i] == CUT_OFF:
            distance = wp.max(distance, -part)
        else:
            distance = wp.max(distance, part)
    return distance / state.voxel_size


@dataclass(frozen=True)
class Solid:
    """Parts joined one after the other; metres in the world."""

    kinds: tuple
    ways: tuple
    centres: np.ndarray
    halves: np.ndarray
    rotations: np.ndarray

    def __call__(self, points):
        """Return signed distances (n,), a lower bound away from the surface, negative inside."""
        return self.join([self.part(i, points) for i in range(len(self.kinds))])

    def part(self, i, points):
        """Return the signed distances to one part."""
        p = (points - self.centres[i]) @ self.rotations[i]
        half = self.halves[i]
        if self.kinds[i] == SPHERE:
            return np.linalg.norm(p, axis=-1) - half[0]
        q = np.abs(p) - half
        if self.kinds[i] == CYLINDER:
            q = np.stack([np.linalg.norm(p[..., :2], axis=-1) - half[0], q[..., 2]], -1)
        return np.minimum(q.max(-1), 0) + np.linalg.norm(np.maximum(q, 0), axis=-1)

    def join(self, parts):
        distance = np.full_like(parts[0], 1e3)
        for way, part in zip(self.ways, parts, strict=True):
            distance = {UNION: np.minimum(distance, part), CUT_OFF: np.maximum(distance, -part)}.get(
                way, np.maximum(distance, part)
            )
        return distance

    @cached_property
    def reach(self):
        """A cube around the origin that holds it."""
        return float(np.max(np.linalg.norm(self.centres, axis=1) + np.linalg.norm(self.halves, axis=1)))

    def oracle(self, voxel_size, device):
        state = SolidState()
        for name, dtype in (("rotations", wp.mat33), ("centres", wp.vec3), ("halves", wp.vec3)):
            setattr(state, name, wp.array(getattr(self, name).astype(np.float32), dtype=dtype, device=device))
        state.kinds = wp.array(self.kinds, dtype=int, device=device)
        state.ways = wp.array(self.ways, dtype=int, device=device)
        state.voxel_size = voxel_size
        return Oracle(solid_value, SolidState, state)

    def volume(self, voxel_size, device, *, storage="full", truncation_voxels=4):
        reach = self.reach + 2 * voxel_size
        return analytic_volume(
            self,
            [-reach] * 3,
            [reach] * 3,
            device=device,
            voxel_size=voxel_size,
            truncation=truncation_voxels * voxel_size,
            storage=storage,
        )


def rotation(rng):
    """Return a rotation, uniform over all."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def ball(centre, radius):
    return Solid((SPHERE,), (UNION,), np.array([centre]), np.full((1, 3), radius), np.eye(3)[None])


def cube(rng, half=0.31):
    return Solid((BOX,), (UNION,), rng.uniform(-0.02, 0.02, (1, 3)), np.full((1, 3), half), rotation(rng)[None])


def l_shape(rng):
    turn = rotation(rng)
    centres = np.array([[0.0, 0, 0], [0.2, 0.2, 0]]) @ turn.T
    halves = np.array([[0.4, 0.4, 0.2], [0.31, 0.31, 0.3]])
    return Solid((BOX, BOX), (UNION, CUT_OFF), centres, halves, np.stack([turn, turn]))


def random_solid(rng, parts=4):
    """Return a solid of parts of all kinds, joined at random; the first is there, the second cuts or joins."""
    kinds = tuple(rng.integers(0, 3, parts).tolist())
    ways = (UNION, *rng.choice([UNION, CUT_OFF, CUT_OFF, CUT_TOGETHER], parts - 1, p=[0.4, 0.2, 0.2, 0.2]).tolist())
    return Solid(
        kinds,
        ways,
        np.concatenate([np.zeros((1, 3)), rng.uniform(-0.3, 0.3, (parts - 1, 3))]),
        np.concatenate([rng.uniform(0.3, 0.5, (1, 3)), rng.uniform(0.1, 0.5, (parts - 1, 3))]),
        np.stack([rotation(rng) for _ in range(parts)]),
    )
