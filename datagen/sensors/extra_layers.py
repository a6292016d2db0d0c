"""The layers that a scene's sensor and lens add to each rendered frame, and what ``dataset.json`` says of them."""

import numpy as np
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.dataset_format import Distortion, Intrinsics
from datagen.images import DEPTH_INVALID_MAX
from datagen.scene_spec.lens_settings import LensSettings
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.lens import lens_map
from datagen.sensors.lens_images import distort_color, distort_depth
from datagen.sensors.simulate_depth import sensor_generator, simulate_depth
from datagen.sensors.surfaces import Image


def extra_layers(
    scene: Scene, frame: int, color: NDArray[np.uint8], depth: NDArray[np.floating], camera: PinholeCamera
) -> dict[str, NDArray]:
    """Return what a scene's sensor and lens make of a rendered frame, by layer name.

    ``color`` (H, W, 3) uint8 RGB and ``depth`` (H, W) planar metres, 0 = invalid, are what ``camera`` rendered.
    """
    layers: dict[str, NDArray] = {}
    sensor = sensor_of(scene)
    if sensor is not None:
        layers["sensor_depth"] = sensor_depth(depth, camera, sensor, frame=frame, depth_scale=scene.render.depth_scale)
    if scene.lens is not None:
        layers |= lens_layers(color, depth, camera, scene.lens)
    return layers


def lens_layers(
    color: NDArray[np.uint8], depth: NDArray[np.floating], camera: PinholeCamera, lens: LensSettings
) -> dict[str, NDArray]:
    """Return what ``lens`` makes of a frame's colour and depth, by layer name; arguments as ``extra_layers``."""
    shown = lens_map(camera, lens)
    return {"distorted_color": distort_color(color, shown), "distorted_depth": distort_depth(depth, shown)}


def sensor_of(scene: Scene) -> SensorSettings | None:
    """Return a scene's sensor with its seed: its own, or that of the rendering."""
    if scene.sensor is None or scene.sensor.seed is not None:
        return scene.sensor
    return scene.sensor.model_copy(update={"seed": scene.render.seed})


def sensor_depth(
    depth: NDArray[np.floating], camera: PinholeCamera, settings: SensorSettings, *, frame: int, depth_scale: float
) -> Image:
    """Return the layer ``sensor_depth`` (H, W) of a frame from its exact depth; ``settings`` with its seed.

    The noise is the frame's own, whichever frames are made before, and comes from depth as it is stored, in steps of
    ``depth_scale`` metres, so that a layer made while rendering and one added later agree bit for bit. What the file
    cannot store is out of the sensor's range.
    """
    assert settings.seed is not None
    steps = np.rint(np.asarray(depth, dtype=np.float64) / depth_scale).astype(np.float32)
    stored = steps * np.float32(depth_scale)
    noisy = simulate_depth(stored, camera, settings, rng=sensor_generator(settings.seed, frame))
    noisy[noisy >= (DEPTH_INVALID_MAX - 0.5) * depth_scale] = 0
    return noisy


def distortion_of(camera: PinholeCamera, lens: LensSettings) -> Distortion:
    """Return what ``dataset.json`` says of a lens before a rendered ``camera``."""
    shown = lens_map(camera, lens)
    pinhole = shown.camera
    return Distortion(
        **lens.model_dump(exclude={"magnification"}),
        intrinsics=Intrinsics(
            width=pinhole.width, height=pinhole.height, fx=pinhole.fx, fy=pinhole.fy, cx=pinhole.cx, cy=pinhole.cy
        ),
        shown=round(float(shown.inside.mean()), 6),
    )
