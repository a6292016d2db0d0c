"""Starting a module of ours where Blender can be imported.

That is this interpreter, where Blender is installed as the Python module bpy. A Blender application brings no such
module for others: there the application itself runs the module, without an interface and without the user's settings.
"""

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

PROGRAM_VARIABLE = "SCANBACK_BLENDER"
"""Environment variable that names a Blender application, for those who have no bpy module."""

EXTENSIONS_VARIABLE = "BLENDER_USER_EXTENSIONS"
"""Blender's own: where the user's extensions are."""

_RUN_MODULE = (
    "import runpy, sys; sys.argv = sys.argv[sys.argv.index('--') + 1:]; "
    "runpy.run_module(sys.argv[0], run_name='__main__')"
)


def runs_in_application() -> bool:
    """Tell whether Blender is an application here, rather than a Python module."""
    return bool(os.environ.get(PROGRAM_VARIABLE))


def module_command(module: str, *arguments: str) -> list[str]:
    """Return the command line that runs ``module`` with ``arguments`` where it can import bpy.

    A Blender application says a word on standard output before the module runs: take lines of JSON alone from it. It
    finds our packages by ``PYTHONPATH``.
    """
    program = os.environ.get(PROGRAM_VARIABLE)
    if not program:
        return [sys.executable, "-m", module, *arguments]
    options = ["--background", "--factory-startup", "--python-use-system-env", "--python-exit-code", "1"]
    return [program, *options, "--python-expr", _RUN_MODULE, "--", module, *arguments]


def module_environment(folder: Path) -> dict[str, str]:
    """Return the environment for ``module_command``, with an empty folder for extensions made in ``folder``.

    The Blender that we start has no extension enabled, and one that is reset in that state, application or module,
    removes the wheels of all extensions that it finds: those of the user's own Blender, were they there.
    """
    extensions = folder / "extensions"
    extensions.mkdir(exist_ok=True)
    return {**os.environ, EXTENSIONS_VARIABLE: str(extensions)}


@contextlib.contextmanager
def leaving_extensions_alone() -> Iterator[None]:
    """Keep the bpy module in this very process from the user's extensions while the block runs, for the same reason."""
    before = os.environ.get(EXTENSIONS_VARIABLE)
    with tempfile.TemporaryDirectory(prefix="scanback-extensions-") as folder:
        os.environ[EXTENSIONS_VARIABLE] = folder
        try:
            yield
        finally:
            os.environ.pop(EXTENSIONS_VARIABLE)
            if before is not None:
                os.environ[EXTENSIONS_VARIABLE] = before
