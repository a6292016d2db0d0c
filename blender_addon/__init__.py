"""The Blender extension: scan, fuse, locate and compare from a panel, and bring the results into the scene.

It knows the pipeline only through its command lines and its files: long work runs in processes of its own, so that
Blender's interface never waits. Importing this package does not load ``bpy``; ``register`` does.
"""


def register() -> None:
    """Add all that the extension has to Blender."""
    from . import registration  # noqa: PLC0415 - it needs bpy, the file readers beside it do not

    registration.register()


def unregister() -> None:
    """End what runs, and take away all that ``register`` added."""
    from . import registration  # noqa: PLC0415

    registration.unregister()
