"""Paths around a centre that a formula gives: orbits, spirals over a hemisphere, and random views."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.scene_spec.trajectory_settings import Direction, HemisphereTrajectory, OrbitTrajectory, ShellTrajectory
from datagen.trajectory.viewing import look_at_each, on_a_sphere

Array = NDArray[np.float64]

VIEW_STREAM = 0x5E11
"""Tells the random numbers of views from others of the same seed and frame."""


def orbit(settings: OrbitTrajectory, frames: int) -> Array:
    """Return world_from_camera (N, 4, 4) on a circle: equal steps from the start angle to the end of the last turn."""
    azimuth = _azimuth(settings.start_angle_deg, settings.direction, settings.turns * _parts(frames))
    height = np.sin(np.radians(settings.elevation_deg))
    positions = on_a_sphere(settings.center, settings.radius, azimuth, np.full(frames, height))
    return look_at_each(positions, settings.look_at or settings.center)


def hemisphere(settings: HemisphereTrajectory, frames: int) -> Array:
    """Return world_from_camera (N, 4, 4) on a spiral whose frames are spread evenly over a belt of the sphere.

    Heights grow in equal steps, each with the same area (Archimedes), and azimuth in proportion to the polar angle,
    so that the speed is all but constant too. Without a number of turns, a
    turn rises by √(area/N), as far as frames are apart (Bauer, Distribution of points on a sphere with application to
    star catalogs, 2000).
    """
    first, last = np.radians(settings.elevation_deg)
    heights = np.sin(first) + (np.sin(last) - np.sin(first)) * (np.arange(frames) + 0.5) / frames
    elevation = np.arcsin(np.clip(heights, -1, 1))
    turns = turns_of(settings, frames)
    azimuth = _azimuth(settings.start_angle_deg, settings.direction, turns * (elevation - first) / (last - first))
    return look_at_each(
        on_a_sphere(settings.center, settings.radius, azimuth, heights), settings.look_at or settings.center
    )


def turns_of(settings: HemisphereTrajectory, frames: int) -> float:
    """Return the number of turns of a spiral: as given, or so many that one rises by the spacing of the frames."""
    first, last = np.radians(settings.elevation_deg)
    return settings.turns or float(abs(last - first) / spacing(settings, frames))


def spacing(settings: HemisphereTrajectory, frames: int) -> float:
    """Return how far frames are apart in radians on a belt that they share evenly: the root of each one's area."""
    low, high = sorted(np.sin(np.radians(settings.elevation_deg)))
    return float(np.sqrt(2 * np.pi * (high - low) / frames))


def shell(settings: ShellTrajectory, frames: int, seed: int) -> Array:
    """Return random views world_from_camera (N, 4, 4); each depends on ``seed`` and its own number alone."""
    drawn = np.array([np.random.default_rng([seed, frame, VIEW_STREAM]).random(7) for frame in range(frames)])
    (nearest, farthest), (low, high) = settings.radius, np.sin(np.radians(settings.elevation_deg))
    positions = on_a_sphere(
        settings.center,
        nearest + (farthest - nearest) * drawn[:, 0],
        2 * np.pi * drawn[:, 1],
        low + (high - low) * drawn[:, 2],
    )
    # Uniform in a ball: as many points between two radii as there is volume.
    aside = on_a_sphere(
        (0, 0, 0), settings.look_at_jitter * np.cbrt(drawn[:, 3]), 2 * np.pi * drawn[:, 4], 2 * drawn[:, 5] - 1
    )
    upright = look_at_each(positions, np.asarray(settings.look_at or settings.center) + aside)
    roll = Rotation.from_rotvec(np.radians(settings.roll_deg) * (2 * drawn[:, 6:] - 1) * (0, 0, 1))
    upright[:, :3, :3] = upright[:, :3, :3] @ roll.as_matrix()
    return upright


def _parts(frames: int) -> Array:
    """Return how much of the path is behind at each frame, 0 at the first and 1 at the last."""
    return np.arange(frames) / max(frames - 1, 1)


def _azimuth(start_angle_deg: float, direction: Direction, turns: Array) -> Array:
    sign = 1 if direction == "counter-clockwise" else -1
    return np.radians(start_angle_deg) + sign * 2 * np.pi * turns
