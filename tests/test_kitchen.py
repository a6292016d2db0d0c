"""The real kitchen of 7-Scenes, where its frames are at hand; they do not come with the repository."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from fusion.cli import main as fusion

KITCHEN = Path(__file__).parents[2] / "shared" / "data" / "7scenes_redkitchen"

pytestmark = pytest.mark.skipif(not KITCHEN.is_dir(), reason="the frames of 7-Scenes' RedKitchen are not here")


def test_the_kitchen_is_fused_in_colour_and_its_frames_are_located(capsys, tmp_path):
    arguments = [str(KITCHEN), str(tmp_path), "--voxel-size", "0.03", "--frames", "::4", "--json"]
    assert fusion(["reconstruct", *arguments]) == 0
    record = json.loads(capsys.readouterr().out)
    assert record["frames"] == 50
    assert record["metrics"] is None
    mesh = trimesh.load(tmp_path / "mesh.ply", process=False)
    # A room: some metres each way, tens of square metres of surface, most of it in one piece.
    assert (np.array([3, 2, 2]) < mesh.extents).all()
    assert (mesh.extents < np.array([9, 6, 6])).all()
    assert 15 < mesh.area < 60
    assert max(part.area for part in mesh.split(only_watertight=False)) > 0.5 * mesh.area
    # Its cupboards are red.
    red, green, blue = np.moveaxis(np.asarray(mesh.visual.vertex_colors[:, :3], float), -1, 0)
    assert ((red > 80) & (red > 2 * green) & (red > 2 * blue)).mean() > 0.05

    assert fusion(["locate", str(tmp_path), str(KITCHEN), "--frames", "2::32", "--json"]) == 0
    poses = json.loads(capsys.readouterr().out)
    assert np.median([pose["rotation_error_deg"] for pose in poses]) < 8
    assert np.median([pose["translation_error_m"] for pose in poses]) < 0.2
