"""What the extension adds to Blender, in the order in which it is added."""

from .operators import import_files
from .panel import results_panel

MODULES = (import_files, results_panel)


def register() -> None:
    """Add the modules' classes, menu entries and handlers."""
    for module in MODULES:
        module.register()


def unregister() -> None:
    """Take them away, in the opposite order."""
    for module in reversed(MODULES):
        module.unregister()
