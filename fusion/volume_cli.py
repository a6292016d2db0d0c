"""The commands of ``fusion`` that take a reconstruction's volume: render, export, crop, merge."""

import argparse
import json
import math
import re
from pathlib import Path
from typing import Any

from datagen.dataset import read_pose
from datagen.progress import on_terminal
from fusion.edit_reconstruction import crop_reconstruction, merge_reconstructions
from fusion.export import export
from fusion.reconstruction_files import ReconstructionRecord
from fusion.render import render


def add_volume_commands(commands: Any) -> None:
    """Add the commands to ``fusion``'s subparsers."""
    command = commands.add_parser("render", help="see a reconstruction from a pose: colour, depth, normals")
    _add_reconstruction(command)
    command.add_argument("out", type=Path, help="the folder to write")
    view = command.add_mutually_exclusive_group(required=True)
    view.add_argument("--frame", type=int, metavar="N", help="from the pose of this frame")
    view.add_argument("--pose", type=Path, metavar="FILE", help="from this pose: 4×4 world_from_camera, as text")
    command.add_argument("--size", type=_size, metavar="WxH", help="image size in pixels; the frames' if not given")
    command.set_defaults(run=_render)

    command = commands.add_parser("export", help="write the surface with normals (.ply) or the field (.vdb)")
    _add_reconstruction(command)
    command.add_argument("out", type=Path, help="a file whose name ends in .ply or .vdb")
    command.add_argument("--points", action="store_true", help="points, not a mesh (.ply)")
    command.add_argument("--min-weight", type=float, default=0.0, metavar="W", help="only where more was seen (.ply)")
    command.set_defaults(run=_export)

    command = commands.add_parser("crop", help="keep a box of the world")
    _add_reconstruction(command)
    command.add_argument("out", type=Path, help="the folder to write")
    for option in ("--low", "--high"):
        text = "a corner of the box, metres; _ for no bound along an axis, as in --low _ _ 0.05"
        command.add_argument(option, type=_bound, nargs=3, default=[None] * 3, metavar=("X", "Y", "Z"), help=text)
    command.set_defaults(run=_crop)

    # argparse takes -1e-3 for an option; this is its own switch for what is a number.
    command._negative_number_matcher = re.compile(r"^-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    command = commands.add_parser("merge", help="make one of reconstructions from different frames of a dataset")
    command.add_argument("reconstructions", type=Path, nargs="+", help="folders that fusion reconstruct wrote")
    command.add_argument("out", type=Path, help="the folder to write")
    command.set_defaults(run=_merge)

    for name in ("render", "export", "crop", "merge"):
        commands.choices[name].add_argument("--device", default="auto", metavar="auto|cpu|cuda[:N]")
        commands.choices[name].add_argument("--json", action="store_true", help="print the result as JSON alone")


def _add_reconstruction(command: argparse.ArgumentParser) -> None:
    command.add_argument("reconstruction", type=Path, help="a folder that fusion reconstruct wrote")


def _render(options: argparse.Namespace) -> None:
    pose = None if options.pose is None else read_pose(options.pose)
    with on_terminal() as progress:
        view = render(
            options.reconstruction,
            options.out,
            frame=options.frame,
            world_from_camera=pose,
            size=options.size,
            device=options.device,
            progress=progress,
        )
    text = f"{options.out}: surface at {100 * view['coverage']:.1f} % of the pixels, {view['depth_scale']:g} m a step"
    _print(options, view, text)


def _export(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        written = export(
            options.reconstruction,
            options.out,
            points=options.points,
            min_weight=options.min_weight,
            device=options.device,
            progress=progress,
        )
    _print(options, {"file": str(options.out), "written": written}, f"{options.out}: {written}")


def _crop(options: argparse.Namespace) -> None:
    low = [-math.inf if value is None else value for value in options.low]
    high = [math.inf if value is None else value for value in options.high]
    with on_terminal() as progress:
        record = crop_reconstruction(
            options.reconstruction, options.out, low=low, high=high, device=options.device, progress=progress
        )
    _print_record(options, record)


def _merge(options: argparse.Namespace) -> None:
    with on_terminal() as progress:
        record = merge_reconstructions(options.reconstructions, options.out, device=options.device, progress=progress)
    _print_record(options, record)


def _print_record(options: argparse.Namespace, record: ReconstructionRecord) -> None:
    sizes = f"{record.blocks:,} blocks, {record.vertices:,} vertices, {record.triangles:,} triangles"
    _print(options, record.model_dump(mode="json"), f"{options.out}: {record.frames} frames, {sizes}")


def _print(options: argparse.Namespace, value: dict[str, Any], text: str) -> None:
    print(json.dumps(value, indent=2, allow_nan=False) if options.json else text)


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no image size; expected WxH, for example 640x480")
    return int(match[1]), int(match[2])


def _bound(text: str) -> float | None:
    try:
        return None if text == "_" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no bound; expected metres, or _ for none") from None
