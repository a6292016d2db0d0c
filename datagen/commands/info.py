"""``datagen info``: what a dataset holds."""

import argparse
import json
from pathlib import Path
from typing import Any

from datagen.dataset_summary import describe, summarise
from datagen.open_dataset import open_dataset


def add_command(commands: Any) -> None:
    """Add the command to the parser's ``commands``."""
    info = commands.add_parser("info", help="tell what a dataset holds")
    info.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")
    info.add_argument("--json", action="store_true", help="as JSON")
    info.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    summary = summarise(open_dataset(options.dataset))
    print(json.dumps(summary, indent=2) if options.json else describe(summary))
