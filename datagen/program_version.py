"""Which Scanback this is."""

from importlib import metadata


def program_version() -> str:
    """Return the name and the version, from the installed package's metadata, or that it is a checkout's source."""
    try:
        return f"scanback {metadata.version('scanback')}"
    except metadata.PackageNotFoundError:
        return "scanback (source checkout)"
