import pkgutil
import subprocess
import sys
from pathlib import Path

import datagen

PACKAGE = Path(datagen.__file__).parent
MODULES = sorted(module.name for module in pkgutil.walk_packages(datagen.__path__, "datagen."))
ELSEWHERE = ("datagen.blender", "datagen.__main__")


def test_no_module_outside_datagen_blender_loads_blender_warp_or_fusion():
    modules = [name for name in MODULES if not name.startswith(ELSEWHERE)]
    assert "datagen.rendering.render_job" in modules
    code = (
        f"import importlib, sys; [importlib.import_module(name) for name in {modules!r}]; "
        "print(sorted({'bpy', 'warp', 'fusion', 'blender_addon', 'OpenEXR'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]"


def test_help_waits_for_nothing_that_is_slow_to_import():
    code = (
        "import sys; from datagen.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "slow = {'numpy', 'cv2', 'pydantic', 'rich', 'importlib.metadata'}\n"
        "print(sorted(slow & sys.modules.keys()), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.startswith("usage: datagen")
    assert done.stderr.strip() == "[]"
