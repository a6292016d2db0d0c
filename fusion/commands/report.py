"""``fusion report``: the paper's figures and table on one page."""

import argparse
from dataclasses import replace
from pathlib import Path

from datagen.commands.job_options import add_job_options, reporting
from datagen.dataset import Dataset
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import add_device, add_frames
from fusion.reconstruction_config import ReconstructionConfig
from fusion.report.report import write_report


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", type=Path, nargs="+", help="datasets of ours, or 7-Scenes sequences")
    command.add_argument("out", type=Path, help="the folder to write; a second run goes on there")
    command.add_argument("--voxel-size", type=float, metavar="M", help="metres; from the data if not given")
    command.add_argument("--depth-max", type=float, metavar="M", help="take farther depths as invalid")
    command.add_argument("--view-frame", type=int, metavar="N", help="take pictures from this frame's pose")
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
