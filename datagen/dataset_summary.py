"""What a dataset holds, in numbers."""

import math
from typing import Any

import numpy as np

from datagen.dataset import Dataset
from datagen.errors import InputError

SAMPLED_DEPTH_IMAGES = 20
"""Depth ranges are read from so many images spread over the sequence: enough to know, and quick on long ones."""


def summarise(dataset: Dataset) -> dict[str, Any]:
    """Return a dataset's format, camera, frames, depth range, trajectory and origin, ready for JSON.

    Lengths are metres and angles degrees. Depth comes from at most ``SAMPLED_DEPTH_IMAGES`` frames. Frames that lack a
    file are counted and left out; raises InputError where a file that is there cannot be used.
    """
    present = [frame_id for frame_id in dataset.frame_ids if dataset.is_complete(frame_id)]
    camera = dataset.camera
    mesh = dataset.ground_truth_mesh
    return {
        "folder": str(dataset.folder),
        "format": dataset.format_name,
        "frames_declared": len(dataset.frame_ids),
        "frames_complete": len(present),
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "horizontal_fov_deg": _field_of_view_deg(camera.width, camera.fx, camera.cx),
            "vertical_fov_deg": _field_of_view_deg(camera.height, camera.fy, camera.cy),
        },
        "depth_scale": dataset.depth_scale,
        "layers": list(dataset.layers),
        "depth": _depth_range(dataset, present),
        "trajectory": _trajectory(dataset, present),
        "ground_truth_mesh": str(mesh) if mesh is not None and mesh.is_file() else None,
        "sensor": dataset.metadata.sensor.model_dump(mode="json")
        if dataset.metadata is not None and dataset.metadata.sensor is not None
        else None,
        "distortion": dataset.metadata.distortion.model_dump(mode="json")
        if dataset.metadata is not None and dataset.metadata.distortion is not None
        else None,
        "recipe": dataset.metadata.recipe if dataset.metadata is not None else None,
        "provenance": dataset.metadata.provenance if dataset.metadata is not None else None,
        "notes": list(dataset.notes),
    }


def describe(summary: dict[str, Any]) -> str:
    """Return a summary as lines for people."""
    camera, depth, path = summary["camera"], summary["depth"], summary["trajectory"]
    lines = {
        "format": summary["format"],
        "frames": f"{summary['frames_complete']} complete of {summary['frames_declared']}",
        "camera": f"{camera['width']}×{camera['height']}, fx {camera['fx']:.3f} fy {camera['fy']:.3f} "
        f"cx {camera['cx']:.3f} cy {camera['cy']:.3f} px, "
        f"field of view {camera['horizontal_fov_deg']:.1f}°×{camera['vertical_fov_deg']:.1f}°",
        "depth": f"{summary['depth_scale']:g} m a step",
        "trajectory": "none yet",
        "truth": summary["ground_truth_mesh"] or "no mesh",
    }
    if depth is not None:
        lines["depth"] += (
            f", {depth['nearest_m']:.3f} to {depth['farthest_m']:.3f} m, {depth['valid_fraction']:.0%} of pixels valid "
            f"(from {depth['frames_read']} frames)"
        )
    if path is not None:
        extent = " × ".join(f"{side:.2f}" for side in path["extent_m"])
        lines["trajectory"] = f"{path['length_m']:.2f} m long, within {extent} m"
    if summary["layers"]:
        lines["layers"] = ", ".join(summary["layers"])
    if summary["sensor"] is not None:
        lines["sensor"] = f"{summary['sensor']['model']}, seed {summary['sensor']['seed']}"
    if summary["distortion"] is not None:
        bent = ", ".join(f"{key} {value:g}" for key, value in summary["distortion"].items() if key[0] in "kp" and value)
        lines["lens"] = f"{bent or 'no distortion'}; {summary['distortion']['shown']:.1%} of its pixels show something"
    if summary["recipe"]:
        render = summary["recipe"].get("render")
        render = render if isinstance(render, dict) else {}
        lines["scene"] = f"{summary['recipe'].get('name')}, {render.get('samples')} samples, seed {render.get('seed')}"
    made = summary["provenance"] or {}
    if "blender" in made:
        lines["made by"] = f"Blender {made['blender']} on {made.get('device')} ({made.get('device_name')})"
    if "converted_from" in made:
        lines["converted"] = f"from {made['converted_from'].get('format')}"
    rows = [*lines.items(), *(("note", note) for note in summary["notes"])]
    return "\n".join([summary["folder"], *(f"  {name:<11}{value}" for name, value in rows)])


def _field_of_view_deg(pixels: int, focal_length_px: float, centre_px: float) -> float:
    """Return the angle between the image's two edges, half a pixel outside the outer pixels' centres."""
    below, above = centre_px + 0.5, pixels - 0.5 - centre_px
    return math.degrees(math.atan2(below, focal_length_px) + math.atan2(above, focal_length_px))


def _depth_range(dataset: Dataset, frame_ids: list[int]) -> dict[str, Any] | None:
    if not frame_ids:
        return None
    chosen = frame_ids[:: math.ceil(len(frame_ids) / SAMPLED_DEPTH_IMAGES)]
    images = [dataset.depth(frame_id) for frame_id in chosen]
    valid = np.concatenate([image[image > 0] for image in images])
    if valid.size == 0:
        raise InputError(f"{dataset.folder}: {len(chosen)} depth images were read and none has a valid pixel")
    return {
        "nearest_m": float(valid.min()),
        "farthest_m": float(valid.max()),
        "valid_fraction": valid.size / sum(image.size for image in images),
        "frames_read": len(chosen),
    }


def _trajectory(dataset: Dataset, frame_ids: list[int]) -> dict[str, Any] | None:
    if not frame_ids:
        return None
    positions = np.array([dataset.world_from_camera(frame_id)[:3, 3] for frame_id in frame_ids])
    return {
        "length_m": float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum()),
        "extent_m": np.ptp(positions, axis=0).tolist(),
    }
