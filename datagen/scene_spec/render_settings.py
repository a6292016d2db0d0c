"""How many frames, how large and how carefully."""

from pydantic import Field

from datagen.scene_spec.base import Pixels, Positive, Spec


class RenderSettings(Spec):
    """How many frames, how large and how carefully.

    ``samples`` is Cycles' samples a pixel and ``seed`` decides their noise; ``depth_scale`` is metres per step of the
    16-bit depth images, so 65534 steps must reach the farthest surface; ``bounces`` limits light paths; ``denoise``
    runs OpenImageDenoise in its fast mode on the colours, never on depth.
    """

    frames: int = Field(default=60, ge=1, le=1_000_000)
    size: tuple[Pixels, Pixels] = (640, 480)
    samples: int = Field(default=16, ge=1, le=65536)
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    depth_scale: Positive = 0.0001
    frames_per_second: Positive = 30.0
    bounces: int = Field(default=4, ge=0, le=64)
    denoise: bool = True
