"""Opening a dataset folder, whatever its format."""

from pathlib import Path

from datagen.dataset import Dataset
from datagen.dataset_format import FRAMES_FOLDER, METADATA_FILE, read_metadata
from datagen.errors import InputError
from datagen.formats.seven_scenes import is_seven_scenes, open_seven_scenes


def open_dataset(folder: Path) -> Dataset:
    """Open a dataset folder, its format told by what lies in it: ours, or a 7-Scenes sequence.

    Raises InputError where the folder is missing, empty, or of no known format.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder that holds {METADATA_FILE} or frame-*.pose.txt")
    if (folder / METADATA_FILE).is_file():
        return _open_scanback(folder)
    if is_seven_scenes(folder):
        return open_seven_scenes(folder)
    sequences = sorted(path.parent.name for path in folder.glob("seq-*/frame-000000.*.txt"))
    if sequences:
        raise InputError(
            f"{folder}: holds the sequences {', '.join(sequences)}; name one of them, {folder / sequences[0]}"
        )
    raise InputError(
        f"{folder}: not a dataset: it holds neither {METADATA_FILE} nor 7-Scenes files (frame-000000.depth.png, …)"
    )


def _open_scanback(folder: Path) -> Dataset:
    metadata = read_metadata(folder)
    mesh = folder / metadata.ground_truth_mesh if metadata.ground_truth_mesh else None
    return Dataset(
        folder=folder,
        format_name="scanback",
        frames_folder=folder / FRAMES_FOLDER,
        frame_ids=tuple(range(metadata.frame_count)),
        camera=metadata.intrinsics.camera,
        depth_scale=metadata.depth_scale,
        ground_truth_mesh=mesh,
        metadata=metadata,
    )
