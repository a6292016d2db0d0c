"""The command line ``datagen``: render a scene, tell what a dataset holds."""

import sys
from collections.abc import Sequence

from datagen.commands.command_line import parse_command_line, watch_parent
from datagen.errors import InputError, WorkerError

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

EXIT_FAILURE = 1
EXIT_INPUT_ERROR = 2
EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    try:
        options = parse_command_line("datagen", "Make and look at posed RGB-D datasets.", COMMANDS, arguments)
        watch_parent(options)
        return options.run(options) or 0
    except InputError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_INPUT_ERROR
    except WorkerError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_FAILURE
    except KeyboardInterrupt:
        print("datagen: interrupted; what is finished is kept, and the same command goes on there", file=sys.stderr)
        return EXIT_INTERRUPTED
