"""A shape whose distances and views are known in closed form: three balls, no two alike, in a triangle."""

import numpy as np

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at, rotation_angle_deg, transform_points
from fusion.pose.pose_model import prepare_model
from fusion.pose.shape_volume import volume_from_distances

CAMERA = PinholeCamera(width=160, height=120, fx=170.0, fy=165.0, cx=81.3, cy=58.6)
OFFSET = np.array([3.0, -2.0, 5.0])
CENTRES = OFFSET + np.array([[0.0, 0.0, 0.0], [0.12, 0.03, 0.02], [-0.05, 0.11, 0.06]])
RADII = np.array([0.1, 0.06, 0.045])
VOXEL = 0.005
POSES = [
    look_at(OFFSET + 0.7 * np.array(way), OFFSET) for way in ((0.5, -0.8, 0.3), (-0.6, -0.5, -0.5), (0.9, 0.4, 0.2))
]


def distances(points):
    return (np.linalg.norm(points[:, None] - CENTRES, axis=2) - RADII).min(axis=1)


def see(pose, centres=CENTRES, radii=RADII):
    """Return exact planar depth of balls."""
    rays = CAMERA.back_project(np.ones((CAMERA.height, CAMERA.width))) @ pose[:3, :3].T
    depth = np.full(rays.shape[:2], np.inf)
    for centre, radius in zip(centres, radii, strict=True):
        offset = pose[:3, 3] - centre
        a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - radius**2
        root = np.sqrt(np.maximum(b**2 - a * c, 0))
        depth = np.where(b**2 > a * c, np.minimum(depth, (-b - root) / a), depth)
    return np.where(np.isfinite(depth), depth, 0).astype(np.float32)


def sphere_points(count=4000):
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    points = np.concatenate([centre + radius * unit for centre, radius in zip(CENTRES, RADII, strict=True)])
    return points[np.abs(distances(points)) < 1e-9]


def ball_model(device):
    return prepare_model(volume_from_distances(distances, sphere_points(), voxel_size=VOXEL, device=device))


def twist(rng, turn_deg, shift):
    turn, way = rng.normal(size=(2, 3))
    return np.concatenate([shift * way / np.linalg.norm(way), np.radians(turn_deg) * turn / np.linalg.norm(turn)])


def errors(found, truth):
    """Return the angle, degrees, and how far the model's middle is off, metres."""
    middle = transform_points(inverse(truth), OFFSET)
    return rotation_angle_deg(inverse(found) @ truth), np.linalg.norm(transform_points(found, middle) - OFFSET)
