"""COLMAP's text model: ``cameras.txt``, ``images.txt`` and ``points3D.txt``; pixel centres at +0.5.

Poses are camera_from_world as ``qw qx qy qz tx ty tz``, two lines an image. The format has no depth images: we keep
them in ``depth`` under the images' names, and metres a step in ``depth/depth.json``.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from datagen.atomic_write import write_bytes, write_json
from datagen.camera import PinholeCamera
from datagen.dataset import Dataset, FrameRecord
from datagen.errors import InputError
from datagen.formats.format import Conversion, DatasetFormat, OutputFrame
from datagen.formats.frame_numbers import frame_numbers, natural_order
from datagen.formats.json_file import depth_scale, read_json_object
from datagen.formats.quaternions import pose_from_quat_wxyz, quat_wxyz_from_rotation
from datagen.formats.text_table import Row, read_lines, read_rows
from datagen.images import read_color, read_depth
from datagen.rigid import Matrix, inverse, transform_points

MODEL_FOLDERS = ("sparse/0", "sparse", ".")
CAMERAS_FILE, IMAGES_FILE, POINTS_FILE = "cameras.txt", "images.txt", "points3D.txt"
IMAGE_FOLDER, DEPTH_FOLDER, SCALE_FILE, SCALE_KEY = "images", "depth", "depth/depth.json", "metres_per_step"
CAMERA_COLUMNS = "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"
IMAGE_COLUMNS = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
POINT_COLUMNS = "POINT3D_ID X Y Z R G B ERROR TRACK[] as (IMAGE_ID POINT2D_IDX)"
PINHOLE_PARAMETERS = {"SIMPLE_PINHOLE": "f cx cy", "PINHOLE": "fx fy cx cy"}
POINTS = 50_000
"""Of all frames together: about what COLMAP itself finds in some hundred images."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    name: str
    camera_id: int
    world_from_camera: Matrix
    row: Row


def detect(folder: Path) -> bool:
    """Tell whether a folder holds a model of COLMAP, as text or binary."""
    return _model_folder(folder, ".txt") is not None or _model_folder(folder, ".bin") is not None


def _model_folder(folder: Path, suffix: str) -> Path | None:
    places = (folder / name for name in MODEL_FOLDERS)
    return next((p for p in places if (p / f"cameras{suffix}").is_file() and (p / f"images{suffix}").is_file()), None)


def open_colmap(folder: Path) -> Dataset:
    """Open a text model with depth images beside it.

    Raises InputError, naming file and line, for a malformed or binary model, several cameras, lens distortion, and
    where depth is missing.
    """
    model = _model_folder(folder, ".txt")
    if model is None:
        binary = _model_folder(folder, ".bin")
        raise InputError(
            f"{binary}: a binary model; write it as text: colmap model_converter --input_path {binary} "
            f"--output_path {binary} --output_type TXT"
        )
    cameras = {row.integer(row.fields[0], "CAMERA_ID"): row for row in read_rows(model / CAMERAS_FILE)}
    images = sorted(read_images(model / IMAGES_FILE), key=lambda image: natural_order(image.name))
    used: dict[int, PinholeCamera] = {}
    for image in images:
        if image.camera_id not in cameras:
            raise image.row.error(f"CAMERA_ID {image.camera_id} is not in {CAMERAS_FILE}")
        if image.camera_id not in used:
            used[image.camera_id] = _camera(cameras[image.camera_id])
        if used[image.camera_id] != used[images[0].camera_id]:
            raise image.row.error(f"its camera differs from that of {images[0].name}; one camera is expected")
    depth_files = [folder / DEPTH_FOLDER / Path(image.name).with_suffix(".png") for image in images]
    if not any(path.is_file() for path in depth_files):
        raise InputError(
            f"{depth_files[0]}: missing, as are all depth images, which COLMAP itself has no place for; put 16-bit "
            f'images of planar depth there, and {{"{SCALE_KEY}": 0.001}} into {folder / SCALE_FILE}'
        )
    records = (
        FrameRecord(color=folder / IMAGE_FOLDER / image.name, depth=depth, pose=image.world_from_camera)
        for image, depth in zip(images, depth_files, strict=True)
    )
    return Dataset(
        folder=folder,
        format_name=FORMAT.title,
        frames=dict(zip(frame_numbers([image.name for image in images]), records, strict=True)),
        camera=used[images[0].camera_id],
        depth_scale=_depth_scale(folder / SCALE_FILE),
    )


def _depth_scale(path: Path) -> float:
    return depth_scale(read_json_object(path).get(SCALE_KEY), source=f"{path}: {SCALE_KEY}")


def _camera(row: Row) -> PinholeCamera:
    row.require(5, CAMERA_COLUMNS)
    model = row.fields[1]
    if model not in PINHOLE_PARAMETERS:
        raise row.error(
            f"camera model {model} distorts the image, and only {' and '.join(PINHOLE_PARAMETERS)} can be used; "
            "undistort images and model with: colmap image_undistorter"
        )
    names = PINHOLE_PARAMETERS[model]
    row.require(4 + len(names.split()), f"CAMERA_ID MODEL WIDTH HEIGHT {names}")
    width, height = row.integer(row.fields[2], "WIDTH"), row.integer(row.fields[3], "HEIGHT")
    *focal, cx, cy = row.numbers(row.fields[4 : 4 + len(names.split())], CAMERA_COLUMNS).tolist()
    try:
        return PinholeCamera.from_corner_origin(width=width, height=height, fx=focal[0], fy=focal[-1], cx=cx, cy=cy)
    except InputError as error:
        raise row.error(str(error)) from None


def read_images(path: Path) -> list[_Image]:
    """Return the images of a model; raises InputError naming the line at fault.

    Every image has a second line, of its points, which may be empty: it is passed over.
    """
    images = []
    lines = iter(enumerate(read_lines(path), start=1))
    for number, line in lines:
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        row = Row(path=path, line=number, fields=tuple(line.split(maxsplit=9)))
        row.require(10, IMAGE_COLUMNS)
        numeric = row.numbers(row.fields[1:8], IMAGE_COLUMNS)
        source = f"{path}, line {number}"
        images.append(
            _Image(
                name=row.fields[9].strip(),
                camera_id=row.integer(row.fields[8], "CAMERA_ID"),
                world_from_camera=inverse(pose_from_quat_wxyz(numeric[:4], numeric[4:], source=source)),
                row=row,
            )
        )
        next(lines, None)
    if not images:
        raise InputError(f"{path}: holds no image")
    first: dict[str, _Image] = {}
    for image in images:
        if first.setdefault(image.name, image) is not image:
            raise image.row.error(f"{image.name} has an entry already, in line {first[image.name].row.line}")
    return images


@dataclass(frozen=True, kw_only=True, eq=False)
class _Observed:
    """Some pixels of a frame: ``pixels`` (n, 2) integer u, v, ``points_world`` (n, 3), ``colors`` (n, 3) uint8."""

    pixels: NDArray[np.int64]
    points_world: NDArray[np.float64]
    colors: NDArray[np.uint8]


def write_index(conversion: Conversion) -> None:
    """Write depth's scale, points (each seen by one image: the pixel that it is from), images and the camera."""
    camera = conversion.source.camera
    write_json(conversion.folder / SCALE_FILE, {SCALE_KEY: conversion.depth_scale, "depth": "planar z, 0 = invalid"})
    images, points = [f"# {IMAGE_COLUMNS}", "# POINTS2D[] as (X Y POINT3D_ID)"], [f"# {POINT_COLUMNS}"]
    point_id = 1
    for image_id, frame in enumerate(conversion.frames, start=1):
        seen = _observe(frame, conversion, count=-(-POINTS // len(conversion.frames)))
        ids = range(point_id, point_id + len(seen.pixels))
        point_id += len(seen.pixels)
        images += [_image_line(image_id, frame, conversion), _observations(seen, ids)]
        points += _point_lines(seen, ids, image_id)
    model = conversion.folder / MODEL_FOLDERS[0]
    cx, cy = camera.corner_origin
    parameters = " ".join(repr(float(value)) for value in (camera.fx, camera.fy, cx, cy))
    _write_lines(model / POINTS_FILE, points)
    _write_lines(model / IMAGES_FILE, images)
    _write_lines(
        model / CAMERAS_FILE, [f"# {CAMERA_COLUMNS}", f"1 PINHOLE {camera.width} {camera.height} {parameters}"]
    )


def _observe(frame: OutputFrame, conversion: Conversion, *, count: int) -> _Observed:
    """Return at most ``count`` of a frame's valid pixels, spread evenly over them."""
    camera = conversion.source.camera
    size = camera.width, camera.height
    depth = read_depth(frame.depth, size=size, metres_per_step=conversion.depth_scale)
    valid = np.flatnonzero(depth)
    chosen = valid[np.linspace(0, len(valid) - 1, min(count, len(valid))).round().astype(np.int64)]
    v, u = np.unravel_index(chosen, depth.shape)
    points_camera = camera.back_project(depth)[v, u]
    return _Observed(
        pixels=np.stack([u, v], axis=-1),
        points_world=transform_points(frame.world_from_camera, points_camera),
        colors=read_color(frame.color, size=size)[v, u],
    )


def _image_line(image_id: int, frame: OutputFrame, conversion: Conversion) -> str:
    camera_from_world = inverse(frame.world_from_camera)
    values = (*quat_wxyz_from_rotation(camera_from_world[:3, :3]), *camera_from_world[:3, 3])
    name = frame.color.relative_to(conversion.folder / IMAGE_FOLDER).as_posix()
    return " ".join([str(image_id), *(repr(float(value)) for value in values), "1", name])


def _observations(seen: _Observed, ids: range) -> str:
    return " ".join(f"{u + 0.5} {v + 0.5} {i}" for (u, v), i in zip(seen.pixels.tolist(), ids, strict=True))


def _point_lines(seen: _Observed, ids: range, image_id: int) -> Iterator[str]:
    for index, (i, point, color) in enumerate(zip(ids, seen.points_world.tolist(), seen.colors.tolist(), strict=True)):
        place, rgb = " ".join(f"{x:.9g}" for x in point), " ".join(map(str, color))
        yield f"{i} {place} {rgb} 0 {image_id} {index}"


def _write_lines(path: Path, lines: list[str]) -> None:
    write_bytes(path, ("\n".join(lines) + "\n").encode())


FORMAT = DatasetFormat(
    name="colmap",
    title="COLMAP",
    detect=detect,
    open=open_colmap,
    image_names=lambda number, _: (
        f"{IMAGE_FOLDER}/frame-{number:06d}",
        f"{DEPTH_FOLDER}/frame-{number:06d}.png",
    ),
    write_index=write_index,
    carries=frozenset({"frame numbers"}),
    advice=lambda _: (
        f"COLMAP has no place for depth: it is in {DEPTH_FOLDER}/ beside the model, its scale in {SCALE_FILE}, and the "
        f"points are from it, at most {POINTS}, each seen by one image",
    ),
)
