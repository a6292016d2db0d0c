"""A whole scene file."""

from itertools import pairwise
from typing import Self

from pydantic import field_validator, model_validator

from datagen.scene_spec.base import Name, Spec
from datagen.scene_spec.camera_settings import CameraSettings
from datagen.scene_spec.keyframes import Keyframe
from datagen.scene_spec.lights import LightSettings, WorldSettings
from datagen.scene_spec.materials import MaterialSettings
from datagen.scene_spec.objects import ObjectSettings
from datagen.scene_spec.render_settings import RenderSettings


class Scene(Spec):
    """A whole scene file."""

    name: Name
    description: str = ""
    render: RenderSettings = RenderSettings()
    camera: CameraSettings = CameraSettings()
    world: WorldSettings = WorldSettings()
    materials: dict[str, MaterialSettings]
    objects: tuple[ObjectSettings, ...]
    lights: tuple[LightSettings, ...] = ()
    keyframes: tuple[Keyframe, ...]

    @field_validator("keyframes")
    @classmethod
    def _keys_follow_each_other(cls, keys: tuple[Keyframe, ...]) -> tuple[Keyframe, ...]:
        if not keys:
            raise ValueError("give at least one")
        for i, (key, following) in enumerate(pairwise(keys)):
            if following.time <= key.time:
                raise ValueError(
                    f"times must increase, but key [{i + 1}] has time {following.time} after {key.time} of key [{i}]"
                )
            if (following.look_at is None) != (key.look_at is None):
                raise ValueError(f"use look_at in all keys or quat_wxyz in all; keys [{i}] and [{i + 1}] differ")
        return keys

    @field_validator("objects")
    @classmethod
    def _names_are_unique(cls, objects: tuple[ObjectSettings, ...]) -> tuple[ObjectSettings, ...]:
        if not objects:
            raise ValueError("give at least one")
        seen: dict[str, int] = {}
        for i, settings in enumerate(objects):
            if settings.name in seen:
                raise ValueError(f"objects [{seen[settings.name]}] and [{i}] have the same name, {settings.name!r}")
            seen[settings.name] = i
        return objects

    @model_validator(mode="after")
    def _materials_exist(self) -> Self:
        for i, settings in enumerate(self.objects):
            if settings.material not in self.materials:
                known = ", ".join(sorted(self.materials)) or "none"
                raise ValueError(f"objects[{i}].material: no material {settings.material!r}; there are: {known}")
        return self
