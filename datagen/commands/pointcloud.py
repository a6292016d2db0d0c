"""``datagen pointcloud``: a dataset's coloured points."""

import argparse
from pathlib import Path

from datagen.atomic_write import require_writable
from datagen.commands.arguments import add_frames, positive_length
from datagen.frame_selection import select_frames
from datagen.open_dataset import open_dataset
from datagen.point_cloud import dataset_points, write_point_cloud
from datagen.progress import on_terminal


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")
    command.add_argument("out", metavar="OUT.ply", type=Path, help="the file to write")
    add_frames(command)
    command.add_argument(
        "--voxel-size", type=positive_length, metavar="M", help="one mean point for each cube of this side, metres"
    )
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    dataset = open_dataset(options.dataset)
    frame_ids = select_frames(dataset.frame_ids, options.frames)
    dataset.require(frame_ids)
    require_writable(options.out.parent)
    with on_terminal() as progress:
        advance = progress("Reading", len(frame_ids))
        cloud = dataset_points(dataset, frame_ids, voxel_size=options.voxel_size, advance=advance)
    write_point_cloud(options.out, cloud)
    print(f"{options.out}: {len(cloud.points_world)} points of {len(frame_ids)} frames")
