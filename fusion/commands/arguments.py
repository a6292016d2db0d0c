"""Arguments that several commands take, and how results are printed."""

import argparse
import json
from pathlib import Path
from typing import Any, get_args

from fusion.reconstruction_files import ReconstructionRecord
from fusion.surface.meshers import Mesher, OracleName


def add_dataset(command: argparse.ArgumentParser) -> None:
    """Add the dataset that is fused."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of any format that can be read")


def add_out_folder(command: argparse.ArgumentParser, *, resumed: bool = False) -> None:
    """Add the folder of the result; ``resumed`` says that a second run goes on there."""
    text = f"the folder to write{'; a second run goes on there' if resumed else ''}"
    command.add_argument("out", metavar="OUT", type=Path, help=text)


def add_voxel_size(command: argparse.ArgumentParser) -> None:
    """Add ``--voxel-size``."""
    command.add_argument("--voxel-size", type=float, metavar="M", help="metres (default: from the data)")


def add_truncation(command: argparse.ArgumentParser) -> None:
    """Add ``--truncation``."""
    command.add_argument("--truncation", type=float, metavar="M", help="metres (default: 4 voxels)")


def add_depth_max(command: argparse.ArgumentParser) -> None:
    """Add ``--depth-max``."""
    command.add_argument("--depth-max", type=float, metavar="M", help="metres; take farther depths as invalid")


def add_depth_layer(command: argparse.ArgumentParser) -> None:
    """Add ``--depth``."""
    command.add_argument(
        "--depth", metavar="LAYER", help="a layer of the dataset in the place of its depth: sensor_depth"
    )


def add_reconstruction(command: argparse.ArgumentParser) -> None:
    """Add the folder of a reconstruction."""
    command.add_argument(
        "reconstruction", metavar="RECONSTRUCTION", type=Path, help="a folder that fusion reconstruct wrote"
    )


def add_remeshing(command: argparse.ArgumentParser) -> None:
    """Add ``--mesher``, ``--oracle`` and ``--flatness`` to a command that meshes what was meshed before."""
    same = "(default: as it was meshed before)"
    command.add_argument("--mesher", choices=get_args(Mesher), help=f"marching cubes or dual contouring {same}")
    command.add_argument(
        "--oracle",
        choices=get_args(OracleName),
        help=f"what dual contouring goes by: the volume, or its dataset's depth images {same}",
    )
    command.add_argument(
        "--flatness",
        type=float,
        metavar="VOXELS",
        help=f"with dual contouring, how far off the mesh may be where it merges cells, 0 for none {same}",
    )


def add_device(command: argparse.ArgumentParser) -> None:
    """Add ``--device``."""
    command.add_argument(
        "--device",
        default="auto",
        metavar="auto|cpu|cuda[:N]",
        help="where kernels run (default: a GPU if there is one)",
    )


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
