"""The command line ``datagen``: render a scene, tell what a dataset holds."""

import argparse
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from datagen.dataset_summary import describe, summarise
from datagen.errors import InputError, WorkerError
from datagen.open_dataset import open_dataset
from datagen.progress import on_terminal
from datagen.render_job import DEVICES, render_dataset
from datagen.scene_files import load_scene, shipped_scenes, with_render_settings

EXIT_FAILURE = 1
EXIT_INPUT_ERROR = 2
EXIT_INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except InputError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_INPUT_ERROR
    except WorkerError as error:
        print(f"datagen: error: {error}", file=sys.stderr)
        return EXIT_FAILURE
    except KeyboardInterrupt:
        print("datagen: interrupted; what is finished is kept, and the same command goes on there", file=sys.stderr)
        return EXIT_INTERRUPTED
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="datagen", description="Make and look at posed RGB-D datasets.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    render = commands.add_parser("render", help="render a scene into a dataset; goes on where a killed run stopped")
    render.add_argument(
        "scene", metavar="SCENE", help=f"one of: {', '.join(shipped_scenes())}; or a scene file (.toml)"
    )
    render.add_argument("out", metavar="OUT", type=Path, help="folder of the dataset")
    render.add_argument("--frames", type=int, metavar="N", help="number of frames; the path stays the same")
    render.add_argument("--size", type=_size, metavar="WxH", help="image size in pixels, for example 640x480")
    render.add_argument("--samples", type=int, metavar="N", help="Cycles samples a pixel: more are slower and cleaner")
    render.add_argument("--seed", type=int, metavar="N", help="of the sampling noise; depth does not depend on it")
    render.add_argument("--device", choices=DEVICES, default="auto", help="what Cycles renders on (default: the best)")
    render.add_argument("--workers", type=_positive, default=1, metavar="N", help="rendering processes (default: 1)")
    render.set_defaults(run=_render)

    info = commands.add_parser("info", help="tell what a dataset holds")
    info.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset of ours or a 7-Scenes sequence")
    info.add_argument("--json", action="store_true", help="as JSON")
    info.set_defaults(run=_info)
    return parser


def _render(options: argparse.Namespace) -> None:
    names = ("frames", "size", "samples", "seed")
    changes: dict[str, Any] = {name: value for name in names if (value := getattr(options, name)) is not None}
    scene = with_render_settings(load_scene(options.scene), **changes)
    with on_terminal() as progress:
        dataset = render_dataset(scene, options.out, device=options.device, workers=options.workers, progress=progress)
    assert dataset.metadata is not None
    made_by = dataset.metadata.provenance
    print(
        f"{options.out}: {len(dataset.frame_ids)} frames of {scene.name}, rendered by Blender {made_by['blender']} "
        f"on {made_by['device']} ({made_by['device_name']})"
    )


def _info(options: argparse.Namespace) -> None:
    summary = summarise(open_dataset(options.dataset))
    print(json.dumps(summary, indent=2) if options.json else describe(summary))


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+)[xX×](\d+)", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"{text!r} is no image size; expected WxH, for example 640x480")
    return int(match[1]), int(match[2])


def _positive(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no count; expected a whole number from 1")
    return int(text)
