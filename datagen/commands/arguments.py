"""Arguments that several commands take, and their types."""

import argparse
import math
import re
from collections.abc import Sequence
from typing import Any


class _ShowVersion(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,  # noqa: ARG002 - argparse's signature
        values: str | Sequence[Any] | None,  # noqa: ARG002
        option_string: str | None = None,  # noqa: ARG002
    ) -> None:
        # Metadata take as long as --help: they are asked for when the version is.
        from datagen.program_version import program_version  # noqa: PLC0415

        print(program_version())
        parser.exit()


def add_version(parser: argparse.ArgumentParser) -> None:
    """Add ``--version``."""
    parser.add_argument("--version", action=_ShowVersion, nargs=0, help="tell the version and exit")


def add_frames(command: argparse.ArgumentParser, *, default: str = "all") -> None:
    """Add ``--frames``, which chooses some of a dataset's frames."""
    command.add_argument(
        "--frames",
        metavar="START:STOP:STEP",
        help=f"a Python slice over the frames, such as 0:100 or ::10, or the place of one; --frames=-20: where it "
        f"begins with a minus (default: {default})",
    )


def add_json(command: argparse.ArgumentParser) -> None:
    """Add ``--json``."""
    command.add_argument("--json", action="store_true", help="print the result as JSON, and nothing else")


def image_size(text: str) -> tuple[int, int]:
    """Return (width, height) of ``WxH``."""
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no image size; expected WxH, for example 640x480")
    return int(match[1]), int(match[2])


def positive(text: str) -> int:
    """Return a whole number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no count; expected a whole number from 1")
    return int(text)


def frame_count(text: str) -> int:
    """Return a number of frames; says that it is one where a slice is given, which ``--frames`` takes elsewhere."""
    if not text.isdecimal() or int(text) < 1:
        slices = "; a slice chooses among frames that a dataset has" if ":" in text else ""
        raise argparse.ArgumentTypeError(f"{text!r} is no number of frames; expected how many, from 1{slices}")
    return int(text)


def positive_length(text: str) -> float:
    """Return a length in metres that is greater than 0."""
    try:
        length = float(text)
    except ValueError:
        length = math.nan
    if not 0 < length < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is no length; expected metres, for example 0.01")
    return length


def layer_names(text: str) -> list[str]:
    """Return the names in ``A,B``."""
    return [name for name in text.split(",") if name]
