"""``datagen render``: a scene into a dataset."""

import argparse
import sys
from pathlib import Path
from typing import Any

from datagen.commands.arguments import frame_count, image_size, layer_names, positive
from datagen.commands.job_options import add_job_options, reporting
from datagen.dataset import Dataset
from datagen.rendering.render_job import DEVICES, render_dataset
from datagen.rendering.render_workers import FRAMES_PER_WORKER
from datagen.rendering.shards import parse_shard
from datagen.scene_spec.objects import MODEL_SUFFIXES
from datagen.scene_spec.render_settings import PRESETS
from datagen.scene_spec.scene import Scene
from datagen.scene_spec.scene_files import load_scene, shipped_scenes, with_render_settings


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument(
        "scene",
        metavar="SCENE",
        help=f"one of: {', '.join(shipped_scenes())}; a scene file (.toml); or a model or .blend: "
        f"{', '.join(MODEL_SUFFIXES)}",
    )
    command.add_argument("out", metavar="OUT", type=Path, help="folder of the dataset")
    command.add_argument("--frames", type=frame_count, metavar="N", help="number of frames; the path stays the same")
    command.add_argument("--size", type=image_size, metavar="WxH", help="image size in pixels, for example 640x480")
    command.add_argument("--preset", choices=PRESETS, help="samples, bounces and denoising by a name for all of them")
    command.add_argument("--samples", type=int, metavar="N", help="Cycles samples a pixel: more are slower and cleaner")
    command.add_argument("--seed", type=int, metavar="N", help="of all that is random: sampling, views, shake")
    command.add_argument(
        "--layers", type=layer_names, metavar="A,B", help="also write these: normals, masks, flow (to the next frame)"
    )
    _add_machine_options(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def say(sentence: str) -> None:
    """Print a mishap that was overcome, on standard error: standard output is for results."""
    print(f"datagen: {sentence}", file=sys.stderr)


def _add_machine_options(command: argparse.ArgumentParser) -> None:
    command.add_argument("--device", choices=DEVICES, default="auto", help="what Cycles renders on (default: the best)")
    command.add_argument("--require-gpu", action="store_true", help="fail rather than render on the CPU")
    command.add_argument("--workers", type=positive, default=1, metavar="N", help="rendering processes (default: 1)")
    command.add_argument(
        "--recycle-after",
        type=positive,
        default=FRAMES_PER_WORKER,
        metavar="N",
        help=f"frames after which a fresh process takes over (default: {FRAMES_PER_WORKER})",
    )
    command.add_argument(
        "--shard", default="1/1", metavar="I/N", help="only part I of N, into this folder or one of its own"
    )


def _run(options: argparse.Namespace) -> None:
    names = ("frames", "size", "samples", "seed", "layers")
    changes: dict[str, Any] = dict(PRESETS[options.preset]) if options.preset else {}
    changes |= {name: value for name in names if (value := getattr(options, name)) is not None}
    scene = with_render_settings(load_scene(options.scene), **changes)
    shard = parse_shard(options.shard)
    with reporting(options) as progress:
        dataset = render_dataset(
            scene,
            options.out,
            device=options.device,
            require_gpu=options.require_gpu,
            workers=options.workers,
            frames_per_worker=options.recycle_after,
            shard=shard,
            progress=progress,
            tell=say,
        )
    part = f"{len(shard.frames(scene.render.frames))} (shard {shard}) of " if shard.count > 1 else ""
    print(f"{options.out}: {part}{_description(dataset, scene)}")


def _description(dataset: Dataset, scene: Scene) -> str:
    assert dataset.metadata is not None
    made_by = dataset.metadata.provenance
    return (
        f"{len(dataset.frame_ids)} frames of {scene.name}, rendered by Blender {made_by['blender']} "
        f"on {made_by['device']} ({made_by['device_name']})"
    )
