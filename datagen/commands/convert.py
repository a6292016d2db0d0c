"""``datagen convert``: a dataset into another format."""

import argparse
from pathlib import Path

from datagen.commands.arguments import add_frames
from datagen.formats.convert import convert_dataset
from datagen.formats.registry import FORMAT_NAMES, format_named
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="IN", type=Path, help="a dataset of any format that can be read")
    command.add_argument("out", metavar="OUT", type=Path, help="folder of the new dataset: new or empty")
    command.add_argument("--format", required=True, choices=FORMAT_NAMES, help="format of the new dataset")
    add_frames(command)
    command.add_argument(
        "--depth-scale",
        type=float,
        metavar="M",
        help="metres a step of the new depth images (default: as they are)",
    )
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    target = format_named(options.format)
    source = open_dataset(options.dataset)
    with on_terminal() as progress:
        written = convert_dataset(
            source, options.out, target, frames=options.frames, depth_scale=options.depth_scale, progress=progress
        )
    print(f"{written.folder}: {written.frames} frames of {source.folder} ({source.format_name}) as {target.title}")
    print(f"  colour     {written.color}")
    print(f"  depth      {written.depth}")
    for what in written.lost:
        print(f"  not kept   {what}")
    for note in (*source.notes, *written.advice):
        print(f"  note       {note}")
