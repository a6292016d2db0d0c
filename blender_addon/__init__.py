"""The Blender extension: brings reconstruction folders into the scene.

It knows the pipeline only through the files that it wrote, so the extension runs where nothing but Blender is
installed. Importing this package does not load ``bpy``; ``register`` does.
"""


def register() -> None:
    """Add the operators, the menu entry and the panel to Blender."""
    from . import operators, panel  # noqa: PLC0415 - they need bpy, the file readers beside them do not

    operators.register()
    panel.register()


def unregister() -> None:
    """Take away all that ``register`` added, in the opposite order."""
    from . import operators, panel  # noqa: PLC0415

    panel.unregister()
    operators.unregister()
