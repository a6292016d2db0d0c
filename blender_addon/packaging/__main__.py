"""``python -m blender_addon.packaging``: build the extension's zips in a checkout."""

import argparse
import sys
from pathlib import Path

from blender_addon.packaging.build_zips import build_zips
from blender_addon.packaging.targets import PLATFORMS
from blender_addon.packaging.wheel_files import CHECKOUT
from datagen.errors import InputError


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit code: 0, or 2 where the zips cannot be built."""
    options = _parser().parse_args(arguments)
    by_name = {platform.name: platform for platform in PLATFORMS}
    try:
        zips = build_zips(
            options.out,
            options.work,
            platforms=[by_name[name] for name in options.platform or by_name],
            with_wheels=not options.without_wheels,
        )
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)  # noqa: T201
        return 2
    for path in zips:
        print(f"{path}  {path.stat().st_size / 1e6:.1f} MB")  # noqa: T201
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m blender_addon.packaging",
        description="Build the Blender extension: one zip for each platform, with all that it needs.",
    )
    names = [platform.name for platform in PLATFORMS]
    parser.add_argument("--platform", action="append", choices=names, help="only this one; may be given again (all)")
    parser.add_argument("--out", type=Path, default=CHECKOUT / "dist", help="where the zips go (dist)")
    parser.add_argument(
        "--work", type=Path, default=CHECKOUT / "build" / "extension", help="keeps downloads (build/extension)"
    )
    parser.add_argument("--without-wheels", action="store_true", help="the extension's code alone, which only imports")
    return parser


if __name__ == "__main__":
    sys.exit(main())
