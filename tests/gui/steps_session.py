"""The four steps, as somebody takes them who has Suzanne before them and a zip."""

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
        ending, stalls = yield from watched(window.finish_job(half_way=f"{operator}-running"))
        window.seen[operator] = {"ended": ending, **stalls}
        yield 0.5
        window.shot(f"{operator}-done")
        assert ending[0] == "done", ending

    window.seen["files"] = sorted(path.name for path in (SCAN / "reconstruction").iterdir())
    window.seen["objects"] = [[item.name, item.type] for item in bpy.data.objects]
    # The original would hide what stands in the same place. Solid view: EEVEE takes minutes without a graphics card.
    bpy.data.objects["Suzanne"].hide_set(True)
    with window.within():
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.object.select_all(action="DESELECT")
        next(item for item in bpy.data.objects if item.name.startswith("Scanback mesh")).select_set(True)
        bpy.ops.view3d.view_selected()
    yield 2.0
    window.shot("errors")
    with window.within():
        bpy.ops.scanback.show_colors(errors=False)
    yield 2.0
    window.shot("colors")
    with window.within():
        window.seen["look"] = list(bpy.ops.scanback.look_through(target="CURSOR"))
    yield 2.0
    window.shot("look-through")
    window.seen["perspective"] = window.area("VIEW_3D").spaces.active.region_3d.view_perspective


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
