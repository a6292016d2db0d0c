"""How many frames, how large and how carefully."""

from types import MappingProxyType
from typing import Any, Literal

from pydantic import Field, field_validator

from datagen.scene_spec.base import Pixels, Positive, Spec

RenderedLayer = Literal["normals", "masks", "flow"]

PRESETS: MappingProxyType[str, dict[str, Any]] = MappingProxyType(
    {
        "draft": {"samples": 1, "bounces": 1, "denoise": False, "denoise_guided": False},
        "standard": {"samples": 1, "bounces": 3, "denoise": True, "denoise_guided": True},
        "high": {"samples": 32, "bounces": 8, "denoise": True, "denoise_guided": True},
    }
)
"""Settings that trade time for quality, measured by ``benchmarks/render.py``."""


class RenderSettings(Spec):
    """How many frames, how large and how carefully.

    ``samples`` is Cycles' samples a pixel; ``seed`` decides all that is random: their noise, random views and shake;
    ``depth_scale`` is metres per step of the 16-bit depth images, so 65534 steps must reach the farthest surface;
    ``bounces`` limits light paths; ``denoise`` runs OpenImageDenoise in its fast mode on the colours, never on depth.
    ``layers`` are written beside colour and depth: geometric normals, object masks, optical flow to the next frame.
    ``metres_per_unit`` is how long a unit of the scene is, for a .blend that is not in metres: all of the scene file's
    lengths are in that unit then (speeds too), and what is written (depths, poses, ground truth) is in metres.
    """

    frames: int = Field(default=60, ge=1, le=1_000_000)
    size: tuple[Pixels, Pixels] = (640, 480)
    samples: int = Field(default=16, ge=1, le=65536)
    seed: int = Field(default=0, ge=0, le=2**31 - 1)
    depth_scale: Positive = 0.0001
    frames_per_second: Positive = 30.0
    bounces: int = Field(default=4, ge=0, le=64)
    denoise: bool = True
    denoise_guided: bool = True
    layers: tuple[RenderedLayer, ...] = Field(default=(), strict=False)
    metres_per_unit: Positive = 1.0

    @field_validator("layers")
    @classmethod
    def _layers_are_in_one_order(cls, layers: tuple[RenderedLayer, ...]) -> tuple[RenderedLayer, ...]:
        """Order and repetition mean nothing, and must not make two recipes of one."""
        return tuple(sorted(set(layers)))
