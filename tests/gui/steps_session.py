"""The four steps, as somebody takes them who has Suzanne before them and a zip."""

import json
import math
import sys
from pathlib import Path

import bpy

sys.path.append("/shared")

from stalls import redrawing, watched

SCAN = Path("/shared/scan")


def steps(window):
    yield from window.install()
    window.seen["enabled"] = "bl_ext.user_default.scanback" in bpy.context.preferences.addons
    suzanne()
    settings = bpy.context.scene.scanback
    settings.folder = str(SCAN)
    settings.scan.trajectory = "HEMISPHERE"
    settings.scan.frames, settings.scan.width, settings.scan.height = 24, 320, 240
    settings.fuse.every = 2
    settings.locate.query = "HELD_OUT"
    yield from window.open_tab("Scanback")
    window.shot("before")
    _, window.seen["idle"] = yield from watched(redrawing(3.0))

    for operator in ("scan", "fuse", "locate", "compare"):
        with window.within():
            result = getattr(bpy.ops.scanback, operator)("INVOKE_DEFAULT")
        assert result == {"FINISHED"}, (operator, result)
        when = grows if operator == "fuse" else lambda: True
        ending, stalls = yield from watched(window.finish_job(half_way=f"{operator}-running", when=when))
        window.seen[operator] = {"ended": ending, "sides": sides(), **stalls}
        yield 0.5
        window.shot(f"{operator}-done")
        assert ending[0] == "done", ending

    window.seen["files"] = sorted(path.name for path in (SCAN / "reconstruction").iterdir())
    window.seen["objects"] = [[item.name, item.type] for item in bpy.data.objects]
    yield from errors(window)
    yield from view(window)
    yield from both_sides(window)
    yield from looking(window)
    yield from narrow(window)


def errors(window):
    """See the errors from near, from where Suzanne looks."""
    # Solid view: EEVEE takes minutes without a graphics card.
    with window.within():
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.object.select_all(action="DESELECT")
        mesh().select_set(True)
        bpy.ops.view3d.view_selected()
        bpy.ops.view3d.view_orbit(angle=0.35, type="ORBITUP")
        bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.scanback.dismiss()
    yield from window.scroll(-14)
    yield 1.5
    window.shot("errors")


def view(window):
    """Locate what the viewport shows, which has no perspective now; with it, the viewport tells from where it looks."""
    settings = bpy.context.scene.scanback.locate
    settings.query, settings.refine = "VIEW", True
    looks = window.area("VIEW_3D").spaces.active.region_3d
    perspective = looks.view_perspective
    with window.within():
        assert bpy.ops.scanback.locate("INVOKE_DEFAULT") == {"FINISHED"}
    ended = yield from window.finish_job()
    window.shot("view-located")
    out = SCAN / "reconstruction"
    poses = json.loads((out / "poses.json").read_text())
    voxel_m = json.loads((out / "reconstruction.json").read_text())["voxel_size_m"]
    with window.within():
        bpy.ops.view3d.view_persportho()
    yield 1.0
    place = list(looks.view_matrix.inverted().translation)
    window.seen["view"] = {"ended": ended, "voxel_m": voxel_m, "poses": poses, "of": perspective, "place": place}
    with window.within():
        bpy.ops.view3d.view_persportho()
    bpy.ops.scanback.dismiss()


def both_sides(window):
    """Go from one side to the other and one step back."""
    seen = window.seen["sides"] = {}
    for side in ("ORIGINAL", "BOTH", "RECONSTRUCTION"):
        with window.within():
            bpy.ops.scanback.show_side(side=side)
            bpy.ops.ed.undo_push(message=side)
        yield 0.5
        seen[side] = sides()
        if side == "ORIGINAL":
            window.shot("original")
    with window.within():
        bpy.ops.ed.undo()
    yield 0.5
    seen["UNDONE"] = sides()
    with window.within():
        bpy.ops.ed.redo()
        bpy.ops.scanback.show_colors(errors=False)
    yield 1.5
    window.shot("colors")


def looking(window):
    """Look through the nearest frame, step to the next, and have its picture in front."""
    with window.within():
        window.seen["look"] = list(bpy.ops.scanback.look_through(target="CURSOR"))
        window.seen["perspective"] = window.area("VIEW_3D").spaces.active.region_3d.view_perspective
    yield 2.0
    window.shot("look-through")
    camera = bpy.context.scene.camera
    before = camera["frame"]
    with window.within():
        window.seen["step"] = list(bpy.ops.scanback.step_view(step=1))
    window.seen["stepped"] = [before, camera["frame"], list(camera["nearest_frames"])[:2]]
    picture = camera.data.background_images[0]
    picture.display_depth, picture.alpha = "FRONT", 1.0
    yield 2.0
    window.shot("picture-in-front")
    picture.display_depth, picture.alpha = "BACK", 0.5


def narrow(window):
    """Make the sidebar narrow by its edge."""
    area = window.area("VIEW_3D")
    region = window.region(area, "UI")
    window.seen["width"] = [region.width]
    yield from window.scroll(30)
    yield from window.drag(region.x + 8, region.y + region.height // 2, 90, 0)
    yield 1.0
    window.seen["width"].append(window.region(area, "UI").width)
    bpy.context.scene.scanback.locate.query = "FRAME"
    bpy.context.scene.scanback.locate.frame = 1000
    with window.within():
        bpy.ops.scanback.locate("INVOKE_DEFAULT")
    window.seen["refused"] = yield from window.finish_job()
    yield 1.0
    window.shot("narrow")


def grows():
    return any(item.name.startswith("Scanback live") for item in bpy.data.objects)


def mesh():
    return next(item for item in bpy.data.objects if item.name.startswith("Scanback mesh"))


def sides():
    """Return which of Suzanne and her reconstruction, where there is one, can be seen."""
    ours = [item for item in bpy.data.objects if item.name.startswith("Scanback mesh")]
    return [bpy.data.objects["Suzanne"].visible_get(), any(item.visible_get() for item in ours)]


def suzanne():
    """Have Suzanne, in colours, stand where the cube was."""
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    bpy.ops.mesh.primitive_monkey_add(size=1.0, location=(0, 0, 0.6), rotation=(math.radians(-20), 0, 0.5))
    monkey = bpy.context.object
    monkey.modifiers.new("Smooth", "SUBSURF").render_levels = 2
    for polygon in monkey.data.polygons:
        polygon.use_smooth = True
    material = bpy.data.materials.new("Painted")
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    checker = nodes.new("ShaderNodeTexChecker")
    checker.inputs["Color1"].default_value = (0.8, 0.25, 0.1, 1)
    checker.inputs["Color2"].default_value = (0.1, 0.35, 0.7, 1)
    checker.inputs["Scale"].default_value = 6
    links.new(checker.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    monkey.data.materials.append(material)
    # Lighter than Blender's grey, so that the frames' pictures can be told from the viewport behind them.
    bpy.context.scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.55, 0.62, 0.7, 1)
