"""``fusion mesh``: a mesh for other programs."""

import argparse
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from datagen.commands.arguments import add_json, positive
from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, print_json
from fusion.edit_mesh import MeshEdits, edit_mesh
from fusion.surface.mesh_files import WRITABLE


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "mesh", metavar="MESH", type=Path, help="a mesh file, or a folder that fusion reconstruct wrote"
    )
    command.add_argument("out", metavar="OUT", type=Path, help=f"the file to write: {', '.join(WRITABLE)}")
    command.add_argument("--largest-component", action="store_true", help="keep only the part with the largest area")
    command.add_argument("--min-triangles", type=positive, metavar="N", help="leave out parts with fewer")
    command.add_argument(
        "--smooth", type=positive, default=0, metavar="N", help="Taubin iterations: noise goes, the volume stays"
    )
    command.add_argument("--triangles", type=positive, metavar="N", help="decimate to about so many")
    add_device(command)
    add_json(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    edits = MeshEdits(
        largest=options.largest_component,
        least_triangles=options.min_triangles,
        smoothing=options.smooth,
        triangles=options.triangles,
    )
    with on_terminal() as progress:
        result = edit_mesh(options.mesh, options.out, edits, device=options.device, progress=progress)
    if options.json:
        print_json(result)
        return
    print(f"{result['file']}: {result['vertices']:,} vertices, {result['triangles']:,} triangles")
    if result["left_out"]:
        print(f"The format has no place for {result['left_out']}.")
    _print_holes(result)


def _print_holes(result: dict[str, Any]) -> None:
    if not result["holes"]:
        print("closed: no holes")
        return
    table = Table("hole", "edges", "length (m)", "centre (m)", box=None)
    for number, hole in enumerate(result["holes"], start=1):
        centre = ", ".join(f"{value:.3f}" for value in hole["centre_m"])
        table.add_row(str(number), f"{hole['edges']:,}", f"{hole['length_m']:.4f}", centre)
    Console().print(table)
    if result["hole_count"] > len(result["holes"]):
        print(f"and {result['hole_count'] - len(result['holes']):,} shorter ones")
