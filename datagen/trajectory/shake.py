"""Hand-held shake: smooth noise of a camera's position and rotation."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.scene_spec.trajectory_settings import ShakeSettings
from datagen.trajectory.viewing import poses

Array = NDArray[np.float64]

WAVES = 64
SHAKE_STREAM = 0x5A4E
"""Tells the random numbers of shake from others of the same seed."""


def shaken(
    world_from_camera: Array, settings: ShakeSettings, *, frames_per_second: float, seed: int
) -> NDArray[np.float64]:
    """Return a path (N, 4, 4) with shake added in the camera's own axes.

    Raises InputError where the shake has frequencies that so few frames a second cannot show.
    """
    highest = settings.frequency_hz[1]
    if highest > frames_per_second / 2:
        raise InputError(
            f"trajectory.shake.frequency_hz: reaches {highest:g} Hz, but {frames_per_second:g} frames a second show at "
            f"most {frames_per_second / 2:g} Hz; lower it or raise render.frames_per_second"
        )
    noise = band_limited_noise(
        np.arange(len(world_from_camera)) / frames_per_second, settings.frequency_hz, components=6, seed=seed
    )
    turned = Rotation.from_rotvec(np.radians(settings.rotation_deg) * noise[:, 3:])
    return world_from_camera @ poses(turned.as_matrix(), settings.position * noise[:, :3])


def band_limited_noise(
    seconds: Array, band_hz: tuple[float, float], *, components: int, seed: int
) -> NDArray[np.float64]:
    """Return independent noise (N, components) with a root mean square of 1 and no frequency outside the band.

    It is a sum of waves whose frequencies lie one in each of equal parts of the band, with random phases (Rice,
    Mathematical analysis of random noise, 1944), so that it is a function of time, whatever frames are asked for.
    """
    low, high = band_hz
    random = np.random.default_rng([seed, SHAKE_STREAM])
    frequencies = low + (high - low) * (np.arange(WAVES)[:, None] + random.random((WAVES, components))) / WAVES
    phases = 2 * np.pi * random.random((WAVES, components))
    noise = np.zeros((len(seconds), components))
    for frequency, phase in zip(frequencies, phases, strict=True):
        noise += np.cos(2 * np.pi * seconds[:, None] * frequency + phase)
    return noise * np.sqrt(2 / WAVES)
