"""``datagen info``: what a dataset holds."""

import argparse
import json
from pathlib import Path

from datagen.commands.arguments import add_json
from datagen.dataset_summary import describe, summarise
from datagen.open_dataset import open_dataset


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    summary = summarise(open_dataset(options.dataset))
    print(json.dumps(summary, indent=2) if options.json else describe(summary))
