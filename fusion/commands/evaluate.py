"""``fusion evaluate``: a mesh against the truth."""

import argparse
from pathlib import Path

from datagen.atomic_write import require_writable
from datagen.commands.arguments import add_frames, add_json
from datagen.commands.job_options import add_job_options, reporting
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import add_device, print_json
from fusion.commands.metrics import print_metrics
from fusion.devices import resolve_device
from fusion.evaluation.evaluate import Observers, evaluate
from fusion.evaluation.vertex_errors import write_vertex_errors
from fusion.reconstruction_config import check_length
from fusion.reconstruction_files import MESH_FILE, RECORD_FILE, ReconstructionRecord, read_record
from fusion.surface.mesh_files import read_mesh


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "mesh", metavar="MESH", type=Path, help="a mesh file, or a folder that fusion reconstruct wrote"
    )
    command.add_argument("ground_truth", metavar="TRUTH", type=Path, help="a mesh file, or a dataset that has one")
    command.add_argument(
        "--observed-by",
        type=Path,
        metavar="DATASET",
        help="cull the truth to what its frames saw, not to what the mesh's record says",
    )
    command.add_argument(
        "--threshold",
        type=float,
        action="append",
        metavar="M",
        help="metres; of the F-score, repeatable (default: a half and a whole voxel)",
    )
    command.add_argument(
        "--voxel-size",
        type=float,
        metavar="M",
        help="metres; to give lengths in voxels too (default: as the mesh was made)",
    )
    add_frames(command, default="those that were fused, else all")
    add_device(command)
    command.add_argument(
        "--vertex-errors", type=Path, metavar="FILE", help="also write how far each of the mesh's vertices is (.npy)"
    )
    add_json(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    for option, values in (("--threshold", options.threshold or []), ("--voxel-size", [options.voxel_size])):
        for value in values:
            if value is not None:
                check_length(option, value)
    if options.vertex_errors is not None:
        require_writable(options.vertex_errors.parent)
    # A reconstruction knows its voxel size and the frames that observed it.
    mesh_file = options.mesh / MESH_FILE if options.mesh.is_dir() else options.mesh
    folder = mesh_file.parent
    ours = read_mesh(mesh_file)
    record = read_record(folder) if (folder / RECORD_FILE).is_file() else None
    voxel_size = options.voxel_size or (record.voxel_size_m if record else None)
    thresholds = options.threshold or ([voxel_size / 2, voxel_size] if voxel_size else None)
    if thresholds is None:
        raise InputError(f"{options.mesh}: its voxel size is not known; give --voxel-size or --threshold")
    ground_truth = read_mesh(_ground_truth_file(options.ground_truth))
    with reporting(options) as progress:
        metrics = evaluate(
            ours,
            ground_truth,
            thresholds=thresholds,
            device=resolve_device(options.device),
            observed_by=_observers(options, folder, record),
            voxel_size=voxel_size,
            progress=progress,
        )
    if options.vertex_errors is not None:
        write_vertex_errors(options.vertex_errors, ours, ground_truth, device=resolve_device(options.device))
    if options.json:
        print_json(metrics)
    else:
        print_metrics(metrics)


def _ground_truth_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    truth = open_dataset(path).ground_truth_mesh
    if truth is None:
        raise InputError(f"{path}: this dataset has no ground-truth mesh; name a mesh file")
    return truth


def _observers(options: argparse.Namespace, folder: Path, record: ReconstructionRecord | None) -> Observers | None:
    """Return the frames to cull the truth to: those asked for, else those that the mesh was made of."""
    dataset_folder = options.observed_by or (options.ground_truth if options.ground_truth.is_dir() else None)
    if record is not None and options.frames is None:
        recorded = folder / record.dataset
        if recorded.is_dir() and dataset_folder in (None, options.ground_truth, recorded):
            fused = tuple(frame.frame for frame in record.trajectory)
            return Observers(dataset=open_dataset(recorded), frame_ids=fused, depth_max=record.depth_max_m)
    if dataset_folder is None:
        return None
    dataset = open_dataset(dataset_folder)
    return Observers(dataset=dataset, frame_ids=select_frames(dataset.frame_ids, options.frames))
