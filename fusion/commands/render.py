"""``fusion render``: what a reconstruction looks like from a pose."""

import argparse
from pathlib import Path

from datagen.commands.arguments import add_json, image_size
from datagen.commands.job_options import add_job_options, reporting
from datagen.dataset import read_pose
from fusion.commands.arguments import add_device, add_out_folder, add_reconstruction, print_result
from fusion.render import render


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    add_reconstruction(command)
    add_out_folder(command)
    view = command.add_mutually_exclusive_group(required=True)
    view.add_argument("--frame", type=int, metavar="N", help="from the pose of this frame")
    view.add_argument("--pose", type=Path, metavar="FILE", help="from this pose: 4×4 world_from_camera, as text")
    command.add_argument("--size", type=image_size, metavar="WxH", help="image size in pixels (default: the frames')")
    add_device(command)
    add_json(command)
    add_job_options(command)
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> None:
    pose = None if options.pose is None else read_pose(options.pose)
    with reporting(options) as progress:
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
    print_result(options, view, text)
