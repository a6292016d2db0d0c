"""``fusion estimate``: how large a reconstruction will be."""

import argparse
from dataclasses import asdict

from datagen.commands.arguments import add_frames, add_json
from datagen.commands.job_options import add_job_options, reporting
from datagen.open_dataset import open_dataset
from fusion.commands.arguments import (
    add_dataset,
    add_depth_layer,
    add_depth_max,
    add_truncation,
    add_voxel_size,
    print_result,
)
from fusion.devices import available_devices
from fusion.estimate import estimate
from fusion.reconstruction_config import VOXELS_PER_TRUNCATION, check_length


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    add_dataset(command)
    add_voxel_size(command)
    add_truncation(command)
    add_depth_max(command)
    add_depth_layer(command)
    add_frames(command)
    add_json(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    for name in ("voxel_size", "truncation", "depth_max"):
        if getattr(options, name) is not None:
            check_length(f"--{name.replace('_', '-')}", getattr(options, name))
    dataset = open_dataset(options.dataset)
    if options.depth is not None:
        dataset = dataset.with_depth_layer(options.depth)
    with reporting(options) as progress:
        found = estimate(dataset, frames=options.frames, depth_max=options.depth_max, progress=progress)
    voxel_size = options.voxel_size or found.voxel_size
    truncation = options.truncation or VOXELS_PER_TRUNCATION * voxel_size
    sizes = {"triangles": found.triangles(voxel_size), "volume_bytes": found.volume_bytes(voxel_size, truncation)}
    text = (
        f"{found.frames} frames at a voxel size of {voxel_size:g} m: about {_rounded(sizes['triangles'])} triangles, "
        f"{_rounded(sizes['volume_bytes'] / 2**20)} MiB of voxels"
    )
    print_result(options, asdict(found) | sizes | {"devices": available_devices()}, text)


def _rounded(value: float) -> str:
    """Return a number with two digits: more are not known of it."""
    return f"{float(f'{value:.2g}'):,.0f}"
