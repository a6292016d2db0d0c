"""The extension's preferences: where files that nobody keeps go, and what computes."""

# mypy: disable-error-code="valid-type,misc"
import tempfile
from pathlib import Path
from typing import Any

import bpy

RENDER_DEVICES = (
    ("auto", "Best There Is", "A graphics card where Cycles finds one, else the processor"),
    ("cpu", "Processor", "Render on the processor"),
    ("optix", "OptiX", "NVIDIA cards, with ray tracing cores"),
    ("cuda", "CUDA", "NVIDIA cards"),
    ("hip", "HIP", "AMD cards"),
    ("metal", "Metal", "Apple"),
    ("oneapi", "oneAPI", "Intel cards"),
)
FUSION_DEVICES = (
    ("auto", "Best There Is", "An NVIDIA graphics card where there is one, else the processor"),
    ("cpu", "Processor", "Fuse on the processor, on all of its cores"),
    ("cuda", "CUDA", "Fuse on the first NVIDIA graphics card"),
)


class SCANBACK_AP_preferences(bpy.types.AddonPreferences):  # noqa: N801 - Blender's naming
    """What a user sets once for all files."""

    bl_idname = __package__ or ""

    cache_folder: bpy.props.StringProperty(
        name="Cache Folder",
        description="Where running jobs keep their files, and scans of scenes that are not saved yet; "
        "empty for the extension's own folder",
        subtype="DIR_PATH",
    )
    render_device: bpy.props.EnumProperty(
        name="Scan On", description="What renders the frames of a scan", items=RENDER_DEVICES, default="auto"
    )
    fusion_device: bpy.props.EnumProperty(
        name="Fuse On", description="What fuses, locates and compares", items=FUSION_DEVICES, default="auto"
    )

    def draw(self, context: Any) -> None:  # noqa: ARG002
        """Draw them."""
        self.layout.use_property_split = True
        for name in ("cache_folder", "render_device", "fusion_device"):
            self.layout.prop(self, name)


def cache_folder() -> Path:
    """Return the folder for files that nobody keeps; it may not exist yet."""
    chosen = _chosen("cache_folder", "")
    if chosen:
        return Path(bpy.path.abspath(chosen))
    try:
        return Path(bpy.utils.extension_path_user(__package__))
    except ValueError:  # not installed as an extension: run from a checkout
        return Path(tempfile.gettempdir()) / "scanback"


def render_device() -> str:
    """Return what renders scans, as ``datagen render --device`` has it."""
    return str(_chosen("render_device", "auto"))


def fusion_device() -> str:
    """Return what fuses, as ``fusion --device`` has it."""
    return str(_chosen("fusion_device", "auto"))


def _chosen(name: str, default: str) -> str:
    addon = bpy.context.preferences.addons.get(__package__)
    return default if addon is None or addon.preferences is None else getattr(addon.preferences, name)


def register() -> None:
    """Add the preferences."""
    bpy.utils.register_class(SCANBACK_AP_preferences)


def unregister() -> None:
    """Take them away."""
    bpy.utils.unregister_class(SCANBACK_AP_preferences)
