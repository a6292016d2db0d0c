"""The depth image that a real sensor would give, from an exact one."""

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.depth_sensors import SENSORS, DepthSensor
from datagen.sensors.missing_returns import edge_neighbourhood, grazing_loss, unseen_by_second_view
from datagen.sensors.surfaces import (
    SURFACE_TOLERANCE,
    Image,
    cos_incidence,
    cos_incidence_of_normals,
    inverse_depth,
    inverse_depth_slopes,
)

SENSOR_NOISE = 0x5E45
"""Keeps this noise apart from what else is drawn from the same seed for the same frame."""

WAVINESS_PX = 1.5
"""Edges are displaced together over about this length: real ones are wavy, not sprinkled. By eye."""
_WAVINESS_KERNEL = cv2.getGaussianKernel(11, WAVINESS_PX, cv2.CV_32F)


def sensor_generator(seed: int, frame: int) -> np.random.Generator:
    """Return the generator of a frame's sensor noise: its own, and the same in whatever order frames are made."""
    return np.random.default_rng([seed, frame, SENSOR_NOISE])


def simulate_depth(
    depth: NDArray[np.floating],
    camera: PinholeCamera,
    settings: SensorSettings,
    *,
    rng: np.random.Generator,
    normals: NDArray[np.floating] | None = None,
) -> Image:
    """Return depth (H, W), planar metres, 0 = no return, as the sensor of ``settings`` would see exact ``depth``.

    Edges move sideways, noise is added along z, returns are lost, and depth falls on the sensor's steps. The angle at
    which a surface is seen comes from ``normals`` (H, W, 3), unit, camera axes, where given, else from the depth.
    Invalid pixels stay invalid. The same fields are drawn from ``rng`` whatever the settings, so that turning one
    effect off leaves the others as they were. ``settings.seed`` is not looked at: the caller seeds ``rng``.
    """
    sensor = SENSORS[settings.model]
    exact = np.asarray(depth, dtype=np.float32)
    axial_noise = rng.standard_normal(exact.shape, dtype=np.float32)
    shifts = _unit_shifts(rng, exact.shape)
    chance = rng.random(exact.shape, dtype=np.float32)

    w = inverse_depth(exact)
    slopes = inverse_depth_slopes(w)
    cosine = cos_incidence(w, slopes, camera) if normals is None else cos_incidence_of_normals(normals, camera)
    theta = np.arccos(cosine)
    measured = exact.copy()
    if settings.lateral > 0:
        if sensor.fattening_px:
            _fatten(measured, w, slopes, radius_px=round(settings.lateral * sensor.fattening_px))
        _displace_edges(measured, w, slopes, shifts * (np.float32(settings.lateral) * sensor.lateral_sigma_px(theta)))
    _add_axial_noise(measured, theta, axial_noise, sensor, settings)
    if settings.quantisation > 0:
        measured = quantised(measured, settings.quantisation * sensor.inverse_depth_step)
    lost = _lost(w, theta, chance, camera, sensor, settings)
    nearest = sensor.nearest if settings.nearest is None else settings.nearest
    farthest = sensor.farthest if settings.farthest is None else settings.farthest
    measured[lost | (exact <= 0) | (measured < nearest) | (measured > farthest)] = 0
    return measured


def quantised(depth: Image, inverse_depth_step: float) -> Image:
    """Return depth with 1/z rounded to whole multiples of ``inverse_depth_step`` (1/m), 0 where that is none.

    Depths then lie inverse_depth_step·z² apart (Khoshelham 2012, equation 11).
    """
    step = np.float32(inverse_depth_step)
    return inverse_depth(np.rint(inverse_depth(depth) / step) * step)


def _unit_shifts(rng: np.random.Generator, shape: tuple[int, ...]) -> Image:
    """Return displacements (2, H, W) of standard deviation 1, alike over ``WAVINESS_PX``."""
    reach = len(_WAVINESS_KERNEL) // 2
    noise = rng.standard_normal((2, shape[0] + 2 * reach, shape[1] + 2 * reach), dtype=np.float32)
    gain = float(np.square(_WAVINESS_KERNEL).sum())
    waves = [cv2.sepFilter2D(field, -1, _WAVINESS_KERNEL, _WAVINESS_KERNEL) for field in noise]
    return np.stack(waves)[:, reach:-reach, reach:-reach] / np.float32(gain)


def _displace_edges(measured: Image, w: Image, slopes: tuple[Image, Image], shifts: Image) -> None:
    """Give pixels the depth that lies ``shifts`` (2, H, W) pixels beside them, where that is another surface.

    On its own surface a pixel keeps its depth: the noise there is the axial one, which was measured with all its
    causes.
    """
    height, width = w.shape
    du, dv = np.rint(shifts[0]), np.rint(shifts[1])
    u, v = np.arange(width, dtype=np.float32) + du, np.arange(height, dtype=np.float32)[:, None] + dv
    beside = cv2.remap(w, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    elsewhere = np.abs(beside - w - slopes[0] * du - slopes[1] * dv) > np.float32(SURFACE_TOLERANCE) * w
    source = cv2.remap(measured, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
    np.copyto(measured, source, where=elsewhere & inside)


def _fatten(measured: Image, w: Image, slopes: tuple[Image, Image], *, radius_px: int) -> None:
    """Let foreground grow by ``radius_px`` over background, as block matching does."""
    if radius_px < 1:
        return
    foreground = cv2.dilate(w, np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8))
    rise = np.float32(radius_px) * (np.abs(slopes[0]) + np.abs(slopes[1]))
    beside_edge = foreground - w > rise + np.float32(SURFACE_TOLERANCE) * w
    np.copyto(measured, inverse_depth(foreground), where=beside_edge & (w > 0))


def _add_axial_noise(
    measured: Image, theta: Image, noise: Image, sensor: DepthSensor, settings: SensorSettings
) -> None:
    """Add noise along z such that, with the rounding to come, its standard deviation is what was measured."""
    if settings.axial == 0:
        return
    sigma = np.float32(settings.axial) * sensor.axial_sigma(measured, theta)
    step = np.float32(settings.quantisation * sensor.inverse_depth_step) * measured * measured
    measured += np.sqrt(np.maximum(sigma * sigma - step * step / 12, 0)) * noise


def _lost(
    w: Image, theta: Image, chance: Image, camera: PinholeCamera, sensor: DepthSensor, settings: SensorSettings
) -> NDArray[np.bool_]:
    """Tell which pixels get no return; ``chance`` is uniform in [0, 1)."""
    kept = np.ones_like(w)
    if settings.grazing:
        kept -= grazing_loss(theta, sensor.grazing_deg)
    if settings.edges:
        kept[edge_neighbourhood(w)] *= np.float32(1 - sensor.edge_loss)
    lost = chance >= kept
    if settings.shadow:
        disparity_px_m = camera.fx * sensor.baseline
        lost |= unseen_by_second_view(w, disparity_px_m=disparity_px_m, needs_image=sensor.needs_second_image)
    return lost
