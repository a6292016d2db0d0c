from pathlib import Path
from typing import Any

import bpy
import cv2
import numpy as np

from blender_addon.headless.render_still import render_png, set_up_presentation
from blender_addon.results.import_reconstruction import LOCATED_COLLECTION, import_reconstruction


def test_a_marker_looks_out_of_its_own_frustum_and_the_path_freely(
    empty_scene: bpy.types.Scene, sphere_scan: Any, tmp_path: Path
) -> None:
    """The camera stands inside both; without the scan's far side nothing of them is in its view."""
    near = [pose for pose in sphere_scan.record["trajectory"] if pose["frame"] in (3, 4, 6)]
    sphere_scan.record["trajectory"] = near
    sphere_scan.poses[:] = sphere_scan.poses[:1]
    sphere_scan.rewrite()
    set_up_presentation(empty_scene, samples=4)
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    wires = [item for item in collection.all_objects if item.type == "CURVE"]
    assert len(wires) == 2
    camera = collection.children[LOCATED_COLLECTION].objects["Query 5 nearest 4"]
    images = []
    for hidden in (False, True):
        for wire in wires:
            wire.hide_render = hidden
        render_png(empty_scene, camera, tmp_path / "view.png")
        images.append(cv2.imread(str(tmp_path / "view.png")))
    np.testing.assert_array_equal(images[0], images[1])
    assert np.ptp(images[0]) > 100  # the sphere is there


def test_the_frustum_holds_the_view(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    """A point just inside each corner of the image lies inside the pyramid, and the roof marks the upper side."""
    collection = import_reconstruction(empty_scene, sphere_scan.folder)
    camera = collection.children[LOCATED_COLLECTION].objects["Query 5 nearest 4"]
    splines = camera.children[0].data.splines
    corners = np.array([point.co[:3] for point in splines[0].points])
    frame_x = (corners[:, 0] / -corners[:, 2]) * sphere_scan.camera.fx + sphere_scan.camera.cx
    frame_y = (-corners[:, 1] / -corners[:, 2]) * sphere_scan.camera.fy + sphere_scan.camera.cy
    assert frame_x.min() < -0.5
    assert frame_x.max() > sphere_scan.camera.width - 0.5
    assert frame_y.min() < -0.5
    assert frame_y.max() > sphere_scan.camera.height - 0.5
    assert splines[-1].points[1].co[1] > corners[:, 1].max()
