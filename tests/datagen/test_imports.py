import pkgutil
import subprocess
import sys
from pathlib import Path

import datagen

PACKAGE = Path(datagen.__file__).parent
MODULES = [f"datagen.{module.name}" for module in pkgutil.iter_modules([str(PACKAGE)]) if module.name != "__main__"]


def test_no_module_outside_datagen_blender_loads_blender_warp_or_fusion():
    modules = [name for name in MODULES if name != "datagen.blender"]
    assert "datagen.render_job" in modules
    code = (
        f"import importlib, sys; [importlib.import_module(name) for name in {modules!r}]; "
        "print(sorted({'bpy', 'warp', 'fusion', 'blender_addon', 'OpenEXR'} & sys.modules.keys()))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent)
    assert done.stdout.strip() == "[]"
