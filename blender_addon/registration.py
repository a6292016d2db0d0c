"""What the extension adds to Blender, in the order in which it is added."""

from . import preferences, settings
from .operators import automatic, compare, fuse, import_files, job_control, locate, scan, sides, views
from .panel import legend, results_panel, step_panels
from .results import kept_in_order
from .steps import scene_reference

MODULES = (
    preferences,
    settings,
    scene_reference,
    kept_in_order,
    job_control,
    scan,
    fuse,
    locate,
    compare,
    sides,
    views,
    automatic,
    import_files,
    step_panels,
    results_panel,
    legend,
)


def register() -> None:
    """Add the modules' classes, menu entries and handlers."""
    for module in MODULES:
        module.register()


def unregister() -> None:
    """Take them away, in the opposite order."""
    for module in reversed(MODULES):
        module.unregister()
