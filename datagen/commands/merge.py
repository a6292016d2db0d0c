"""``datagen merge``: shards into one dataset."""

import argparse
from pathlib import Path
from typing import Any

from datagen.progress import on_terminal
from datagen.rendering.merge_shards import merge_shards


def add_command(commands: Any) -> None:
    """Add the command to the parser's ``commands``."""
    parser = commands.add_parser("merge", help="put shards that were rendered apart into one dataset")
    parser.add_argument("shards", metavar="SHARD", type=Path, nargs="+", help="folder of a shard")
    parser.add_argument("out", metavar="OUT", type=Path, help="folder of the whole dataset")
    parser.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        dataset = merge_shards(options.shards, options.out, progress=progress)
    print(f"{options.out}: {len(dataset.frame_ids)} frames of {len(options.shards)} shards")
