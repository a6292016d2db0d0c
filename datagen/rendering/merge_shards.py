"""The union of shards that were rendered into folders of their own."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from datagen.atomic_write import replacing
from datagen.dataset import Dataset
from datagen.dataset_format import GROUND_TRUTH_FILE, METADATA_FILE, Metadata, read_metadata, write_metadata
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.progress import ProgressReporter, silent
from datagen.rendering.folder_lock import claiming
from datagen.rendering.frame_files import damaged_file, frame_files, is_complete
from datagen.rendering.provenance import join_metadata
from datagen.rendering.recipes import first_difference


def merge_shards(shards: Sequence[Path], out: Path, *, progress: ProgressReporter = silent) -> Dataset:
    """Copy the frames of ``shards`` into the dataset ``out`` and return it; what ``out`` has already stays.

    From machines of one kind the result is what one run would have written, byte for byte. Raises InputError where the
    shards are of different recipes, cameras, versions of Blender or types of device, and where no shard has a frame
    whole.
    """
    metadata = _joined_metadata([*shards, out] if (out / METADATA_FILE).is_file() else shards)
    if out.is_dir() and any(out.iterdir()) and not (out / METADATA_FILE).is_file():
        raise InputError(f"{out}: holds files that are no dataset of ours; name a new or empty folder")
    frames = range(metadata.frame_count)
    sources = {frame: _source(frame, [out, *shards], metadata.layers) for frame in frames}
    missing = [frame for frame, source in sources.items() if source is None]
    if missing:
        raise InputError(
            f"{', '.join(map(str, shards))}: {len(missing)} of {len(frames)} frames are whole in none of them, "
            f"the first is {missing[0]}; finish the shards, or name the folder of the one that is missing"
        )
    advance = progress("Copying", len(frames))
    with claiming(out, frames):
        write_metadata(out, metadata)
        _copy(shards[0] / GROUND_TRUTH_FILE, out / GROUND_TRUTH_FILE)
        for frame, source in sources.items():
            assert source is not None
            if source != out:
                files = frame_files(source, metadata.layers, frame)
                for path, copy in zip(files, frame_files(out, metadata.layers, frame), strict=True):
                    _copy(path, copy)
            advance()
    return open_dataset(out)


def _joined_metadata(shards: Sequence[Path]) -> Metadata:
    joined = read_metadata(shards[0])
    for folder in shards[1:]:
        metadata = read_metadata(folder)
        difference = first_difference(metadata.recipe, joined.recipe)
        if difference is not None:
            key, there, wanted = difference
            raise InputError(f"{folder}: of another recipe: its {key} is {there!r}, that of {shards[0]} {wanted!r}")
        joined = join_metadata(joined, metadata, names=(str(shards[0]), str(folder)))
    return joined


def _source(frame: int, folders: Sequence[Path], layers: tuple[str, ...]) -> Path | None:
    for folder in folders:
        files = frame_files(folder, layers, frame)
        if is_complete(files) and damaged_file(files) is None:
            return folder
    return None


def _copy(source: Path, target: Path) -> None:
    with replacing(target) as temporary:
        shutil.copyfile(source, temporary)
