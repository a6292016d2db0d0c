"""``datagen render``: a scene into a dataset."""

import argparse
from pathlib import Path
from typing import Any

from datagen.commands.arguments import image_size, positive
from datagen.progress import on_terminal
from datagen.rendering.render_job import DEVICES, render_dataset
from datagen.scene_spec.scene_files import load_scene, shipped_scenes, with_render_settings


def add_command(commands: Any) -> None:
    """Add the command to the parser's ``commands``."""
    render = commands.add_parser("render", help="render a scene into a dataset; goes on where a killed run stopped")
    render.add_argument(
        "scene", metavar="SCENE", help=f"one of: {', '.join(shipped_scenes())}; or a scene file (.toml)"
    )
    render.add_argument("out", metavar="OUT", type=Path, help="folder of the dataset")
    render.add_argument("--frames", type=int, metavar="N", help="number of frames; the path stays the same")
    render.add_argument("--size", type=image_size, metavar="WxH", help="image size in pixels, for example 640x480")
    render.add_argument("--samples", type=int, metavar="N", help="Cycles samples a pixel: more are slower and cleaner")
    render.add_argument("--seed", type=int, metavar="N", help="of the sampling noise; depth does not depend on it")
    render.add_argument("--device", choices=DEVICES, default="auto", help="what Cycles renders on (default: the best)")
    render.add_argument("--workers", type=positive, default=1, metavar="N", help="rendering processes (default: 1)")
    render.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
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
