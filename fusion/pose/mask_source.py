"""Where a query's mask comes from: a layer of its dataset, an image, or its depth."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from datagen.camera import PinholeCamera
from datagen.dataset import Dataset
from datagen.errors import InputError

LAYER, DERIVED = "layer", "derived"

_LAYER_NAME = "masks"
_MOST_NAMES = 12

Mask = NDArray[np.bool_]

# Of the depth's own plane finder: the support that an object stands on.
_PLANE_TRIES, _PLANE_POINTS = 200, 4000
_LEAST_PLANE_SHARE = 0.15
_ABOVE_PLANE_SHARE = 0.015
"""Of the model's diameter: what lies nearer to the support is taken for it."""
_STEP_SHARE = 0.03
"""Neighbouring depths that differ by more than this share of them are of two objects."""
_LARGEST, _SMALLEST = 1.3, 0.2
"""A region's extent, in diameters of the model, that can be the model."""


@dataclass(frozen=True, kw_only=True)
class MaskChoice:
    """What ``--mask`` and ``--object`` say: ``source`` is ``layer``, ``derived``, or an image's path.

    The path may hold ``{frame}`` (or ``{frame:06d}``), which a query's number takes the place of. ``object_name`` is
    the object's name or number in the masks, None where they show one alone.
    """

    source: str
    object_name: str | None = None


def dataset_masks(dataset: Dataset, choice: MaskChoice) -> Callable[[int], Mask]:
    """Return what reads a frame's mask; for ``derived`` that is nothing, since it takes the model's size.

    Raises InputError where the dataset has no layer of masks, or not the object, or the images do not differ by frame.
    """
    size = dataset.camera.width, dataset.camera.height
    if choice.source == LAYER:
        number = _object_number(dataset, choice.object_name)
        return lambda frame: _of_object(dataset.read_layer(_LAYER_NAME, frame), number)

    def read(frame: int) -> Mask:
        return read_mask(mask_path(choice.source, frame), size=size, object_name=choice.object_name)

    return read


def mask_path(template: str, frame: int) -> Path:
    """Return the path of a frame's mask; raises InputError for a template that is none."""
    try:
        return Path(template.format(frame=frame))
    except (KeyError, IndexError, ValueError) as error:
        raise InputError(
            f"--mask {template}: {{{error}}} is not known; write {{frame}} or {{frame:06d}} where the number goes"
        ) from None


def read_mask(path: Path, *, size: tuple[int, int], object_name: str | None = None) -> Mask:
    """Return the mask (height, width) of an image of ``size`` (width, height), True where the object is.

    An image of two values has the object where it is not 0; grey levels up to 255 are cut at the middle. In an image
    of object numbers ``object_name`` is the one that is meant. Raises InputError for an image of another size, one
    whose objects have to be told apart, and a number that is not in it.
    """
    if not path.is_file():
        raise InputError(f"{path}: no such mask; --mask takes layer, derived, or the path of an image")
    image = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError(f"{path}: cannot be read as an image; give the mask as PNG")
    height, width = image.shape[:2]
    if (width, height) != size:
        raise InputError(
            f"{path}: the mask has {width}×{height} pixels, the query's camera {size[0]}×{size[1]}; give it at the"
            " query's size (resized without interpolation), from the same camera"
        )
    values = image if image.ndim == 2 else image[..., :3].max(axis=2)
    if image.ndim == 3 and image.shape[2] == 4 and not np.any(values):
        values = image[..., 3]
    if object_name is not None:
        return _of_number(path, values, object_name)
    kinds = np.unique(values)
    if len(kinds) <= 2:
        return np.asarray(values > 0) if kinds[0] == 0 or len(kinds) == 1 else np.asarray(values == kinds[-1])
    if kinds[-1] == 255 and kinds[0] == 0:
        return np.asarray(values > 127)
    raise InputError(
        f"{path}: holds the values {_listed(kinds)}, so it numbers several objects; choose one with --object"
    )


def _of_number(path: Path, values: NDArray, name: str) -> Mask:
    if not name.lstrip("-").isdigit():
        raise InputError(f"--object {name}: an image's objects have numbers; {path} has {_listed(np.unique(values))}")
    mask = np.asarray(values == int(name))
    if not mask.any():
        raise InputError(f"{path}: holds no object {name}; its values are {_listed(np.unique(values))}")
    return mask


def _listed(values: NDArray) -> str:
    shown = ", ".join(str(value) for value in values[:_MOST_NAMES])
    return shown + (", …" if len(values) > _MOST_NAMES else "")


def _of_object(indices: NDArray, number: int) -> Mask:
    return np.asarray(indices == number)


def _object_number(dataset: Dataset, name: str | None) -> int:
    """Return an object's number in the layer of masks."""
    if _LAYER_NAME not in dataset.layers:
        there = ", ".join(dataset.layers) or "none"
        raise InputError(
            f"{dataset.folder}: --mask layer: it has no masks (its layers: {there}); render it with --layers masks, or"
            " use --mask derived or --mask FILE"
        )
    objects = [] if dataset.metadata is None else dataset.metadata.recipe.get("objects", [])
    names = [str(item.get("name") or item.get("shape") or item.get("file")) for item in objects]
    listed = ", ".join(f"{i + 1} {title}" for i, title in enumerate(names)) or "not named"
    if name is None:
        if len(names) == 1:
            return 1
        raise InputError(f"{dataset.folder}: its masks tell objects apart; choose one with --object: {listed}")
    if name.isdigit() and (not names or 1 <= int(name) <= len(names)):
        return int(name)
    matching = [i for i, title in enumerate(names) if title.lower() == name.lower()]
    if len(matching) != 1:
        how = "no" if not matching else f"{len(matching)} of that name, give its number instead of its"
        raise InputError(f"--object {name}: {dataset.folder} has {how} such object; its objects: {listed}")
    return matching[0] + 1


def mask_from_depth(depth: NDArray[np.float32], camera: PinholeCamera, diameter: float) -> Mask:
    """Return where an object of about ``diameter`` metres is: what stands before the background, in one piece.

    ``depth`` (height, width) is planar metres, 0 = invalid. The largest plane that reaches beyond the object, if there
    is one, is taken for its support and left out; of what remains, cut where depth jumps, it is the piece of the
    object's size that is largest. All of the valid depth where that is itself no larger than the object; nothing where
    no piece has its size.
    """
    step = max(camera.width // 320, 1)
    small, points = depth[::step, ::step], camera.subsampled(step).back_project(depth[::step, ::step])
    valid = np.isfinite(small) & (small > 0)
    if not valid.any():
        return np.zeros(depth.shape, bool)
    if _extent(points[valid]) <= _LARGEST * diameter:
        return np.asarray(np.isfinite(depth) & (depth > 0))
    rest = valid & ~_support(points, valid, diameter)
    best = _piece(small, points, rest, diameter)
    if best is None:
        return np.zeros(depth.shape, bool)
    whole = cv2.resize(best.astype(np.uint8), depth.shape[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return np.asarray(whole & (depth > 0))


def _extent(points: NDArray[np.float64]) -> float:
    """Return the diagonal of the box around points, but for one in a hundred at either end."""
    low, high = np.percentile(points, (1, 99), axis=0)
    return float(np.linalg.norm(high - low))


def _support(points: NDArray[np.float64], valid: Mask, diameter: float) -> Mask:
    """Return the pixels of the largest plane, and of what lies behind it, if it reaches beyond the object."""
    cloud = points[valid]
    rng = np.random.default_rng(0)  # the same image gives the same mask
    some = cloud[rng.choice(len(cloud), min(len(cloud), _PLANE_POINTS), replace=False)]
    within = _ABOVE_PLANE_SHARE * diameter
    corners = some[rng.integers(0, len(some), (_PLANE_TRIES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 0] / lengths[lengths > 0][:, None]
    offsets = np.einsum("nd,nd->n", normals, corners[lengths > 0, 0])
    counts = (np.abs(some @ normals.T - offsets) < within).sum(axis=0)
    best = int(counts.argmax())
    normal, offset = normals[best], offsets[best]
    on = some[np.abs(some @ normal - offset) < within]
    if len(on) < _LEAST_PLANE_SHARE * len(some) or _extent(on) < _LARGEST * diameter:
        return np.zeros(valid.shape, bool)
    middle = on.mean(axis=0)
    normal = np.linalg.svd(on - middle, full_matrices=False)[2][2]
    normal = normal if normal @ middle < 0 else -normal  # towards the camera
    return np.asarray(valid & ((points - middle) @ normal < within))


def _piece(depth: NDArray[np.float32], points: NDArray[np.float64], rest: Mask, diameter: float) -> Mask | None:
    """Return the largest connected piece whose extent can be the object's."""
    near = cv2.erode(np.where(rest, depth, np.inf).astype(np.float32), np.ones((3, 3), np.uint8))
    # Cut on the far side of a jump.
    connected = rest & (depth - near < _STEP_SHARE * depth)
    regions, count = ndimage.label(connected)
    sizes = np.bincount(regions.ravel(), minlength=count + 1)
    sizes[0] = 0
    for region in np.argsort(-sizes)[:20]:
        if sizes[region] < 20:
            break
        piece = regions == region
        if _SMALLEST * diameter < _extent(points[piece]) < _LARGEST * diameter:
            return np.asarray(cv2.dilate(piece.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0) & rest
    return None
