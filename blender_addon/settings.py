"""What the four steps can be told: properties that the panel keeps in the scene and the operators take as arguments."""

# mypy: disable-error-code="valid-type,misc"
import uuid
from typing import Any

import bpy

SUBJECTS = (
    ("SCENE", "Scene", "All that the scene would render, with its lights"),
    ("OBJECT", "Active Object", "The active object and its children alone, under lights of its size"),
)
TRAJECTORIES = (
    ("CAMERA", "Active Camera", "The scene's camera along its animation, over the scene's frame range"),
    ("ORBIT", "Orbit", "Circles around the subject at one elevation"),
    ("HEMISPHERE", "Hemisphere", "A spiral that sees the subject evenly from all sides and above"),
)
PRESETS = (
    ("draft", "Draft", "One sample a pixel: fast and noisy"),
    ("standard", "Standard", "Few samples, denoised"),
    ("high", "High", "Many samples, denoised: slow and clean"),
)
SENSORS = (
    ("NONE", "None", "Exact depth alone"),
    ("kinect-v1", "Kinect v1", "Also the noisy depth that a Microsoft Kinect of 2010 would give"),
    ("realsense-d435", "RealSense D435", "Also the noisy depth that an Intel RealSense D435 would give"),
)
MESHERS = (
    ("marching-cubes", "Marching Cubes", "Smooth surfaces, fast"),
    ("dual-contouring", "Dual Contouring", "Keeps sharp edges, slower"),
)
QUERIES = (
    ("FRAME", "Dataset Frame", "A frame of the dataset, by its number"),
    ("HELD_OUT", "Frames Left Out", "All frames of the dataset that were not fused"),
    ("FILES", "Image Files", "A color image and a depth image"),
    ("VIEW", "Viewport", "What the 3D viewport shows now of the reconstruction"),
    ("CAMERA", "Scene's Camera", "What the scene's camera sees of the reconstruction"),
)
TRUTHS = (
    ("DATASET", "What Was Scanned", "The mesh that was rendered, which the scan keeps in its dataset"),
    ("OBJECT", "An Object", "An object of this scene as its modifiers make it"),
)
PATH_OPTIONS = {"PATH_SUPPORTS_BLEND_RELATIVE"} if bpy.app.version >= (4, 5, 0) else set()


class FolderProperties:
    """Where a scan lives."""

    folder: bpy.props.StringProperty(
        name="Folder",
        description="Folder of the scan, its reconstruction and all that belongs to them; "
        "empty for one beside the .blend file",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )


class ScanProperties:
    """How a scan is rendered."""

    subject: bpy.props.EnumProperty(name="Subject", description="What is scanned", items=SUBJECTS)
    trajectory: bpy.props.EnumProperty(
        name="Path", description="How the scanning camera moves", items=TRAJECTORIES, default="ORBIT"
    )
    frames: bpy.props.IntProperty(
        name="Frames", description="How many frames are rendered", default=60, min=1, soft_max=1000, max=1_000_000
    )
    width: bpy.props.IntProperty(
        name="Width", description="Width of the frames", default=640, min=4, max=8192, subtype="PIXEL"
    )
    height: bpy.props.IntProperty(
        name="Height", description="Height of the frames", default=480, min=4, max=8192, subtype="PIXEL"
    )
    preset: bpy.props.EnumProperty(
        name="Quality", description="How carefully colors are rendered; depth is exact always", items=PRESETS,
        default="draft",
    )  # fmt: skip
    sensor: bpy.props.EnumProperty(name="Sensor", description="A depth sensor that is simulated", items=SENSORS)
    elevation: bpy.props.FloatProperty(
        name="Elevation", description="How high the orbit lies above the horizon", subtype="ANGLE",
        default=0.5, min=-1.5, max=1.5,
    )  # fmt: skip
    turns: bpy.props.FloatProperty(
        name="Turns", description="How often the orbit goes around", default=1.0, min=0.05, soft_max=10
    )
    distance: bpy.props.FloatProperty(
        name="Distance", description="From the subject's center to the camera; 0 has it fill the image",
        subtype="DISTANCE", default=0.0, min=0.0,
    )  # fmt: skip


class FuseProperties:
    """How a dataset is fused."""

    dataset: bpy.props.StringProperty(
        name="Dataset",
        description="Folder of the dataset that is fused; empty for the one scanned here",
        subtype="DIR_PATH",
        options=PATH_OPTIONS,
    )
    voxel_size: bpy.props.FloatProperty(
        name="Voxel Size", description="Side of a voxel; 0 takes what suits the data", subtype="DISTANCE",
        default=0.0, min=0.0, precision=4, step=0.1,
    )  # fmt: skip
    truncation: bpy.props.FloatProperty(
        name="Truncation", description="How far from the surface voxels are filled; 0 takes four voxels",
        subtype="DISTANCE", default=0.0, min=0.0, precision=4, step=0.1,
    )  # fmt: skip
    depth_max: bpy.props.FloatProperty(
        name="Farthest", description="Depth beyond this is left out; 0 takes all", subtype="DISTANCE",
        default=0.0, min=0.0,
    )  # fmt: skip
    every: bpy.props.IntProperty(
        name="Every Nth", description="Fuse every Nth frame; with 2, half of them are left to be located",
        default=1, min=1, soft_max=20,
    )  # fmt: skip
    mesher: bpy.props.EnumProperty(name="Mesher", description="How the surface is drawn", items=MESHERS)
    use_sensor_depth: bpy.props.BoolProperty(
        name="Sensor's Depth", description="Fuse the simulated sensor's depth in the place of the exact one"
    )
    device: bpy.props.StringProperty(
        name="Device", description="What fuses: auto, cpu, cuda or cuda:1; empty for that of the preferences",
        search=lambda self, context, text: suggested_devices(),  # noqa: ARG005
    )  # fmt: skip
    live: bpy.props.BoolProperty(
        name="Watch It Grow", description="Show the mesh in the viewport while frames are fused", default=True
    )


class LocateProperties:
    """What is located, and how."""

    query: bpy.props.EnumProperty(name="Query", description="The view whose place is asked for", items=QUERIES)
    frame: bpy.props.IntProperty(name="Frame", description="Number of the frame in the dataset", min=0)
    color_file: bpy.props.StringProperty(
        name="Color", description="The color image; needed where the pose is refined by features alone",
        subtype="FILE_PATH", options=PATH_OPTIONS,
    )  # fmt: skip
    depth_file: bpy.props.StringProperty(
        name="Depth", description="The depth image: 16 bits a pixel, planar depth, as large as the scan's frames",
        subtype="FILE_PATH", options=PATH_OPTIONS,
    )  # fmt: skip
    depth_scale: bpy.props.FloatProperty(
        name="Depth Step", description="How much a step of the depth image is, in metres",
        default=0.001, min=1e-6, max=1.0, precision=4,
    )  # fmt: skip
    refine: bpy.props.BoolProperty(
        name="Refine", description="Refine the nearest frame's pose by depth, and judge whether to believe it"
    )


class CompareProperties:
    """What the reconstruction is held against."""

    truth: bpy.props.EnumProperty(name="Against", description="What the mesh is held against", items=TRUTHS)
    object_name: bpy.props.StringProperty(name="Object", description="The object that the mesh is held against")
    limit: bpy.props.FloatProperty(
        name="Full Color At", description="Errors from this on have the last color; 0 takes what 95 % stay below",
        subtype="DISTANCE", default=0.0, min=0.0, precision=5,
    )  # fmt: skip


class SCANBACK_PG_scan(ScanProperties, bpy.types.PropertyGroup):  # noqa: N801 - Blender's naming
    """Settings of the step Scan."""


class SCANBACK_PG_fuse(FuseProperties, bpy.types.PropertyGroup):  # noqa: N801
    """Settings of the step Fuse."""


class SCANBACK_PG_locate(LocateProperties, bpy.types.PropertyGroup):  # noqa: N801
    """Settings of the step Locate."""


def _is_in_scene(settings: Any, item: Any) -> bool:
    return settings.id_data in item.users_scene


def _choose_original(settings: Any, name: str) -> None:
    settings.original = settings.id_data.objects.get(name)


class SCANBACK_PG_compare(CompareProperties, bpy.types.PropertyGroup):  # noqa: N801
    """Settings of the step Compare; the object is kept whatever it is called, and can be named too."""

    original: bpy.props.PointerProperty(
        type=bpy.types.Object, name="Object", description="The object that the mesh is held against", poll=_is_in_scene
    )
    object_name: bpy.props.StringProperty(
        name="Object",
        description="The name of the object that the mesh is held against",
        get=lambda self: self.original.name if self.original is not None else "",
        set=_choose_original,
    )


class SCANBACK_PG_original(bpy.types.PropertyGroup):  # noqa: N801
    """An object whose place the reconstruction in ``folder`` takes, whatever it is called."""

    item: bpy.props.PointerProperty(type=bpy.types.Object)
    folder: bpy.props.StringProperty(subtype="DIR_PATH", options=PATH_OPTIONS)
    is_kept_from_renders: bpy.props.BoolProperty()


class SCANBACK_PG_scene(FolderProperties, bpy.types.PropertyGroup):  # noqa: N801
    """All settings of a scene; ``token`` tells it from others, whatever it is called."""

    token: bpy.props.StringProperty(options={"HIDDEN"})
    originals: bpy.props.CollectionProperty(type=SCANBACK_PG_original, options={"HIDDEN"})
    scan: bpy.props.PointerProperty(type=SCANBACK_PG_scan)
    fuse: bpy.props.PointerProperty(type=SCANBACK_PG_fuse)
    locate: bpy.props.PointerProperty(type=SCANBACK_PG_locate)
    compare: bpy.props.PointerProperty(type=SCANBACK_PG_compare)


CLASSES = (
    SCANBACK_PG_scan,
    SCANBACK_PG_fuse,
    SCANBACK_PG_locate,
    SCANBACK_PG_compare,
    SCANBACK_PG_original,
    SCANBACK_PG_scene,
)


def chosen(operator: Any, group: Any, properties: type) -> dict[str, Any]:
    """Return a step's settings: an operator's arguments where they were given, the panel's where not."""
    return {
        name: getattr(operator if operator.properties.is_property_set(name) else group, name)
        for name in properties.__annotations__
    }


def ensure_token(scene: Any) -> str:
    """Return the scene's token, given to it now where it has none."""
    if not scene.scanback.token:
        scene.scanback.token = uuid.uuid4().hex
    return str(scene.scanback.token)


_devices = ["cpu", "cuda"]


def suggested_devices() -> list[str]:
    """Return what may stand as a device: those of this machine, once a job has told which there are."""
    return ["auto", *_devices]


def note_devices(names: list[str]) -> None:
    """Keep the names of this machine's devices."""
    _devices[:] = names


def register() -> None:
    """Add the settings to scenes."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Scene.scanback = bpy.props.PointerProperty(type=SCANBACK_PG_scene)


def unregister() -> None:
    """Take them away."""
    del bpy.types.Scene.scanback
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)
