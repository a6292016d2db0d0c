"""All dataset formats, in the order in which a folder is tried on them."""

from datagen.errors import InputError
from datagen.formats import bop, colmap, nerfstudio, open3d_log, scanback, seven_scenes, tum_rgbd
from datagen.formats.format import DatasetFormat

FORMATS: tuple[DatasetFormat, ...] = (
    scanback.FORMAT,
    tum_rgbd.FORMAT,
    bop.FORMAT,
    nerfstudio.FORMAT,
    open3d_log.FORMAT,
    colmap.FORMAT,
    seven_scenes.FORMAT,
)
FORMAT_NAMES = tuple(dataset_format.name for dataset_format in FORMATS)


def format_named(name: str) -> DatasetFormat:
    """Return the format called ``name``; raises InputError where there is none."""
    for dataset_format in FORMATS:
        if dataset_format.name == name:
            return dataset_format
    raise InputError(f"format {name!r}: unknown; expected one of {', '.join(FORMAT_NAMES)}")
