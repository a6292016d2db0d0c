"""``python -m blender_addon``: bring a reconstruction back into Blender, without an interface."""

import argparse
import sys
from pathlib import Path

from blender_addon.errors import ReconstructionError
from blender_addon.headless.quiet_stdout import quiet_stdout
from datagen.blender_program import leaving_extensions_alone
from datagen.commands.arguments import add_version
from datagen.errors import InputError
from datagen.interrupts import interrupts_held
from datagen.progress import on_terminal

RENDER_SIDE_PX = range(4, 65537)
"""What Blender accepts."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns its exit code: 0, 2 for input that cannot be used, 130 where interrupted."""
    options = _parser().parse_args(arguments)
    folder: Path = options.reconstruction
    try:
        # Blender is imported late, so that --help is quick and its absence can be explained.
        with quiet_stdout(), interrupts_held():
            from blender_addon.headless.present import PresentConfig, present  # noqa: PLC0415

        config = PresentConfig(
            reconstruction=folder,
            blend=options.out or folder / "result.blend",
            preview=options.preview or folder / "preview.png",
            comparison=options.comparison or folder / "comparison.png",
            require_comparison=options.comparison is not None,
            preview_size=options.size,
            samples=options.samples,
        )
        with leaving_extensions_alone(), on_terminal() as progress:
            report = present(config, progress=progress)
    except (InputError, ReconstructionError) as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command begins anew", file=sys.stderr)  # noqa: T201
        return 130
    except ImportError as error:
        if (error.name or "").partition(".")[0] != "bpy" and "bpy" not in str(error):
            raise
        remedy = "pip install 'scanback[blender]', and the system libraries that it needs"
        print(f"error: Blender's Python module does not load ({error}); {remedy}", file=sys.stderr)  # noqa: T201
        return 2
    for note in report.notes:
        print(f"note: {note}", file=sys.stderr)  # noqa: T201
    for path in report.written:
        print(path)  # noqa: T201
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m blender_addon",
        description="Bring a reconstruction back into Blender: a .blend file, a render of it, and the reconstruction "
        "beside a frame of the scan.",
    )
    add_version(parser)
    parser.add_argument("reconstruction", type=Path, help="the folder that 'fusion reconstruct' wrote")
    parser.add_argument("--out", type=Path, help="the .blend file (RECONSTRUCTION/result.blend)")
    parser.add_argument("--output", type=_renamed, help=argparse.SUPPRESS)
    parser.add_argument("--preview", type=Path, help="the render of it (RECONSTRUCTION/preview.png)")
    parser.add_argument("--comparison", type=Path, help="side by side with a frame (RECONSTRUCTION/comparison.png)")
    parser.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="size of the preview (1280x720)")
    parser.add_argument("--samples", type=_samples, default=16, help="Cycles samples for each pixel (16)")
    return parser


def _renamed(text: str) -> None:
    raise argparse.ArgumentTypeError(f"is called --out, as in the other commands: --out {text}")


def _size(text: str) -> tuple[int, int]:
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and {int(width), int(height)} <= set(RENDER_SIDE_PX)):
        raise argparse.ArgumentTypeError(
            f"{text!r}: expected WIDTHxHEIGHT, {RENDER_SIDE_PX[0]} to {RENDER_SIDE_PX[-1]} each, for example 1280x720"
        )
    return int(width), int(height)


def _samples(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 2**24):
        raise argparse.ArgumentTypeError(f"{text!r}: expected an integer from 1 to {2**24}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
