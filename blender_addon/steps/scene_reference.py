"""A scene remembered while a job runs, without keeping anything of Blender's that an undo would take away."""

from dataclasses import dataclass

import bpy
from bpy.app.handlers import persistent

from ..errors import ReconstructionError
from ..results.scene_units import metres_per_unit
from ..settings import ensure_token

_files_opened = 0


@dataclass(frozen=True, kw_only=True)
class SceneReference:
    """A scene's token, name and unit, and how many files had been opened when it was remembered."""

    token: str
    name: str
    file: int
    metres_per_unit: float

    def find(self) -> bpy.types.Scene:
        """Return the scene. Raises ReconstructionError where it is not open any more."""
        scenes = bpy.data.scenes
        by_token = [scene for scene in scenes if scene.scanback.token == self.token]
        if not by_token and self.file == _files_opened:  # an undo may have taken the token away
            by_token = [scene for scene in scenes if scene.name == self.name]
        if not by_token:
            raise ReconstructionError(
                f"The scene {self.name} is not open any more; what was made is kept: open its file and bring it in "
                "with File > Import > Scanback Reconstruction"
            )
        return min(by_token, key=lambda scene: scene.name != self.name)


def remember(scene: bpy.types.Scene) -> SceneReference:
    """Return what ``scene`` can be found by later."""
    return SceneReference(
        token=ensure_token(scene), name=scene.name, file=_files_opened, metres_per_unit=metres_per_unit(scene)
    )


def push_undo(message: str) -> None:
    """Make one undo step of what was done to the scene."""
    if bpy.ops.ed.undo_push.poll():
        bpy.ops.ed.undo_push(message=message)


@persistent  # type: ignore[untyped-decorator]
def _count_file(*_: object) -> None:
    global _files_opened  # noqa: PLW0603
    _files_opened += 1


def register() -> None:
    """Begin to count the files that are opened."""
    bpy.app.handlers.load_post.append(_count_file)


def unregister() -> None:
    """Stop counting."""
    bpy.app.handlers.load_post.remove(_count_file)
