"""The depth image that a real sensor would give, from an exact one."""

import cv2
import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.depth_sensors import SENSORS, DepthSensor
from datagen.sensors.missing_returns import grazing_loss, neighbourhood, unseen_by_second_view
from datagen.sensors.surfaces import (
    SURFACE_TOLERANCE,
    Image,
    Mask,
    cos_incidence,
    cos_incidence_of_normals,
    depth_edges,
    inverse_depth,
    inverse_depth_slopes,
)

SENSOR_NOISE = 0x5E45
"""Keeps this noise apart from what else is drawn from the same seed for the same frame."""

WAVINESS_PX = 1.5
"""Edges are displaced together over about this length: real ones are wavy, not sprinkled. By eye."""
_GAUSSIAN = np.asarray(cv2.getGaussianKernel(11, WAVINESS_PX, cv2.CV_32F), dtype=np.float32)
_WAVINESS_KERNEL = _GAUSSIAN / np.linalg.norm(_GAUSSIAN)  # what has deviation 1 keeps it

LARGEST_SHIFT = 4.0
"""In standard deviations: farther from an edge nothing is displaced."""


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
    edges = depth_edges(w)
    measured = exact.copy()
    if settings.lateral > 0:
        if sensor.fattening_px:
            _fatten(measured, w, slopes, radius_px=round(settings.lateral * sensor.fattening_px))
        sigma_px = np.float32(settings.lateral) * sensor.lateral_sigma_px(theta)
        _displace_edges(measured, w, slopes, edges, shifts, sigma_px)
    _add_axial_noise(measured, theta, axial_noise, sensor, settings)
    if settings.quantisation > 0:
        measured = quantised(measured, settings.quantisation * sensor.inverse_depth_step)
    lost = _lost(w, theta, edges, chance, camera, sensor, settings)
    nearest = sensor.nearest if settings.nearest is None else settings.nearest
    farthest = sensor.farthest if settings.farthest is None else settings.farthest
    measured[lost | (exact <= 0) | (measured < nearest) | (measured > farthest)] = 0
    return measured


def quantised(depth: Image, inverse_depth_step: float) -> Image:
    """Return depth with 1/z rounded to whole multiples of ``inverse_depth_step`` (1/m), 0 where that is none.

    Depths then lie inverse_depth_step·z² apart (Khoshelham 2012).
    """
    step = np.float32(inverse_depth_step)
    return inverse_depth(np.rint(inverse_depth(depth) / step) * step)


def _unit_shifts(rng: np.random.Generator, shape: tuple[int, ...]) -> tuple[Image, Image]:
    """Return displacements (H, W) along u and v of standard deviation 1, alike over ``WAVINESS_PX``."""
    reach = len(_WAVINESS_KERNEL) // 2
    noise = rng.standard_normal((2, shape[0] + 2 * reach, shape[1] + 2 * reach), dtype=np.float32)
    inner = np.s_[reach:-reach, reach:-reach]
    along_u, along_v = (cv2.sepFilter2D(field, -1, _WAVINESS_KERNEL, _WAVINESS_KERNEL)[inner] for field in noise)
    return along_u.astype(np.float32, copy=False), along_v.astype(np.float32, copy=False)


def _displace_edges(
    measured: Image, w: Image, slopes: tuple[Image, Image], edges: Mask, shifts: tuple[Image, Image], sigma: Image
) -> None:
    """Give pixels near ``edges`` the depth that lies ``sigma``·``shifts`` pixels beside them, on another surface.

    On its own surface a pixel keeps its depth: the noise there is the axial one, which was measured with all its
    causes.
    """
    height, width = w.shape
    reach = min(int(np.ceil(LARGEST_SHIFT * sigma[edges].max(initial=0))), max(height, width))
    near = cv2.dilate(edges.astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    row, column = np.nonzero(near)
    du = np.rint(sigma[row, column] * shifts[0][row, column])
    dv = np.rint(sigma[row, column] * shifts[1][row, column])
    u = np.clip(column + du.astype(np.intp), 0, width - 1)
    v = np.clip(row + dv.astype(np.intp), 0, height - 1)
    here = w[row, column]
    on_own_surface = here + slopes[0][row, column] * du + slopes[1][row, column] * dv
    elsewhere = np.abs(w[v, u] - on_own_surface) > np.float32(SURFACE_TOLERANCE) * here
    measured[row, column] = np.where(elsewhere, measured[v, u], measured[row, column])


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
    w: Image,
    theta: Image,
    edges: Mask,
    chance: Image,
    camera: PinholeCamera,
    sensor: DepthSensor,
    settings: SensorSettings,
) -> NDArray[np.bool_]:
    """Tell which pixels get no return; ``chance`` is uniform in [0, 1)."""
    kept = np.ones_like(w)
    if settings.grazing:
        kept -= grazing_loss(theta, sensor.grazing_deg)
    if settings.edges:
        kept[neighbourhood(edges)] *= np.float32(1 - sensor.edge_loss)
    lost = chance >= kept
    if settings.shadow:
        disparity_px_m = camera.fx * sensor.baseline
        lost |= unseen_by_second_view(w, disparity_px_m=disparity_px_m, needs_image=sensor.needs_second_image)
    return lost
