"""Arguments that several commands take, and how results are printed."""

import argparse
import json
from pathlib import Path
from typing import Any, get_args

from fusion.reconstruction_files import ReconstructionRecord
from fusion.surface.meshers import Mesher, OracleName


def add_frames(command: argparse.ArgumentParser) -> None:
    """Add ``--frames``."""
    command.add_argument(
        "--frames",
        metavar="START:STOP:STEP",
        help="a Python slice over the frames; --frames=-20: if it begins with a minus",
    )


def add_depth_layer(command: argparse.ArgumentParser) -> None:
    """Add ``--depth``."""
    command.add_argument(
        "--depth", metavar="LAYER", help="a layer of the dataset in the place of its depth: sensor_depth"
    )


def add_reconstruction(command: argparse.ArgumentParser) -> None:
    """Add the folder of a reconstruction."""
    command.add_argument("reconstruction", type=Path, help="a folder that fusion reconstruct wrote")


def add_remeshing(command: argparse.ArgumentParser) -> None:
    """Add ``--mesher`` and ``--oracle`` to a command that meshes what was meshed before."""
    same = "as it was meshed before if not given"
    command.add_argument("--mesher", choices=get_args(Mesher), help=f"marching cubes or dual contouring; {same}")
    command.add_argument(
        "--oracle",
        choices=get_args(OracleName),
        help=f"what dual contouring goes by: the volume, or its dataset's depth images; {same}",
    )


def add_device(command: argparse.ArgumentParser) -> None:
    """Add ``--device``."""
    command.add_argument("--device", default="auto", metavar="auto|cpu|cuda[:N]")


def add_json(command: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    command.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")


def print_json(value: Any) -> None:
    """Print a result for scripts."""
    print(json.dumps(value, indent=2, allow_nan=False))


def print_result(options: argparse.Namespace, value: Any, text: str) -> None:
    """Print a result: as JSON alone where that was asked for, else in words."""
    if options.json:
        print_json(value)
    else:
        print(text)


def print_record(options: argparse.Namespace, record: ReconstructionRecord) -> None:
    """Print what was written."""
    sizes = f"{record.blocks:,} blocks, {record.vertices:,} vertices, {record.triangles:,} triangles"
    print_result(options, record.model_dump(mode="json"), f"{options.out}: {record.frames} frames, {sizes}")
