"""BOP: one scene's folder, ``scene_camera.json`` beside ``rgb`` and ``depth``; lengths in millimetres.

``cam_K`` has integer pixel centres, as in bop_toolkit's own conversions of depth images; a depth image's value times
``depth_scale`` is millimetres. Cameras are ``cam_R_w2c`` and ``cam_t_w2c``: camera_from_world. ``scene_gt.json`` poses
objects as camera_from_model; a dataset of ours with a true mesh has one object, the whole scene in world coordinates.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from datagen.atomic_write import replacing, write_bytes
from datagen.dataset import Dataset, FrameRecord
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat
from datagen.formats.intrinsics_file import camera_from_matrix
from datagen.formats.json_file import depth_scale, numbers, read_json_object
from datagen.images import image_size
from datagen.interrupts import interrupts_held
from datagen.rigid import Matrix, inverse, rigid

CAMERA_FILE = "scene_camera.json"
OBJECTS_FILE = "scene_gt.json"
MODEL_FILE = "models/obj_000001.ply"
COLOR_FOLDERS = ("rgb", "gray")
SUFFIXES = (".png", ".jpg", ".tif", ".tiff")
MM_PER_METRE = 1000.0


def detect(folder: Path) -> bool:
    """Tell whether a folder holds BOP's cameras of a scene."""
    return (folder / CAMERA_FILE).is_file()


def open_bop(folder: Path) -> Dataset:
    """Open a scene. Raises InputError, naming image and key, for malformed cameras and for cameras that differ."""
    path = folder / CAMERA_FILE
    entries = _entries(path)
    first = next(iter(entries))
    matrix, scale = _camera_matrix(entries[first], path, first), _metres_per_step(entries[first], path, first)
    for number, entry in entries.items():
        if not np.allclose(_camera_matrix(entry, path, number), matrix, rtol=0, atol=1e-6):
            raise InputError(f"{path}: image {number}: its cam_K differs from image {first}'s; one camera is expected")
        if _metres_per_step(entry, path, number) != scale:
            raise InputError(f"{path}: image {number}: its depth_scale differs from image {first}'s; one is expected")
    frames = {
        number: FrameRecord(
            color=_image(folder, COLOR_FOLDERS, number),
            depth=_image(folder, ("depth",), number),
            pose=_pose(entry, path, number),
        )
        for number, entry in entries.items()
    }
    there = next((frame.depth for frame in frames.values() if frame.depth.is_file()), None)
    if there is None:
        raise InputError(f"{frames[first].depth}: missing, as the depth of all other images; scenes need depth images")
    has_objects = (folder / OBJECTS_FILE).is_file()
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames=frames,
        camera=camera_from_matrix(matrix, size=image_size(there), source=f"{path}: image {first}: cam_K"),
        depth_scale=scale,
        notes=(f"the objects of {OBJECTS_FILE} are not read",) if has_objects else (),
    )


def _entries(path: Path) -> dict[int, dict[str, Any]]:
    """Return {image number: its camera}, in order."""
    content = read_json_object(path)
    if not content:
        raise InputError(f"{path}: holds no image")
    for key, entry in content.items():
        if not key.isdecimal() or not isinstance(entry, dict):
            raise InputError(f"{path}: {key!r}: expected an image number with an object of cam_K, depth_scale, …")
    return {int(key): content[key] for key in sorted(content, key=int)}


def _camera_matrix(entry: dict[str, Any], path: Path, number: int) -> np.ndarray:
    return numbers(entry.get("cam_K"), 9, source=f"{path}: image {number}: cam_K").reshape(3, 3)


def _metres_per_step(entry: dict[str, Any], path: Path, number: int) -> float:
    source = f"{path}: image {number}: depth_scale"
    return depth_scale(entry.get("depth_scale"), unit_m=1 / MM_PER_METRE, source=source)


def _pose(entry: dict[str, Any], path: Path, number: int) -> Matrix | None:
    """Return world_from_camera of an image, None where the scene does not say."""
    if "cam_R_w2c" not in entry and "cam_t_w2c" not in entry:
        return None
    source = f"{path}: image {number}"
    camera_from_world = np.eye(4)
    rotation = numbers(entry.get("cam_R_w2c"), 9, source=f"{source}: cam_R_w2c")
    camera_from_world[:3, :3] = rotation.reshape(3, 3)
    camera_from_world[:3, 3] = numbers(entry.get("cam_t_w2c"), 3, source=f"{source}: cam_t_w2c") / MM_PER_METRE
    return inverse(rigid(camera_from_world, source=f"{source}: cam_R_w2c"))


def _image(folder: Path, subfolders: tuple[str, ...], number: int) -> Path:
    """Return the file of an image in the first of ``subfolders`` and with the first of ``SUFFIXES`` that there is."""
    candidates = [folder / name / f"{number:06d}{suffix}" for name in subfolders for suffix in SUFFIXES]
    return next((path for path in candidates if path.is_file()), candidates[0])


def write_index(conversion: Conversion) -> None:
    """Write the true mesh, where there is one, as the scene's object, and the cameras."""
    poses = {frame.number: inverse(frame.world_from_camera) for frame in conversion.frames}
    mesh = conversion.source.ground_truth_mesh
    if mesh is not None and mesh.is_file():
        _write_model(mesh, conversion.folder / MODEL_FILE)
        objects = {
            number: [{"obj_id": 1, "cam_R_m2c": _rotation(pose), "cam_t_m2c": _translation_mm(pose)}]
            for number, pose in poses.items()
        }
        _write_by_image(conversion.folder / OBJECTS_FILE, objects)
    camera = conversion.source.camera
    matrix = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    cameras = {
        number: {
            "cam_K": matrix,
            "depth_scale": conversion.depth_scale * MM_PER_METRE,
            "cam_R_w2c": _rotation(pose),
            "cam_t_w2c": _translation_mm(pose),
        }
        for number, pose in poses.items()
    }
    _write_by_image(conversion.folder / CAMERA_FILE, cameras)


def _rotation(pose: Matrix) -> list[float]:
    return [float(value) for value in pose[:3, :3].ravel()]


def _translation_mm(pose: Matrix) -> list[float]:
    return [float(value) * MM_PER_METRE for value in pose[:3, 3]]


def _write_by_image(path: Path, entries: dict[int, Any]) -> None:
    """Write {image number: entry} as BOP does, a line an image."""
    lines = (f'  "{number}": {json.dumps(entry, allow_nan=False)}' for number, entry in entries.items())
    write_bytes(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())


def _write_model(mesh: Path, path: Path) -> None:
    """Write a mesh in metres as a model in millimetres."""
    with interrupts_held():  # which trimesh would swallow
        import trimesh  # noqa: PLC0415 - slow to import, and only this needs it

    try:
        model = trimesh.load(mesh, process=False, force="mesh")
    except (ValueError, KeyError, IndexError, OSError) as error:
        raise InputError(f"{mesh}: cannot be read as a mesh ({error}); copy or render it again") from error
    model.apply_scale(MM_PER_METRE)
    with replacing(path) as temporary:
        model.export(temporary)


def _advice(conversion: Conversion) -> tuple[str, ...]:
    if not (conversion.folder / MODEL_FILE).is_file():
        return ()
    return (f"{MODEL_FILE} is the whole true scene in world coordinates; bop_toolkit makes its models_info.json",)


FORMAT = DatasetFormat(
    name="bop",
    title="BOP",
    detect=detect,
    open=open_bop,
    image_names=lambda number, _: (f"rgb/{number:06d}", f"depth/{number:06d}.png"),
    write_index=write_index,
    color_suffixes=(".png", ".jpg"),
    carries=frozenset({"frame numbers", "ground-truth mesh"}),
    advice=_advice,
)
