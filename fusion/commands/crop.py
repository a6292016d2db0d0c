"""``fusion crop``: a box of a reconstruction."""

import argparse
import math
import re

from datagen.commands.arguments import add_json
from datagen.progress import on_terminal
from fusion.commands.arguments import add_device, add_out_folder, add_reconstruction, add_remeshing, print_record
from fusion.edit_reconstruction import crop_reconstruction


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    add_reconstruction(command)
    add_out_folder(command)
    for option in ("--low", "--high"):
        text = "a corner of the box, metres; _ for no bound along an axis, as in --low _ _ 0.05"
        command.add_argument(option, type=_bound, nargs=3, default=[None] * 3, metavar=("X", "Y", "Z"), help=text)
    add_remeshing(command)
    add_device(command)
    add_json(command)
    command.set_defaults(run=_run)
    # argparse takes -1e-3 for an option; this is its own switch for what is a number.
    command._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")


def _run(options: argparse.Namespace) -> None:
    low = [-math.inf if value is None else value for value in options.low]
    high = [math.inf if value is None else value for value in options.high]
    with on_terminal() as progress:
        record = crop_reconstruction(
            options.reconstruction,
            options.out,
            low=low,
            high=high,
            mesher=options.mesher,
            oracle=options.oracle,
            flatness=options.flatness,
            device=options.device,
            progress=progress,
        )
    print_record(options, record)


def _bound(text: str) -> float | None:
    try:
        return None if text == "_" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no bound; expected metres, or _ for none") from None
