"""What comes after a scan: files are dropped, frames looked at, the file saved and opened, the extension taken away."""

import sys
from pathlib import Path

import bpy
import numpy as np

MODULE = "bl_ext.user_default.scanback"


def steps(window):
    yield from window.install()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    window.seen["policy"] = warnings()
    yield from window.open_tab("Scanback")
    yield from dropping(window)
    yield from shading(window)
    yield from looking(window)
    yield from replaying(window)
    yield from reopening(window)
    yield from leaving(window)


def warnings():
    """Return what Blender finds in the extension that its policy forbids, worked out as its preferences do."""
    import addon_utils

    addon_utils._extensions_warnings_get._is_first = True
    return [text for name, texts in addon_utils._extensions_warnings_get().items() for text in [name, *texts]]


def dropping(window):
    """Drop files onto the viewport: of a mesh Blender asks who is to take it, as it can do so itself."""
    window.event("MOUSEMOVE", "NOTHING", x=600, y=500)
    yield 0.3
    for name in ("reconstruction.json", "mesh.ply"):
        before = len(bpy.data.objects)
        with window.within():
            bpy.ops.wm.drop_import_file("INVOKE_DEFAULT", directory="/shared/ball", files=[{"name": name}])
        yield 1.0
        if name == "mesh.ply":
            window.shot("drop-menu")
            yield from window.press("P", 600, 500)  # the letter that the menu underlines
        yield 1.0
        window.seen[f"dropped {name}"] = [len(bpy.data.objects) - before, sorted(c.name for c in bpy.data.collections)]
    window.shot("dropped")


def shading(window):
    """See the ball's colours in each kind of shading, from near, without what is drawn over it."""
    bpy.data.objects["mesh"].hide_set(True)
    ball = next(item for item in bpy.data.objects if item.name.startswith("Scanback mesh"))
    space = window.area("VIEW_3D").spaces.active
    with window.within():
        bpy.ops.object.select_all(action="DESELECT")
        ball.select_set(True)
        bpy.ops.view3d.view_selected()
    space.overlay.show_overlays = False
    for kind in ("SOLID", "MATERIAL", "RENDERED"):
        space.shading.type = kind
        yield 1.0
        for _ in range(30):  # without a graphics card EEVEE takes a minute, and all is grey meanwhile
            yield 3.0
            picture = window.shot(f"shading-{kind.lower()}")
            if coloured(picture) > 0.03:
                break
            picture.unlink()
        window.seen[f"shading {kind}"] = picture.name
    space.shading.type, space.overlay.show_overlays = "SOLID", True
    bpy.data.objects["mesh"].hide_set(False)


def coloured(picture):
    """Return which share of a picture is of a strong colour."""
    image = bpy.data.images.load(str(picture))
    values = np.array(image.pixels[:]).reshape(-1, 4)[:, :3]
    bpy.data.images.remove(image)
    return float(np.mean(np.ptp(values, axis=1) > 0.4))


def looking(window):
    """Look through the frame nearest to the cursor by the panel's buttons, and see what they say."""
    with window.within():
        bpy.ops.scanback.look_through(target="CURSOR")
    yield from window.scroll(-30)
    yield 1.0
    window.shot("looking")
    camera = bpy.context.scene.camera
    window.seen["looking"] = [camera["frame"], list(camera["nearest_frames"])[:3]]


def replaying(window):
    """Go the way of the scan again on the timeline."""
    with window.within():
        bpy.ops.scanback.replay()
    scene = bpy.context.scene
    places = window.seen["replay"] = []
    for frame in (0, 4, 9):
        scene.frame_set(scene.frame_start + frame)
        places.append(list(scene.camera.matrix_world.translation))
        yield 1.0
        window.shot(f"replay-{frame}")


def reopening(window):
    """Save the file, and open it again."""
    bpy.ops.wm.save_as_mainfile(filepath="/shared/saved.blend")
    bpy.ops.wm.open_mainfile(filepath="/shared/saved.blend")
    yield 2.0
    collection = next(c for c in bpy.data.collections if "scanback_folder" in c)
    images = [image.filepath for image in bpy.data.images if image.source in ("FILE", "SEQUENCE")]
    window.seen["reopened"] = [collection["scanback_folder"], images, sorted(item.type for item in bpy.data.objects)]
    window.seen["there"] = [Path(bpy.path.abspath(path)).is_file() for path in images]
    with window.within():
        window.seen["stepped"] = list(bpy.ops.scanback.step_view(step=1))
    yield 1.0
    window.shot("reopened")


def leaving(window):
    """Uninstall the extension: its tab goes, and its results stay."""
    repositories = [repository.module for repository in bpy.context.preferences.extensions.repos]
    bpy.ops.extensions.package_uninstall(repo_index=repositories.index("user_default"), pkg_id="scanback")
    yield 2.0
    window.shot("uninstalled")
    user = Path("/shared/user")
    window.seen["left"] = {
        "files": sorted(str(path.relative_to(user)) for path in user.rglob("*scanback*")),
        "code": sorted(str(path) for path in user.rglob("*.py")),
        "classes": [name for name in dir(bpy.types) if "scanback" in name.lower()],
        "operators": dir(bpy.ops.scanback),
        "modules": [name for name in sys.modules if MODULE in name],
        "path": [entry for entry in sys.path if "scanback" in entry],
        "objects": len(bpy.data.objects),
    }
