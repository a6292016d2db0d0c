"""``fusion report``: the paper's figures and table on one page."""

import argparse
from dataclasses import replace
from pathlib import Path

from datagen.commands.arguments import add_frames
from datagen.commands.job_options import add_job_options, reporting
from datagen.dataset import Dataset
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import add_depth_max, add_device, add_out_folder, add_voxel_size
from fusion.reconstruction_config import ReconstructionConfig
from fusion.report.report import write_report


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "dataset", metavar="DATASET", type=Path, nargs="+", help="datasets of any format that can be read"
    )
    add_out_folder(command, resumed=True)
    add_voxel_size(command)
    add_depth_max(command)
    command.add_argument(
        "--view-frame", type=int, metavar="N", help="take pictures from this frame's pose (default: the first)"
    )
    add_frames(command)
    add_device(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    config = ReconstructionConfig(voxel_size=options.voxel_size, depth_max=options.depth_max, device=options.device)
    datasets = [_chosen(open_dataset(folder), options.frames) for folder in options.dataset]
    with reporting(options) as progress:
        page = write_report(datasets, options.out, config, view_frame=options.view_frame, progress=progress)
    print(page)


def _chosen(dataset: Dataset, selection: str | None) -> Dataset:
    """Return a dataset of some of the frames, for a report in less time."""
    return replace(dataset, frames={i: dataset.frames[i] for i in select_frames(dataset.frame_ids, selection)})
