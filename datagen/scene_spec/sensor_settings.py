"""The depth sensor that is simulated beside the exact depth."""

from typing import Literal, Self

from pydantic import Field, model_validator

from datagen.scene_spec.base import NotNegative, Positive, Spec

SensorModel = Literal["kinect-v1", "realsense-d435"]


class SensorSettings(Spec):
    """A simulated depth sensor; its image lies beside the exact depth as the layer ``sensor_depth``.

    ``seed`` (the render seed where not given) decides the noise of every frame. ``axial``, ``lateral`` and
    ``quantisation`` multiply what the model says: noise along z, displacement of edges, size of the depth steps; 0
    turns each off. ``grazing``, ``shadow`` and ``edges`` tell whether returns are lost on surfaces seen at a grazing
    angle, where the projector or second camera does not see, and at edges of depth. ``nearest`` and ``farthest``
    (metres) replace the model's range.
    """

    model: SensorModel
    seed: int | None = Field(default=None, ge=0, le=2**31 - 1)
    axial: NotNegative = 1.0
    lateral: NotNegative = 1.0
    quantisation: NotNegative = 1.0
    grazing: bool = True
    shadow: bool = True
    edges: bool = True
    nearest: NotNegative | None = None
    farthest: Positive | None = None

    @model_validator(mode="after")
    def _range_is_not_empty(self) -> Self:
        if self.nearest is not None and self.farthest is not None and self.farthest <= self.nearest:
            raise ValueError(f"farthest {self.farthest} must be greater than nearest {self.nearest}")
        return self
