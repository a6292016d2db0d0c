"""The command ``fusion``: reconstruct, locate, evaluate, and what is done to a reconstruction."""

from collections.abc import Sequence

from datagen.commands.command_line import run_command_line

COMMANDS = {
    "estimate": "tell how large a reconstruction will be, from a few frames",
    "reconstruct": "fuse a dataset into a coloured mesh",
    "locate": "find the pose of a view in a reconstruction, or of an object given as a mesh",
    "evaluate": "measure a mesh against the truth",
    "pose-benchmark": "locate held-out frames by a protocol; a table with bars, and pictures",
    "report": "the paper's figures and table from your data, on one HTML page",
    "render": "see a reconstruction from a pose: colour, depth, normals",
    "export": "write the surface with normals (.ply) or the field (.vdb)",
    "mesh": "choose parts, smooth, decimate, write in another format; report holes",
    "crop": "keep a box of the world",
    "merge": "make one of reconstructions from different frames of a dataset",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code: 0, 2 for input that cannot be used, 130 where interrupted."""
    description = "Fuse posed RGB-D frames and locate new ones."
    return run_command_line("fusion", description, COMMANDS, arguments, interrupted="the same command begins anew")
