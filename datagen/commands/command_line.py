"""Command lines of several commands, of which only the one that is called is imported.

OpenCV and Warp take a second to import: neither ``--help`` nor a mistyped name waits for them.
"""

import argparse
import importlib
import os
import sys
from collections.abc import Mapping, Sequence

from datagen.commands.arguments import add_version
from datagen.errors import InputError, WorkerError
from datagen.interrupts import interrupts_held
from datagen.parent_process import end_with_input

EXIT_FAILURE = 1
EXIT_INPUT_ERROR = 2
EXIT_INTERRUPTED = 130
EXIT_UNHEARD = 141
"""As of a program that the system ends because nobody reads what it prints."""


def run_command_line(
    program: str, description: str, commands: Mapping[str, str], arguments: Sequence[str] | None, *, interrupted: str
) -> int:
    """Run the command that ``arguments`` (None: the process's) begin with, and return the exit code.

    ``commands`` are names with a line of help each. The module ``PROGRAM.commands.NAME``, a name's hyphens being
    underscores there, has ``add_options``, which gives a parser the command's options and ``run``, whose result is the
    exit code if it is not None. ``interrupted`` says what comes of the work after Ctrl-C. Leaves with exit code 0 after
    help and the version, with 2 for what cannot be parsed.
    """
    try:
        options = _parse(program, description, commands, sys.argv[1:] if arguments is None else list(arguments))
        if getattr(options, "end_with_input", False):
            end_with_input()
        code = options.run(options) or 0
        sys.stdout.flush()
    except InputError as error:
        return _complain(f"{program}: error: {error}", EXIT_INPUT_ERROR)
    except WorkerError as error:
        return _complain(f"{program}: error: {error}", EXIT_FAILURE)
    except KeyboardInterrupt:
        return _complain(f"{program}: interrupted; {interrupted}", EXIT_INTERRUPTED)
    except BrokenPipeError:
        # As head does, whoever read the output has seen enough; Python would complain when it flushes the rest.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNHEARD
    return int(code)


def _parse(program: str, description: str, commands: Mapping[str, str], words: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog=program, description=description)
    add_version(parser)
    parsers = parser.add_subparsers(required=True, metavar="COMMAND")
    for name, text in commands.items():
        command = parsers.add_parser(name, help=text)
        if words[:1] == [name]:  # the program's own options, which could stand before, end it
            with interrupts_held():  # trimesh takes whatever happens meanwhile for a package that is not there
                module = importlib.import_module(f"{program}.commands.{name.replace('-', '_')}")
            module.add_options(command)
    return parser.parse_args(words)


def _complain(sentence: str, code: int) -> int:
    print(sentence, file=sys.stderr)
    return code
