"""``datagen lens``: what a distorted lens would show, added to a dataset."""

import argparse
from pathlib import Path

from pydantic import ValidationError

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal
from datagen.pydantic_errors import describe_validation_error
from datagen.scene_spec.lens_settings import LensSettings
from datagen.sensors.add_layers import add_lens_layers

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a Scanback dataset")
    for name in COEFFICIENTS:
        command.add_argument(f"--{name}", type=float, default=0.0, metavar="X", help=f"OpenCV's coefficient {name}")
    command.add_argument(
        "--magnification",
        type=_magnification,
        default=1.0,
        metavar="X|cover",
        help="focal length over the rendered camera's; cover: the least that leaves no pixel empty",
    )
    command.set_defaults(run=_run)


def _magnification(text: str) -> float | str:
    if text == "cover":
        return text
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor cover") from None


def _run(options: argparse.Namespace) -> None:
    chosen = {name: getattr(options, name) for name in (*COEFFICIENTS, "magnification")}
    try:
        settings = LensSettings.model_validate(chosen)
    except ValidationError as error:
        raise InputError(describe_validation_error("lens settings", error, LensSettings)) from error
    with on_terminal() as progress:
        dataset = add_lens_layers(open_dataset(options.dataset), settings, progress=progress)
    assert dataset.metadata is not None
    assert dataset.metadata.distortion is not None
    lens = dataset.metadata.distortion
    print(
        f"{options.dataset}: the layers distorted_color and distorted_depth have {len(dataset.frame_ids)} frames; "
        f"{lens.shown:.1%} of their pixels show something, fx {lens.intrinsics.fx:.3f} fy {lens.intrinsics.fy:.3f} px"
    )
