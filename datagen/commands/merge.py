"""``datagen merge``: shards into one dataset."""

import argparse
from pathlib import Path

from datagen.progress import on_terminal
from datagen.rendering.merge_shards import merge_shards


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("shards", metavar="SHARD", type=Path, nargs="+", help="folder of a shard")
    command.add_argument("out", metavar="OUT", type=Path, help="folder of the whole dataset")
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        dataset = merge_shards(options.shards, options.out, progress=progress)
    print(f"{options.out}: {len(dataset.frame_ids)} frames of {len(options.shards)} shards")
