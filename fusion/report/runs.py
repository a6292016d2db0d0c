"""The reconstructions that a report is made of, each made once and kept, so that an interrupted report goes on."""

from dataclasses import asdict, dataclass
from pathlib import Path

from datagen.dataset import Dataset
from datagen.errors import InputError
from fusion.reconstruct import reconstruct
from fusion.reconstruction_config import ReconstructionConfig
from fusion.reconstruction_files import (
    MESH_FILE,
    RECORD_FILE,
    VOLUME_FILE,
    ReconstructionRecord,
    installed_versions,
    read_record,
    relative_to,
)
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_files import read_mesh


@dataclass(frozen=True, kw_only=True)
class Run:
    """A reconstruction: its mesh and its record."""

    mesh: Mesh
    record: ReconstructionRecord


def run(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> Run:
    """Reconstruct into ``folder``, or read what lies there from the same dataset, configuration and versions."""
    if not _is_current(dataset, folder, config):
        reconstruct(dataset, folder, config)
        (folder / VOLUME_FILE).unlink()  # a report does not look at it again, and it is large
    return Run(mesh=read_mesh(folder / MESH_FILE), record=read_record(folder))


def _is_current(dataset: Dataset, folder: Path, config: ReconstructionConfig) -> bool:
    if not (folder / RECORD_FILE).is_file() or not (folder / MESH_FILE).is_file():
        return False
    try:
        record = read_record(folder)
    except InputError:  # of an older version, or damaged: it is made anew
        return False
    same_frames = {frame.frame for frame in record.trajectory} <= set(dataset.frame_ids)
    return (
        same_frames
        and record.dataset == relative_to(folder, dataset.folder)
        and record.config == asdict(config)
        and record.versions == installed_versions()
    )
