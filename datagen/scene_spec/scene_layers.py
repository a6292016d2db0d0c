"""Which layers the frames of a scene have."""

from datagen.scene_spec.scene import Scene

STEREO_LAYERS = ("right_color", "right_depth")
SENSOR_LAYER = "sensor_depth"
LENS_LAYERS = ("distorted_color", "distorted_depth")


def layers_of(scene: Scene) -> tuple[str, ...]:
    """Return the names of all layers that belong to each frame of ``scene``, keys of ``datagen.layers.LAYERS``."""
    stereo = STEREO_LAYERS if scene.camera.stereo_baseline is not None else ()
    sensor = (SENSOR_LAYER,) if scene.sensor is not None else ()
    lens = LENS_LAYERS if scene.lens is not None else ()
    return (*scene.render.layers, *stereo, *sensor, *lens)
