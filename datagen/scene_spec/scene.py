"""A whole scene file."""

from typing import Self

from pydantic import Field, field_validator, model_validator

from datagen.scene_spec.base import Name, Spec
from datagen.scene_spec.blend_settings import BlendSettings
from datagen.scene_spec.camera_settings import CameraSettings
from datagen.scene_spec.keyframes import Keyframes
from datagen.scene_spec.lens_settings import LensSettings
from datagen.scene_spec.lights import LightSettings, WorldSettings
from datagen.scene_spec.materials import MaterialSettings
from datagen.scene_spec.objects import ObjectSettings
from datagen.scene_spec.render_settings import RenderSettings
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.scene_spec.trajectory_settings import KeyframeTrajectory, Trajectory


class Scene(Spec):
    """A whole scene file."""

    name: Name
    description: str = ""
    render: RenderSettings = RenderSettings()
    camera: CameraSettings = CameraSettings()
    sensor: SensorSettings | None = None
    lens: LensSettings | None = None
    world: WorldSettings = WorldSettings()
    blend: BlendSettings | None = None
    materials: dict[str, MaterialSettings] = Field(default_factory=dict)
    objects: tuple[ObjectSettings, ...] = ()
    lights: tuple[LightSettings, ...] = ()
    keyframes: Keyframes | None = None
    trajectory: Trajectory | None = None

    @model_validator(mode="after")
    def _camera_moves_in_one_way(self) -> Self:
        if self.keyframes is None and self.trajectory is None:
            raise ValueError("keyframes: missing; give keyframes or a trajectory")
        if self.keyframes is not None and self.trajectory is not None:
            raise ValueError("give keyframes or a trajectory, not both")
        return self

    @property
    def camera_motion(self) -> Trajectory:
        """How the camera moves, in whichever way the file says it."""
        if self.trajectory is not None:
            return self.trajectory
        assert self.keyframes is not None
        return KeyframeTrajectory(keyframes=self.keyframes)

    @field_validator("objects")
    @classmethod
    def _names_are_unique(cls, objects: tuple[ObjectSettings, ...]) -> tuple[ObjectSettings, ...]:
        seen: dict[str, int] = {}
        for i, settings in enumerate(objects):
            if settings.name in seen:
                raise ValueError(f"objects [{seen[settings.name]}] and [{i}] have the same name, {settings.name!r}")
            seen[settings.name] = i
        return objects

    @model_validator(mode="after")
    def _something_stands_in_it(self) -> Self:
        if not self.objects and self.blend is None:
            raise ValueError("objects: missing; give at least one, or a blend")
        return self

    @model_validator(mode="after")
    def _materials_exist(self) -> Self:
        for i, settings in enumerate(self.objects):
            for j, part in enumerate(settings.all_parts):
                place = f"objects[{i}].parts[{j}]" if settings.parts else f"objects[{i}]"
                for key in ("material", "inner_material"):
                    name = getattr(part, key)
                    if name is not None and name not in self.materials:
                        known = ", ".join(sorted(self.materials)) or "none"
                        raise ValueError(f"{place}.{key}: no material {name!r}; there are: {known}")
        return self
