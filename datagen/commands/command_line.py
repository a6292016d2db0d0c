"""Command lines of several commands, of which only the one that is called is imported.

OpenCV and Warp take a second to import: neither ``--help`` nor a mistyped name waits for them.
"""

import argparse
import importlib
import sys
from collections.abc import Mapping, Sequence

from datagen.parent_process import end_with_input


def parse_command_line(
    program: str, description: str, commands: Mapping[str, str], arguments: Sequence[str] | None
) -> argparse.Namespace:
    """Return the options of the command that ``arguments`` (None: the process's) begin with; ``run`` does its work.

    ``commands`` are names with a line of help each. The module ``PROGRAM.commands.NAME``, a name's hyphens being
    underscores there, has ``add_options``, which gives a parser the command's options and ``run``. Leaves with exit
    code 0 after help, with 2 for what cannot be parsed.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    parser = argparse.ArgumentParser(prog=program, description=description)
    parsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, text in commands.items():
        command = parsers.add_parser(name, help=text)
        if words[:1] == [name]:  # the program has no option of its own that could stand before
            importlib.import_module(f"{program}.commands.{name.replace('-', '_')}").add_options(command)
    return parser.parse_args(words)


def watch_parent(options: argparse.Namespace) -> None:
    """Begin to watch standard input where ``--end-with-input`` asks for it."""
    if getattr(options, "end_with_input", False):
        end_with_input()
