"""``datagen verify``: whether a dataset is what its recipe renders."""

import argparse
from pathlib import Path

import numpy as np

from datagen.commands.arguments import frame_count, positive
from datagen.commands.render import say
from datagen.progress import on_terminal
from datagen.rendering.render_job import DEVICES
from datagen.rendering.verify import verify_dataset

EXIT_MISMATCH = 1


def add_options(command: argparse.ArgumentParser) -> None:
    """Give the command's parser its options, and ``run``."""
    command.add_argument("dataset", metavar="DATASET", type=Path, help="a dataset that datagen render made")
    command.add_argument("--frames", type=frame_count, default=5, metavar="N", help="how many frames (default: 5)")
    command.add_argument("--seed", type=int, default=0, metavar="N", help="of the choice of frames")
    command.add_argument(
        "--models", type=Path, default=Path(), metavar="FOLDER", help="where the scene's own model files lie"
    )
    command.add_argument("--device", choices=DEVICES, default="auto", help="what Cycles renders on (default: the best)")
    command.add_argument("--workers", type=positive, default=1, metavar="N", help="rendering processes (default: 1)")
    command.set_defaults(run=_run)


def _run(options: argparse.Namespace) -> int:
    with on_terminal() as progress:
        verification = verify_dataset(
            options.dataset,
            frames=options.frames,
            rng=np.random.default_rng(options.seed),
            models=options.models,
            device=options.device,
            workers=options.workers,
            progress=progress,
            tell=say,
        )
    for verdict in verification.verdicts:
        print(f"frame {verdict.frame}: {'; '.join(verdict.faults) or 'the same'}")
    maker = "the same version and device" if verification.same_maker else "another version or device"
    failed = sum(bool(verdict.faults) for verdict in verification.verdicts)
    print(f"{options.dataset}: {len(verification.verdicts)} frames rendered again by {maker}, {failed} differ")
    return EXIT_MISMATCH if failed else 0
