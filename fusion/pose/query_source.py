"""Where queries come from: frames of a dataset, or one image with its camera."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from datagen.camera import PinholeCamera
from datagen.dataset import COLOR_PART, DEPTH_PART, POSE_PART, Dataset
from datagen.errors import InputError
from datagen.formats.intrinsics_file import camera_from_matrix, read_intrinsics
from datagen.frame_selection import select_frames
from datagen.images import image_size, read_color, read_depth
from datagen.rigid import Matrix
from fusion.pose.mask_source import DERIVED, LAYER, MaskChoice, dataset_masks, read_mask
from fusion.pose.query import Query

_KEYS = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, kw_only=True, eq=False)
class SourcedQuery:
    """One query and, where it is known, its true pose, world_from_camera."""

    number: int
    query: Query
    truth: Matrix | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class QuerySource:
    """Queries of one camera: ``numbers`` name them, ``read`` reads one.

    ``has_depth``, ``has_mask`` and ``has_color`` are of all of them; ``derive_mask`` asks for masks from depth.
    """

    name: str
    camera: PinholeCamera
    numbers: tuple[int, ...]
    read: Callable[[int], SourcedQuery]
    has_depth: bool
    has_mask: bool
    has_color: bool
    derive_mask: bool = False


@dataclass(frozen=True, kw_only=True)
class ImageFiles:
    """One query's files: ``depth_scale`` is metres a step of ``depth``; ``intrinsics`` four numbers or a file's path.

    ``mask`` as in ``MaskChoice``, but for ``layer``.
    """

    color: Path | None = None
    depth: Path | None = None
    depth_scale: float | None = None
    intrinsics: tuple[str, ...] = ()
    mask: MaskChoice | None = None


def dataset_queries(
    dataset: Dataset, *, frames: str | None = None, chosen: tuple[int, ...] | None = None, mask: MaskChoice | None
) -> QuerySource:
    """Return the frames of a dataset as queries: those of the slice ``frames``, or the ``chosen`` ones.

    Colour is read where all of them have it. Raises InputError where a frame lacks its depth, and for masks that the
    dataset does not have.
    """
    numbers = select_frames(dataset.frame_ids, frames) if chosen is None else chosen
    dataset.require(numbers, (DEPTH_PART,))
    colored = all(dataset.has(number, COLOR_PART) for number in numbers)
    masks = None if mask is None or mask.source == DERIVED else dataset_masks(dataset, mask)

    def read(number: int) -> SourcedQuery:
        query = Query(
            camera=dataset.camera,
            depth=dataset.depth(number),
            color=dataset.color(number) if colored else None,
            mask=None if masks is None else masks(number),
        )
        truth = dataset.world_from_camera(number) if dataset.has(number, POSE_PART) else None
        return SourcedQuery(number=number, query=query, truth=truth)

    return QuerySource(
        name=str(dataset.folder),
        camera=dataset.camera,
        numbers=numbers,
        read=read,
        has_depth=True,
        has_mask=masks is not None,
        has_color=colored,
        derive_mask=mask is not None and mask.source == DERIVED,
    )


def image_query(files: ImageFiles) -> QuerySource:
    """Return one query from its files.

    Raises InputError where neither depth nor mask is given, the camera's matrix or the depth's scale is missing, or
    images differ in size.
    """
    mask_file = None if files.mask is None or files.mask.source == DERIVED else Path(files.mask.source)
    _check_complete(files, mask_file)
    first = next(path for path in (files.depth, files.color, mask_file) if path is not None)
    size = image_size(first)
    for path in (files.depth, files.color):
        if path is not None and image_size(path) != size:
            width, height = image_size(path)
            raise InputError(
                f"{path}: {width}×{height} pixels, but {first} has {size[0]}×{size[1]}; give images of one camera and"
                " size: colour registered to depth"
            )
    camera = read_camera(files.intrinsics, size=size)
    depth = None
    if files.depth is not None:
        assert files.depth_scale is not None
        depth = read_depth(files.depth, size=size, metres_per_step=files.depth_scale)
    mask = None
    if mask_file is not None and files.mask is not None:
        mask = read_mask(mask_file, size=size, object_name=files.mask.object_name)
    color = None if files.color is None else read_color(files.color, size=size)
    query = SourcedQuery(number=0, query=Query(camera=camera, depth=depth, color=color, mask=mask))
    return QuerySource(
        name=str(first),
        camera=camera,
        numbers=(0,),
        read=lambda _number: query,
        has_depth=depth is not None,
        has_mask=mask is not None,
        has_color=color is not None,
        derive_mask=files.mask is not None and files.mask.source == DERIVED,
    )


def _check_complete(files: ImageFiles, mask_file: Path | None) -> None:
    if files.mask is not None and files.mask.source == LAYER:
        raise InputError("--mask layer: only a dataset has layers; give the mask's image, --mask FILE")
    if files.depth is None and mask_file is None:
        given = f"{files.color} alone" if files.color is not None else "nothing"
        raise InputError(
            f"the query has neither depth nor mask ({given}); give --depth FILE --depth-scale S, or --mask FILE to"
            " locate it by its silhouette"
        )
    if files.depth is not None and files.depth_scale is None:
        raise InputError(
            f"--depth {files.depth}: how long is a step? Give --depth-scale in metres: 0.001 where depth is in"
            " millimetres, 0.0001 for YCB-Video, 0.0002 for TUM"
        )
    if files.depth_scale is not None and not (np.isfinite(files.depth_scale) and files.depth_scale > 0):
        raise InputError(f"--depth-scale {files.depth_scale:g}: expected metres a step, a positive number")
    if not files.intrinsics:
        raise InputError(
            "the query's camera is not known; give --intrinsics FX FY CX CY in pixels (integer pixel centres), or"
            " --intrinsics FILE with a 3×3 matrix or JSON of fx, fy, cx, cy"
        )


def read_camera(intrinsics: tuple[str, ...], *, size: tuple[int, int]) -> PinholeCamera:
    """Return the camera of images of ``size`` (width, height) from four numbers or a file.

    A file is a 3×3 matrix as text, or JSON: fx, fy, cx, cy (and width, height), a ``camera_matrix``, ``cam_K`` or ``K``
    of nine numbers, or an object that holds one of these under ``intrinsics`` or ``camera``. Raises InputError for
    anything else, and a camera of another size.
    """
    if len(intrinsics) == 1:
        path = Path(intrinsics[0])
        if not path.is_file():
            raise InputError(f"--intrinsics {path}: no such file; give FX FY CX CY, or a file that holds them")
        if path.suffix.lower() != ".json":
            return read_intrinsics(path, size=size)
        return _camera_of_json(path, size)
    try:
        fx, fy, cx, cy = (float(value) for value in intrinsics)
    except ValueError:
        given = " ".join(intrinsics)
        raise InputError(f"--intrinsics {given}: expected four numbers FX FY CX CY, or one file") from None
    return PinholeCamera(width=size[0], height=size[1], fx=fx, fy=fy, cx=cx, cy=cy)


def _camera_of_json(path: Path, size: tuple[int, int]) -> PinholeCamera:
    try:
        found: Any = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as JSON ({error})") from error
    for name in ("intrinsics", "camera"):
        if isinstance(found, dict) and isinstance(found.get(name), dict):
            found = found[name]
    if isinstance(found, dict):
        if {"width", "height"} <= found.keys() and (found["width"], found["height"]) != size:
            raise InputError(
                f"{path}: is the camera of images of {found['width']}×{found['height']} pixels, the query has"
                f" {size[0]}×{size[1]}; give the intrinsics of the query's own size"
            )
        if all(isinstance(found.get(key), int | float) for key in _KEYS):
            values = {key: float(found[key]) for key in _KEYS}
            return PinholeCamera(width=size[0], height=size[1], **values)
        for name in ("camera_matrix", "cam_K", "K"):
            if name in found:
                return camera_from_matrix(_nine(path, name, found[name]), size=size, source=f"{path}: {name}")
    raise InputError(f"{path}: holds no fx, fy, cx, cy and no 3×3 matrix under camera_matrix, cam_K or K")


def _nine(path: Path, name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value, np.float64).reshape(3, 3)
    except (TypeError, ValueError):
        raise InputError(f"{path}: {name}: expected nine numbers, a 3×3 matrix row by row") from None
