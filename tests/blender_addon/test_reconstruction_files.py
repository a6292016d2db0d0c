from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from blender_addon.errors import ReconstructionError
from blender_addon.files.reconstruction_files import read_reconstruction

SCALED = np.diag([1.1, 1.1, 1.1, 1]).tolist()
MIRRORED = np.diag([-1.0, 1, 1, 1]).tolist()


def test_a_folder_is_read_whole(sphere_scan: Any) -> None:
    reconstruction = read_reconstruction(sphere_scan.folder)
    assert reconstruction.name == "sphere"
    assert reconstruction.dataset == sphere_scan.dataset
    assert vars(reconstruction.intrinsics) == vars(sphere_scan.camera)
    assert [f.frame for f in reconstruction.trajectory] == [t["frame"] for t in sphere_scan.record["trajectory"]]
    assert [(f.query, f.nearest, f.score) for f in reconstruction.located] == [(5, 4, 0.002), (8, 7, 0.00125)]
    assert [f.rotation_error_deg for f in reconstruction.located] == [20.5, None]
    assert len(reconstruction.mesh.triangles) == len(sphere_scan.mesh.faces)


def test_located_frames_are_optional(sphere_scan: Any) -> None:
    (sphere_scan.folder / "poses.json").unlink()
    assert read_reconstruction(sphere_scan.folder).located == ()


def test_a_dataset_may_be_given_by_an_absolute_path(sphere_scan: Any) -> None:
    sphere_scan.record["dataset"] = "/somewhere/else"
    sphere_scan.rewrite()
    assert read_reconstruction(sphere_scan.folder).dataset == Path("/somewhere/else")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda r: r.pop("camera"), r"reconstruction\.json: camera: missing; write it again"),
        (lambda r: r.update(format="ply"), r"format: expected 'scanback-reconstruction', found 'ply'"),
        (lambda r: r.update(version=2), r"version: found 2, this extension reads 1; install"),
        (lambda r: r.update(version=True), r"version: expected an integer of 1 or more, found True"),
        (lambda r: r.update(dataset=""), r"dataset: expected a text, found ''"),
        (lambda r: r.update(trajectory={}), r"trajectory: expected a list, found \{\}"),
        (lambda r: r["camera"].update(fx=0), r"camera\.fx: expected a number above 0, found 0"),
        (lambda r: r["camera"].update(cx=float("nan")), r"camera\.cx: expected a finite number, found nan"),
        (lambda r: r["camera"].update(width=-3), r"camera\.width: expected an integer of 1 or more, found -3"),
        (lambda r: r["camera"].update(height=2**40), r"camera\.height: expected an integer"),
        (lambda r: r["trajectory"][3].pop("frame"), r"trajectory\[3\]\.frame: missing"),
        (lambda r: r["trajectory"].insert(0, 7), r"trajectory\[0\]: expected an object, found 7"),
        (lambda r: r["trajectory"][1].update(world_from_camera=[[1]]), r"trajectory\[1\]\.world_from_camera: .*4×4"),
        (lambda r: r["trajectory"][1].update(world_from_camera="x"), r"world_from_camera: expected a 4×4 matrix"),
        (lambda r: r["trajectory"][1].update(world_from_camera=SCALED), r"a rigid transform"),
        (lambda r: r["trajectory"][1].update(world_from_camera=MIRRORED), r"a rigid transform"),
    ],
)
def test_a_damaged_record_is_refused_by_name(sphere_scan: Any, damage: Callable, message: str) -> None:
    damage(sphere_scan.record)
    sphere_scan.rewrite()
    with pytest.raises(ReconstructionError, match=message):
        read_reconstruction(sphere_scan.folder)


def test_a_damaged_located_frame_is_refused_by_name(sphere_scan: Any) -> None:
    sphere_scan.poses[1]["score"] = "good"
    sphere_scan.rewrite()
    with pytest.raises(ReconstructionError, match=r"poses\.json: \[1\]\.score: expected a finite number, found 'good'"):
        read_reconstruction(sphere_scan.folder)


@pytest.mark.parametrize("file", ["reconstruction.json", "poses.json"])
@pytest.mark.parametrize("content", [b"", b'{"format":', b"\xff\xfe", b"[" * 100_000])
def test_a_file_that_is_not_json_is_refused(sphere_scan: Any, file: str, content: bytes) -> None:
    (sphere_scan.folder / file).write_bytes(content)
    with pytest.raises(ReconstructionError, match=rf"{file}: damaged, not JSON .* write it again"):
        read_reconstruction(sphere_scan.folder)


def test_a_folder_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ReconstructionError, match=r"holds no reconstruction\.json; choose the folder"):
        read_reconstruction(tmp_path)
    with pytest.raises(ReconstructionError, match="no such folder"):
        read_reconstruction(tmp_path / "missing")
