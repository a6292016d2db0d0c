"""The command line ``datagen``: render a scene, tell what a dataset holds."""

from collections.abc import Sequence

from datagen.commands.command_line import run_command_line

COMMANDS = {
    "render": "render a scene into a dataset; goes on where a killed run stopped",
    "info": "tell what a dataset holds",
    "validate": "find and name faults of a dataset; exit code 0 clean, 1 faults, 2 unusable",
    "preview": "make a contact sheet, a video, a GIF and a plot of the camera's path",
    "convert": "write a dataset in another format; goes on where a killed run stopped",
    "sensor": "add the depth that a real sensor would give, as the layer sensor_depth",
    "lens": "add colour and depth as a distorted lens would show them, as layers",
    "pointcloud": "write the coloured points of a dataset as PLY",
    "verify": "render random frames of a dataset again and compare; exit code 1 tells",
    "merge": "put shards that were rendered apart into one dataset",
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code.

    That is 0, 1 for faults that were found or a Blender that failed, 2 for input that cannot be used, and 130 where
    interrupted.
    """
    description = "Make and look at posed RGB-D datasets."
    interrupted = "what is finished is kept, and the same command goes on there"
    return run_command_line("datagen", description, COMMANDS, arguments, interrupted=interrupted)
