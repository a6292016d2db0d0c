"""Subjects from frames of YCB-Video: real RGB-D images with masks and poses, and points of the objects' models.

A folder holds NNNNNN-color.png, -depth.png, -label.png and -meta.mat, as the data set has them, and models/NAME.xyz
(Y. Xiang et al., "PoseCNN", RSS 2018). ``poses`` of a meta file are camera_from_object in metres; depth images hold
``factor_depth`` steps a metre; pixel centres are integers.
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io
from numpy.typing import NDArray

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.formats.intrinsics_file import camera_from_matrix
from datagen.images import image_size, read_color, read_depth
from datagen.rigid import Matrix, inverse, rigid
from fusion.devices import Device
from fusion.evaluation.pose_errors import ModelPoints
from fusion.evaluation.symmetries import symmetry_transforms
from fusion.pose.pose_model import prepare_model
from fusion.pose.shape_volume import volume_from_points
from fusion.pose_benchmark.subjects import Subject
from fusion.pose_benchmark.views import View
from fusion.reconstruction_files import installed_versions

META_SUFFIX = "-meta.mat"
MODELS_FOLDER = "models"
VOXEL_SIZE = 0.002
"""Metres. Where a surface ends, as at a mug's rim, points do not tell so, and it goes on for up to four voxels."""


CLASSES = (
    "002_master_chef_can",
    "003_cracker_box",
    "004_sugar_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "007_tuna_fish_can",
    "008_pudding_box",
    "009_gelatin_box",
    "010_potted_meat_can",
    "011_banana",
    "019_pitcher_base",
    "021_bleach_cleanser",
    "024_bowl",
    "025_mug",
    "035_power_drill",
    "036_wood_block",
    "037_scissors",
    "040_large_marker",
    "051_large_clamp",
    "052_extra_large_clamp",
    "061_foam_brick",
)
"""The data set's objects; a label image holds 1 for the first."""

REVOLUTION_AXES: dict[str, tuple[float, float, float]] = {"025_mug": (0.0, 0.0, 1.0)}
"""Of objects whose depth fixes no turn about this axis, or, of the mug, only where its handle is seen."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Meta:
    """A frame's meta file: intrinsics (3, 3), metres a step of depth, and camera_from_object by label."""

    intrinsics: NDArray[np.float64]
    metres_per_step: float
    poses: dict[int, Matrix]


def is_ycb_video(folder: Path) -> bool:
    """Tell whether a folder holds frames of YCB-Video and models."""
    return any(folder.glob(f"*{META_SUFFIX}")) and any((folder / MODELS_FOLDER).glob("*.xyz"))


def ycb_video_subjects(folder: Path, *, voxel_size: float | None, device: Device) -> list[Subject]:
    """Return each object that there is a model of, with the frames that show it.

    Raises InputError for files that cannot be read, and where no frame shows an object that has a model.
    """
    paths = sorted(folder.glob(f"*{META_SUFFIX}"))
    metas = {int(path.name.removesuffix(META_SUFFIX)): _read_meta(path) for path in paths}
    subjects = []
    for label, name in enumerate(CLASSES, start=1):
        model_file = folder / MODELS_FOLDER / f"{name}.xyz"
        frames = tuple(frame for frame, meta in metas.items() if label in meta.poses)
        if model_file.is_file() and frames:
            subjects.append(_subject(folder, label, name, frames, metas, voxel_size or VOXEL_SIZE, device))
    if not subjects:
        raise InputError(f"{folder}: no frame shows an object that has a model in {MODELS_FOLDER}/")
    return subjects


def _subject(
    folder: Path,
    label: int,
    name: str,
    frames: tuple[int, ...],
    metas: dict[int, _Meta],
    voxel_size: float,
    device: Device,
) -> Subject:
    points = _read_points(folder / MODELS_FOLDER / f"{name}.xyz")
    told = points.tobytes() + repr((voxel_size, installed_versions())).encode()
    return Subject(
        name=name,
        kind="points",
        model=prepare_model(volume_from_points(points, voxel_size=voxel_size, device=device)),
        points=ModelPoints(points=points, symmetries=symmetry_transforms()),
        queries=frames,
        view=lambda frame: _view(folder, frame, label, metas[frame]),
        fused=None,
        identity=hashlib.sha256(told).hexdigest()[:16],
        revolution_axis=REVOLUTION_AXES.get(name),
    )


def _view(folder: Path, frame: int, label: int, meta: _Meta) -> View:
    stem = f"{frame:06d}"
    path = folder / f"{stem}-depth.png"
    size = image_size(path)
    camera: PinholeCamera = camera_from_matrix(meta.intrinsics, size=size, source=f"{stem}{META_SUFFIX}")
    labels = read_color(folder / f"{stem}-label.png", size=size)[..., 0]
    return View(
        camera=camera,
        color=read_color(folder / f"{stem}-color.png", size=size),
        depth=read_depth(path, size=size, metres_per_step=meta.metres_per_step),
        mask=labels == label,
        world_from_camera=inverse(meta.poses[label]),
    )


def _read_meta(path: Path) -> _Meta:
    try:
        content: dict[str, Any] = scipy.io.loadmat(path)
        labels = [int(label) for label in content["cls_indexes"].ravel()]
        poses = np.asarray(content["poses"], np.float64)
        factor = float(content["factor_depth"].ravel()[0])
        intrinsics = np.asarray(content["intrinsic_matrix"], np.float64)
    except (OSError, scipy.io.matlab.MatReadError, ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(f"{path}: cannot be read as YCB-Video's ({type(error).__name__}: {error})") from error
    if poses.shape != (3, 4, len(labels)) or intrinsics.shape != (3, 3) or not factor > 0:
        raise InputError(f"{path}: expected {len(labels)} poses of 3×4, 3×3 intrinsics and a positive factor_depth")
    matrices = {
        label: rigid(np.vstack([poses[..., k], (0, 0, 0, 1)]), source=f"{path}: pose of object {label}")
        for k, label in enumerate(labels)
    }
    return _Meta(intrinsics=intrinsics, metres_per_step=1 / factor, poses=matrices)


def _read_points(path: Path) -> NDArray[np.float64]:
    try:
        points = np.loadtxt(path, dtype=np.float64, ndmin=2)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as rows x y z ({error})") from error
    if points.shape[1] != 3:
        raise InputError(f"{path}: found {points.shape[1]} columns, expected x y z")
    return points
