"""A mesh of a million vertices comes into the scene by File > Import."""

import sys

import bpy

sys.path.append("/shared")

from stalls import watched


def steps(window):
    yield from window.install()
    bpy.data.objects.remove(bpy.data.objects["Cube"])
    yield from window.open_tab("Scanback")
    window.shot("before")
    with window.within():
        bpy.ops.scanback.import_reconstruction("INVOKE_DEFAULT", filepath="/shared/large/reconstruction.json")
    ended, window.seen["stalls"] = yield from watched(window.finish_job(half_way="half-way"))
    window.seen["ended"] = ended
    meshes = [item for item in bpy.data.objects if item.type == "MESH"]
    window.seen["vertices"] = [len(item.data.vertices) for item in meshes]
    with window.within():
        bpy.ops.view3d.view_all()
    yield 2.0
    window.shot("imported")
