"""The life of an extension in Blender: ``extension_session.py ZIP RECONSTRUCTION``.

Installs, uses, disables, enables and uninstalls it. Run in a process of its own with
BLENDER_USER_RESOURCES set to an empty folder. Prints one line of JSON.
"""

import importlib
import json
import os
import sys
import threading
from pathlib import Path

import bpy

MODULE = "bl_ext.user_default.scanback"
WITH_PROPERTIES = ("Scene", "WindowManager", "Object", "Collection", "Camera", "Mesh", "World", "Screen", "ID")


def traces():
    """Return all the places where an extension can leave something, each as what lies there."""
    types = [kind for kind in (getattr(bpy.types, name) for name in dir(bpy.types)) if isinstance(kind, type)]
    draws = {kind.__name__: getattr(getattr(kind, "draw", None), "_draw_funcs", ()) for kind in types}
    handlers = {name: getattr(bpy.app.handlers, name) for name in dir(bpy.app.handlers)}
    keyconfig = bpy.context.window_manager.keyconfigs.addon
    user = Path(os.environ["BLENDER_USER_RESOURCES"])
    return {
        "classes": sorted(kind.__name__ for kind in types if "scanback" in kind.__name__.lower()),
        "operators": sorted(dir(bpy.ops.scanback)),
        "draws": {name: len(functions) for name, functions in draws.items() if functions},
        "handlers": {name: len(calls) for name, calls in handlers.items() if isinstance(calls, list)},
        "properties": {name: sorted(getattr(bpy.types, name).bl_rna.properties.keys()) for name in WITH_PROPERTIES},
        "keys": {} if keyconfig is None else {name: len(keys.keymap_items) for name, keys in keyconfig.keymaps.items()},
        "threads": threading.active_count(),
        "path": [entry for entry in sys.path if "scanback" in entry],
        "files": sorted(str(path.relative_to(user)) for path in user.rglob("*scanback*")),
        "enabled": MODULE in bpy.context.preferences.addons,
    }


def begin_job():
    """Begin a job that never ends by itself, as a user does who then takes the extension away."""
    runner = importlib.import_module(f"{MODULE}.jobs.runner")
    pace = importlib.import_module(f"{MODULE}.jobs.job").Pace

    def work(job):
        while True:
            yield pace.WAIT

    return runner.start("Test", work)


def main(archive, folder):
    """Go through an extension's whole life."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    seen = {"before": traces()}
    bpy.ops.extensions.package_install_files(filepath=archive, repo="user_default", enable_on_install=True)
    seen["installed"] = traces()
    seen["import"] = list(bpy.ops.scanback.import_reconstruction(directory=folder))
    seen["objects"] = sorted(item.type for item in bpy.data.collections["Scanback sphere"].all_objects)
    job = begin_job()
    seen["job"] = [job.state.value, job.folder.is_dir()]
    bpy.ops.preferences.addon_disable(module=MODULE)
    seen["job"] += [job.state.value, job.folder.is_dir()]
    seen["disabled"] = traces()
    bpy.ops.preferences.addon_enable(module=MODULE)
    seen["enabled again"] = traces()
    bpy.ops.scanback.import_reconstruction(directory=folder)
    seen["collections"] = len(bpy.data.collections)
    import addon_utils  # Blender's own, which is there once bpy is

    addon_utils._extensions_warnings_get._is_first = True  # worked out anew, as preferences do when they are opened
    seen["policy"] = {name: list(texts) for name, texts in addon_utils._extensions_warnings_get().items()}
    packages = {name.partition(".")[0] for name in sys.modules}
    seen["foreign"] = sorted(packages & {"blender_addon", "datagen", "fusion"})
    repositories = [repository.module for repository in bpy.context.preferences.extensions.repos]
    bpy.ops.extensions.package_uninstall(repo_index=repositories.index("user_default"), pkg_id="scanback")
    seen["uninstalled"] = traces()
    sys.stdout.write("SEEN " + json.dumps(seen) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
