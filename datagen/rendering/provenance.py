"""``dataset.json`` of a rendered dataset: what decides its frames, and what made them.

Shards of a dataset write the same bytes on machines of one kind. What is nobody's business but the one machine's (its
name, its kernel's version, the time) is left out, so that they can.
"""

import platform
from pathlib import Path
from typing import Any

import cv2

from datagen.dataset_format import (
    GROUND_TRUTH_FILE,
    METADATA_FILE,
    Intrinsics,
    Metadata,
    read_metadata,
    write_metadata,
)
from datagen.errors import InputError
from datagen.program_version import program_version
from datagen.rendering.recipes import recipe_of
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.scene_layers import layers_of
from datagen.sensors.extra_layers import distortion_of, sensor_of

MUST_AGREE = ("blender", "blender_build", "device")
LARGEST_INTRINSICS_CHANGE_PX = 1e-4
"""Datasets of earlier versions have intrinsics that went through Blender's single precision."""


def metadata_of(scene: Scene, description: dict[str, Any]) -> Metadata:
    """Return the metadata of frames that ``scene`` renders to where Blender gives ``description`` of itself."""
    intrinsics = Intrinsics(**description["intrinsics"])
    return Metadata(
        frame_count=scene.render.frames,
        intrinsics=intrinsics,
        depth_scale=scene.render.depth_scale,
        frames_per_second=scene.render.frames_per_second,
        layers=layers_of(scene),
        ground_truth_mesh=GROUND_TRUTH_FILE,
        sensor=sensor_of(scene),
        distortion=distortion_of(intrinsics.camera, scene.lens) if scene.lens is not None else None,
        recipe=recipe_of(scene),
        provenance={
            "program": program_version(),
            **description["provenance"],
            "system": f"{platform.system()} {platform.machine()}",
            "python": ".".join(platform.python_version_tuple()[:2]),
            "opencv": cv2.__version__,
        },
    )


def settle_metadata(folder: Path, scene: Scene, description: dict[str, Any]) -> None:
    """Write ``dataset.json``, or check that what begins to render now goes with what rendered the frames there.

    Another device of the same type is taken, and noted: its frames may differ in the last bit of some colours.
    """
    now = metadata_of(scene, description)
    if not (folder / METADATA_FILE).is_file():
        write_metadata(folder, now)
        return
    begun = read_metadata(folder)
    joined = join_metadata(begun, now, names=(str(folder), "what would go on with it"))
    if joined != begun:
        write_metadata(folder, joined)


def join_metadata(first: Metadata, second: Metadata, *, names: tuple[str, str]) -> Metadata:
    """Return the metadata of frames of which some were rendered as ``first`` and some as ``second`` says.

    Raises InputError where they would not match: another version of Blender, type of device or camera.
    """
    for key in MUST_AGREE:
        one, other = first.provenance.get(key), second.provenance.get(key)
        if None not in (one, other) and one != other:
            raise InputError(
                f"{names[0]}: its frames were rendered with {key} {one}, {names[1]} has {other}, and they would not "
                f"match; use {one} again, or another folder"
            )
    for key, there in first.intrinsics.model_dump().items():
        other = getattr(second.intrinsics, key)
        if abs(there - other) > LARGEST_INTRINSICS_CHANGE_PX:
            raise InputError(f"{names[0]}: its camera has {key} {there}, {names[1]} has {other}")
    devices = {
        name for metadata in (first, second) for name in str(metadata.provenance.get("device_name", "")).split(" or ")
    }
    return first.model_copy(update={"provenance": first.provenance | {"device_name": " or ".join(sorted(devices))}})
