"""The steps' settings in a panel, where lengths that are chosen for the user say what they amount to."""

from typing import Any

from ..operators.automatic import SCANBACK_OT_choose_length
from ..results.scene_units import length_text, metres_per_unit
from ..steps.automatic import known_truncation, known_voxel_size

LABEL_SHARE = 0.4
"""Of the width: what Blender's own split gives labels."""
PLACEHOLDERS = {"folder": "Automatic", "dataset": "Scanned here", "device": "From preferences"}
"""What an empty setting stands for."""


def draw_settings(layout: Any, group: Any, *names: str) -> None:
    """Draw some of a step's settings."""
    column = layout.column()
    column.use_property_split = True
    column.use_property_decorate = False
    for name in names:
        column.prop(group, name, placeholder=PLACEHOLDERS.get(name, ""))


def draw_length(layout: Any, group: Any, length: str, automatic: str) -> None:
    """Draw the setting ``length``, as ``fuse.voxel_size``; where it is 0, what is taken: ``automatic``."""
    name = length.partition(".")[2]
    split = layout.split(factor=LABEL_SHARE)
    label = split.row()
    label.alignment = "RIGHT"
    label.label(text=group.bl_rna.properties[name].name)
    row = split.row(align=True)
    is_chosen = getattr(group, name) > 0
    if is_chosen:
        row.prop(group, name, text="")
        button = row.operator(SCANBACK_OT_choose_length.bl_idname, text="", icon="X")
    else:
        button = row.operator(SCANBACK_OT_choose_length.bl_idname, text=automatic)
    button.length, button.automatic = length, is_chosen


def automatic_voxel_size(scene: Any) -> str:
    """Say what voxel size is taken."""
    return _automatic(scene, known_voxel_size(scene))


def automatic_truncation(scene: Any) -> str:
    """Say what truncation is taken."""
    return _automatic(scene, known_truncation(scene))


def automatic_limit(scene: Any, limit_m: float | None) -> str:
    """Say from which distance on errors have the last color; ``limit_m`` is that of the errors that are shown."""
    return "Automatic" if limit_m is None else f"Auto, {length_text(scene, limit_m)}"


def _automatic(scene: Any, length: float | None) -> str:
    return "Automatic" if length is None else f"Auto, {length_text(scene, length * metres_per_unit(scene))}"
