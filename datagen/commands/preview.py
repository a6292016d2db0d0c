"""``datagen preview``: pictures of a dataset to look at."""

import argparse
from pathlib import Path

from datagen.commands.arguments import add_frames
from datagen.errors import InputError
from datagen.frame_selection import select_frames
from datagen.interrupts import interrupts_held
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")
    command.add_argument(
        "--out",
        metavar="DIR",
        type=Path,
        help="folder of the pictures (default: NAME-preview here, NAME the dataset's)",
    )
    add_frames(command)
    command.add_argument("--depth", metavar="LAYER", help="a layer to show as depth, for example sensor_depth")
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    try:
        with interrupts_held():  # trimesh, as in datagen.commands.command_line
            from datagen.preview.make_preview import make_preview  # noqa: PLC0415 - an extra, which may not be there
    except ModuleNotFoundError as error:
        raise InputError(
            f'previews need the Python module {error.name}, which is not installed: pip install "scanback[preview]"'
        ) from error
    dataset = open_dataset(options.dataset)
    folder = options.dataset.resolve()
    out = options.out or Path.cwd() / f"{folder.name}-preview"
    frame_ids = select_frames(dataset.frame_ids, options.frames)
    with on_terminal() as progress:
        shown, files = make_preview(dataset, out, frame_ids=frame_ids, depth_layer=options.depth, progress=progress)
    left_out = len(frame_ids) - shown
    print(f"{out}: {shown} frames" + (f"; {left_out} left out, a file of each is missing" if left_out else ""))
    print("\n".join(f"  {path.name}" for path in files))
