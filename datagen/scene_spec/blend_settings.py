"""A whole scene out of Blender."""

from pathlib import Path

from pydantic import field_validator

from datagen.scene_spec.base import Spec
from datagen.scene_spec.objects import ModelPath


class BlendSettings(Spec):
    """A .blend ``file``, its path relative to the scene file, whose visible surfaces stand in the scene.

    It is taken as it would be rendered at ``frame`` (where not given, its first one) and holds still; only the camera
    moves. Its ``lights`` and its ``world``, where it has one, shine unless switched off; then the scene file's do.
    Scripts in it never run. ``sha256`` identifies its content; reading the scene fills it in.
    """

    file: ModelPath
    sha256: str | None = None
    frame: int | None = None
    lights: bool = True
    world: bool = True

    @field_validator("file")
    @classmethod
    def _is_a_blend(cls, file: str) -> str:
        if Path(file).suffix.lower() != ".blend":
            raise ValueError("expected a .blend; other models are objects: [[objects]] with file")
        return file
