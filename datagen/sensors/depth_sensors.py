"""Depth sensors in numbers: noise, steps and range, each with its source.

Kinect v1: C. V. Nguyen, S. Izadi and D. Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction and
Tracking", 3DIMPVT 2012 (noise along z and across it, by depth and angle); K. Khoshelham and S. Oude Elberink, "Accuracy
and Resolution of Kinect Depth Data for Indoor Mapping Applications", Sensors 12(2), 2012 (step between depths, range,
baseline). RealSense D435: Intel, "Best-Known-Methods for Tuning Intel RealSense D400 Depth Cameras" (depth error from
disparity error, focal length and baseline) and "Intel RealSense D400 Series Product Family Datasheet" (baseline,
nearest depth, the band without depth at the left).

What no source gives is chosen by eye: the angles at which returns are lost and their share beside edges, for both; for
the D435 also how far edges move and foreground grows. The D435's numbers are those of its own 848×480 pixels, whatever
the rendered camera; only what is hidden and the band at the left follow the rendered camera's focal length.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from datagen.scene_spec.sensor_settings import SensorModel
from datagen.sensors.surfaces import Image

LARGEST_ANGLE = np.float32(np.radians(89.0))
"""The formulas divide by the angle that is left to 90 degrees."""


@dataclass(frozen=True, kw_only=True)
class DepthSensor:
    """What a sensor does to planar depth z (metres) of a surface seen at the incidence angle θ (radians).

    ``axial_sigma`` (z, θ) is the standard deviation along z in metres, quantisation included, as it was measured on
    real images. ``lateral_sigma_px`` (θ) is that of an edge's position. ``inverse_depth_step`` (1/m): depth is known
    in whole multiples of it, so that neighbouring depths lie inverse_depth_step·z² apart. The projector or second
    camera stands ``baseline`` metres to the camera's right. ``fattening_px``: by so much foreground grows over
    background. ``needs_second_image``: no depth where the second camera does not look. Returns are lost from
    ``grazing_deg[0]`` on, all of them from ``grazing_deg[1]``, and with probability ``edge_loss`` beside an edge.
    """

    axial_sigma: Callable[[Image, Image], Image]
    lateral_sigma_px: Callable[[Image], Image]
    inverse_depth_step: float
    baseline: float
    nearest: float
    farthest: float
    fattening_px: float
    needs_second_image: bool
    grazing_deg: tuple[float, float]
    edge_loss: float


def kinect_axial_sigma(z: Image, theta: Image) -> Image:
    """Return σ_z = 0.0012 + 0.0019 (z − 0.4)², plus 0.0001/√z · θ²/(π/2 − θ)² from 60° on (Nguyen 2012)."""
    sigma = np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) ** 2
    steep = (theta >= np.float32(np.pi / 3)) & (z > 0)
    angle = np.minimum(theta[steep], LARGEST_ANGLE)
    sigma[steep] += np.float32(0.0001) / np.sqrt(z[steep]) * (angle / (np.float32(np.pi / 2) - angle)) ** 2
    return sigma


def kinect_lateral_sigma_px(theta: Image) -> Image:
    """Return σ_L = 0.8 + 0.035 θ/(π/2 − θ) pixels (Nguyen 2012)."""
    angle = np.minimum(theta, LARGEST_ANGLE)
    return np.float32(0.8) + np.float32(0.035) * angle / (np.float32(np.pi / 2) - angle)


D435_FOCAL_LENGTH_PX = 424.0
D435_BASELINE = 0.05
D435_DISPARITY_SIGMA_PX = 0.08
D435_DISPARITY_STEP_PX = 1 / 32


def d435_axial_sigma(z: Image, theta: Image) -> Image:  # noqa: ARG001 - every sensor's formula has the angle
    """Return σ_z = z²·σ_d/(f·b), σ_d = 0.08 px, f = 424 px (848 wide), b = 50 mm (Intel's tuning guide)."""
    return z * z * np.float32(D435_DISPARITY_SIGMA_PX / (D435_FOCAL_LENGTH_PX * D435_BASELINE))


def d435_lateral_sigma_px(theta: NDArray[np.float32]) -> Image:
    """Return half a pixel: by eye, no source measures it."""
    return np.full_like(theta, 0.5)


SENSORS: Mapping[SensorModel, DepthSensor] = MappingProxyType(
    {
        "kinect-v1": DepthSensor(
            axial_sigma=kinect_axial_sigma,
            lateral_sigma_px=kinect_lateral_sigma_px,
            inverse_depth_step=2.85e-3,
            baseline=0.075,
            nearest=0.5,
            farthest=5.0,
            fattening_px=0.0,
            needs_second_image=False,
            grazing_deg=(70.0, 85.0),
            edge_loss=0.3,
        ),
        "realsense-d435": DepthSensor(
            axial_sigma=d435_axial_sigma,
            lateral_sigma_px=d435_lateral_sigma_px,
            inverse_depth_step=D435_DISPARITY_STEP_PX / (D435_FOCAL_LENGTH_PX * D435_BASELINE),
            baseline=D435_BASELINE,
            nearest=0.28,
            farthest=10.0,
            fattening_px=2.0,
            needs_second_image=True,
            grazing_deg=(75.0, 88.0),
            edge_loss=0.2,
        ),
    }
)
