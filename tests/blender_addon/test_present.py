"""The command line, run as users run it."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import bpy
import cv2
import numpy as np
import pytest

from blender_addon.__main__ import main

REPOSITORY = Path(__file__).parents[2]


def _in_a_process(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "blender_addon", *map(str, arguments)]
    return subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=120)


Run: TypeAlias = Callable[..., subprocess.CompletedProcess[str]]


@pytest.fixture
def run(empty_scene: bpy.types.Scene, capfd: pytest.CaptureFixture[str]) -> Run:
    """The command line within this process, which has loaded Blender already."""

    def call(*arguments: object) -> subprocess.CompletedProcess[str]:
        capfd.readouterr()
        try:
            code = main(list(map(str, arguments)))
        except SystemExit as end:  # argparse's
            code = int(end.code or 0)
        said = capfd.readouterr()
        return subprocess.CompletedProcess(arguments, code, said.out, said.err)

    return call


def test_a_reconstruction_is_presented(empty_scene: bpy.types.Scene, sphere_scan: Any) -> None:
    result = _in_a_process(sphere_scan.folder, "--size", "320x180", "--samples", "8")
    assert result.returncode == 0, result.stderr
    files = [sphere_scan.folder / name for name in ("result.blend", "preview.png", "comparison.png")]
    assert result.stdout.split() == [str(file) for file in files]
    assert sorted(path.name for path in sphere_scan.folder.iterdir()) == sorted(
        ["dataset", "mesh.ply", "poses.json", "reconstruction.json", *(file.name for file in files)]
    )
    _check_blend(files[0], sphere_scan)
    _check_preview(files[1])
    _check_comparison(files[2], sphere_scan)


def _check_blend(blend: Path, scan: Any) -> None:
    bpy.ops.wm.open_mainfile(filepath=str(blend))
    scene = bpy.context.scene
    collection = scene.collection.children["Scanback sphere"]
    assert collection["scanback_folder"].startswith("//")  # the folder may move with the file
    assert sorted(item.type for item in collection.all_objects) == ["CAMERA", "CAMERA", *["CURVE"] * 3, "MESH"]
    assert len(collection.objects["Scanback mesh"].data.vertices) == len(scan.mesh.vertices)
    assert (scene.render.resolution_x, scene.render.resolution_y) == (160, 120)
    assert scene.view_settings.view_transform == "Standard"
    assert scene.camera.name == "Overview"
    markers = collection.children["Located frames"].objects
    assert {item["query"] for item in markers if item.type == "CAMERA"} == {5, 8}


def _check_preview(preview: Path) -> None:
    """Mesh, path and markers are each seen, and nothing touches the border."""
    image = cv2.imread(str(preview))
    assert image.shape == (180, 320, 3)
    blue, green, red = np.moveaxis(image.astype(int), -1, 0)
    path = (blue > 150) & (red < 60) & (abs(green - 110) < 30)
    markers = (red > 200) & (blue < 60) & (abs(green - 112) < 30)
    assert path.sum() > 100
    assert markers.sum() > 50
    background = image[0, 0]
    assert background.min() > 200
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]])
    assert (border == background).all()
    covered = (image != background).any(axis=-1)
    assert covered.any(axis=0).mean() > 0.85  # as large as the picture allows
    assert len(np.unique(image[60:160, 100:220].reshape(-1, 3), axis=0)) > 1000  # the coloured sphere


def _check_comparison(comparison: Path, scan: Any) -> None:
    """The reconstruction, seen from the frame's own pose, is the frame; half a pixel off it would not be."""
    image = cv2.imread(str(comparison)).astype(float)
    width, height, factor = scan.camera.width, scan.camera.height, 3
    left = image[: height * factor : factor, : width * factor : factor]
    right = image[: height * factor : factor, width * factor + 8 :: factor][:, :width]
    assert left.shape == right.shape
    inside = cv2.erode((np.abs(left - left[0, 0]).max(axis=-1) > 20).astype(np.uint8), np.ones((5, 5))) > 0
    assert inside.sum() > 3000
    aligned = np.abs(left - right)[inside].mean()
    assert aligned < 1.0
    for shift_px in ((0.5, 0), (0, 0.5), (0.5, 0.5)):
        moved = cv2.warpAffine(right, np.float32([[1, 0, shift_px[0]], [0, 1, shift_px[1]]]), (width, height))
        assert np.abs(left - moved)[inside].mean() > 1.5 * aligned


def test_without_its_dataset_a_reconstruction_is_presented_without_comparison(
    sphere_scan: Any, tmp_path: Path, run: Run
) -> None:
    sphere_scan.dataset.rename(tmp_path / "elsewhere")
    outputs = ["--out", tmp_path / "new" / "a.blend", "--preview", tmp_path / "new" / "b.png"]
    result = run(sphere_scan.folder, *outputs, "--size", "64x48", "--samples", "1")
    assert result.returncode == 0, result.stderr
    assert "note: no comparison with the scan: " in result.stderr
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == ["a.blend", "b.png"]
    result = run(sphere_scan.folder, "--comparison", tmp_path / "c.png")
    _check_refused(result, "dataset: no such folder")


def test_a_folder_of_any_name_is_presented(sphere_scan: Any) -> None:
    folder = sphere_scan.folder.with_name("é {x} ## %d 'q'")
    sphere_scan.folder.rename(folder)
    result = _in_a_process(folder, "--size", "64x48", "--samples", "1")
    assert result.returncode == 0, result.stderr
    assert result.stdout.splitlines() == [
        str(folder / name) for name in ("result.blend", "preview.png", "comparison.png")
    ]
    assert cv2.imdecode(np.fromfile(folder / "preview.png", np.uint8), cv2.IMREAD_COLOR).shape == (48, 64, 3)


def test_bad_input_is_refused_in_one_line_with_nothing_written(sphere_scan: Any, run: Run) -> None:
    (sphere_scan.folder / "mesh.ply").write_bytes(b"")
    before = sorted(sphere_scan.folder.iterdir())
    _check_refused(run(sphere_scan.folder), "mesh.ply: not a whole PLY file")
    assert sorted(sphere_scan.folder.iterdir()) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_to_is_refused(sphere_scan: Any, run: Run) -> None:
    sphere_scan.folder.chmod(0o555)
    _check_refused(run(sphere_scan.folder), "result.blend: cannot be written")


def test_an_output_below_a_file_is_refused(sphere_scan: Any, run: Run) -> None:
    result = run(sphere_scan.folder, "--out", sphere_scan.folder / "mesh.ply" / "result.blend")
    _check_refused(result, "result.blend: cannot be written")


@pytest.mark.parametrize("arguments", [("--size", "3x3"), ("--size", "big"), ("--samples", "0")])
def test_options_out_of_range_are_refused(tmp_path: Path, arguments: tuple[str, str], run: Run) -> None:
    result = run(tmp_path, *arguments)
    assert result.returncode == 2
    assert f"argument {arguments[0]}: '{arguments[1]}': expected" in result.stderr


def test_the_old_name_of_an_option_is_answered_with_the_new_one(tmp_path: Path, run: Run) -> None:
    result = run(tmp_path, "--output", tmp_path / "a.blend")
    assert result.returncode == 2
    assert (
        f"argument --output: is called --out, as in the other commands: --out {tmp_path / 'a.blend'}" in result.stderr
    )


def _check_refused(result: subprocess.CompletedProcess[str], message: str) -> None:
    assert result.returncode == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    (line,) = (line for line in result.stderr.splitlines() if line.startswith("error: "))
    assert message in line
