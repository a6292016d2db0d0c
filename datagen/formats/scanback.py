"""Our own format: ``dataset.json`` and the folder ``frames`` (see docs/formats.md)."""

import shutil
from pathlib import Path

import numpy as np

from datagen.atomic_write import replacing
from datagen.dataset import Dataset, FrameRecord
from datagen.dataset_format import (
    FRAMES_FOLDER,
    GROUND_TRUTH_FILE,
    METADATA_FILE,
    Intrinsics,
    Metadata,
    frame_file,
    read_metadata,
    write_metadata,
)
from datagen.dataset_writer import write_pose
from datagen.formats.format import Conversion, DatasetFormat

NOMINAL_FRAMES_PER_SECOND = 30.0
UNIFORM_TOLERANCE = 1e-3
"""How far, in frames, a time may lie from the beat for all of them to be told by one frame rate."""


def detect(folder: Path) -> bool:
    """Tell whether a folder holds our metadata."""
    return (folder / METADATA_FILE).is_file()


def open_scanback(folder: Path) -> Dataset:
    """Open a dataset of ours; raises InputError naming the key of ``dataset.json`` at fault."""
    metadata = read_metadata(folder)
    frames = folder / FRAMES_FOLDER
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames={
            i: FrameRecord(
                color=frame_file(frames, i, "color.png"),
                depth=frame_file(frames, i, "depth.png"),
                pose=frame_file(frames, i, "pose.txt"),
                timestamp_s=i / metadata.frames_per_second,
            )
            for i in range(metadata.frame_count)
        },
        camera=metadata.intrinsics.camera,
        depth_scale=metadata.depth_scale,
        layers=metadata.layers,
        ground_truth_mesh=folder / metadata.ground_truth_mesh if metadata.ground_truth_mesh else None,
        metadata=metadata,
    )


def frame_rate(conversion: Conversion) -> tuple[float, bool]:
    """Return the frames per second that a conversion's times stand for, and whether they say as much exactly."""
    times = [conversion.source.timestamp_s(frame.frame_id) for frame in conversion.frames]
    known = np.array([time for time in times if time is not None])
    if len(known) < max(2, len(times)) or known[-1] <= known[0]:
        return NOMINAL_FRAMES_PER_SECOND, False
    rate = float((len(known) - 1) / (known[-1] - known[0]))
    beat = (known - known[0]) * rate - np.arange(len(known))
    return float(f"{rate:.9g}"), bool(np.abs(beat).max() <= UNIFORM_TOLERANCE and known[0] == 0)


def write_index(conversion: Conversion) -> None:
    """Write poses, the ground-truth mesh and, last, ``dataset.json``; what came from where goes into ``provenance``."""
    source, camera = conversion.source, conversion.source.camera
    for frame in conversion.frames:
        write_pose(frame_file(conversion.folder / FRAMES_FOLDER, frame.number, "pose.txt"), frame.world_from_camera)
    mesh = source.ground_truth_mesh
    has_mesh = mesh is not None and mesh.is_file()
    if mesh is not None and has_mesh:
        with replacing(conversion.folder / GROUND_TRUTH_FILE) as temporary:
            shutil.copyfile(mesh, temporary)
    converted = {
        "format": source.format_name,
        "frames": [frame.frame_id for frame in conversion.frames],
        "timestamps_s": [source.timestamp_s(frame.frame_id) for frame in conversion.frames],
    }
    metadata = Metadata(
        frame_count=len(conversion.frames),
        intrinsics=Intrinsics(
            width=camera.width, height=camera.height, fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy
        ),
        depth_scale=conversion.depth_scale,
        frames_per_second=frame_rate(conversion)[0],
        ground_truth_mesh=GROUND_TRUTH_FILE if has_mesh else None,
        recipe=source.metadata.recipe if source.metadata is not None else {},
        provenance={**(source.metadata.provenance if source.metadata is not None else {}), "converted_from": converted},
    )
    write_metadata(conversion.folder, metadata)


def _advice(conversion: Conversion) -> tuple[str, ...]:
    rate, exact = frame_rate(conversion)
    times_s = [conversion.source.timestamp_s(frame.frame_id) for frame in conversion.frames]
    if exact or all(time is None for time in times_s):
        return ()
    return (f"timestamps: frame i is at i / {rate:g} s; the original times are in dataset.json under provenance",)


FORMAT = DatasetFormat(
    name="scanback",
    title="scanback",
    detect=detect,
    open=open_scanback,
    image_names=lambda number, _: (
        f"{FRAMES_FOLDER}/frame-{number:06d}.color",
        f"{FRAMES_FOLDER}/frame-{number:06d}.depth.png",
    ),
    write_index=write_index,
    color_suffixes=(".png",),
    carries=frozenset({"timestamps", "ground-truth mesh", "recipe"}),
    advice=_advice,
)
