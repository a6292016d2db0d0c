"""Opening a dataset folder, whatever its format."""

from pathlib import Path

from datagen.dataset import Dataset
from datagen.dataset_format import FRAMES_FOLDER, METADATA_FILE
from datagen.errors import InputError
from datagen.formats import seven_scenes
from datagen.formats.registry import FORMATS
from datagen.formats.unfinished import is_unfinished


def open_dataset(folder: Path) -> Dataset:
    """Open a dataset folder, its format told by what lies in it.

    Raises InputError where the folder is missing, empty, or of no known format, or where its files are malformed.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder of a dataset")
    if is_unfinished(folder):
        raise InputError(f"{folder}: its conversion was not finished; run the same datagen convert again, it goes on")
    for dataset_format in FORMATS:
        if dataset_format.detect(folder):
            return dataset_format.open(folder)
    if seven_scenes.detect(folder / FRAMES_FOLDER):
        raise InputError(
            f"{folder / METADATA_FILE}: the file is missing, which says how to read the frames beside it; copy it from "
            f"where they were made, or name {folder / FRAMES_FOLDER} to read them as a 7-Scenes sequence"
        )
    below = _datasets_below(folder)
    if below:
        names = ", ".join(path.relative_to(folder).as_posix() for path in below[:3])
        raise InputError(f"{folder}: not a dataset, but holds some: {names}; name one of them, for example {below[0]}")
    known = ", ".join(dataset_format.title for dataset_format in FORMATS)
    raise InputError(f"{folder}: not a dataset: it holds the files of none of the formats that can be read: {known}")


def _datasets_below(folder: Path) -> list[Path]:
    """Return the datasets one or two folders down, where people who name a collection mean one of its recordings."""
    below = sorted(path for pattern in ("*/", "*/*/") for path in folder.glob(pattern))
    return [path for path in below if any(dataset_format.detect(path) for dataset_format in FORMATS)]
