"""Blender renders, fusion fuses, and the mesh is held against what was rendered."""

import importlib.util
import json

import pytest

from datagen.cli import main as datagen
from fusion.cli import main as fusion

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("bpy") is None, reason='Blender is not installed: pip install "scanback[blender]"'
)

SPHERE = """
name = "ball"

[render]
frames = 24
size = [160, 120]
samples = 1
bounces = 1
denoise = false

[camera]
focal_length_mm = 40

[materials.clay]
color = "#b07050"

[[objects]]
name = "Ball"
shape = "sphere"
material = "clay"
scale = 0.25
smooth = true

[[lights]]
type = "sun"
position = [1, -2, 3]
power = 2
"""

KEYFRAME = "\n[[keyframes]]\ntime = {time}\nposition = {position}\nlook_at = [0.0, 0.0, 0.0]\n"

# Two turns, the first from above, the second from below.
CIRCLE = [(0.9, 0.0), (0.0, 0.9), (-0.9, 0.0), (0.0, -0.9)]
POSITIONS = [(x, y, 0.5 if i < 4 else -0.5) for i, (x, y) in enumerate([*CIRCLE, *CIRCLE, CIRCLE[0]])]
KEYFRAMES = "".join(KEYFRAME.format(time=i / 8, position=list(position)) for i, position in enumerate(POSITIONS))


def metrics_of(capsys, scene, folder, voxel_size, *options):
    assert datagen(["render", str(scene), str(folder / "data"), *options]) == 0
    capsys.readouterr()
    arguments = [str(folder / "data"), str(folder / "out"), "--voxel-size", voxel_size, "--json"]
    assert fusion(["reconstruct", *arguments]) == 0
    return json.loads(capsys.readouterr().out)["metrics"]


def test_a_rendered_sphere_comes_back_within_a_fifth_of_a_voxel(capsys, tmp_path):
    (tmp_path / "ball.toml").write_text(SPHERE + KEYFRAMES)
    metrics = metrics_of(capsys, tmp_path / "ball.toml", tmp_path, "0.01")
    assert metrics["chamfer_voxels"] < 0.2
    assert metrics["fscore"] > 0.97
    assert metrics["normal_consistency"] > 0.97


def test_a_rendered_suzanne_comes_back_within_a_fifth_of_a_voxel(capsys, tmp_path):
    metrics = metrics_of(capsys, "suzanne", tmp_path, "0.006", "--frames", "24", "--size", "192x144", "--samples", "1")
    assert metrics["chamfer_voxels"] < 0.2
    assert metrics["fscore"] > 0.9
