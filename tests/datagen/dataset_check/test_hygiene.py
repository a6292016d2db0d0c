"""Plain faults, each alone in a recording that is clean otherwise."""

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from ray_cast_recordings import record

from datagen.camera import PinholeCamera
from datagen.dataset_check.check import check_dataset
from datagen.dataset_check.frame_facts import read_frames
from datagen.dataset_check.hygiene import check_files, check_images, check_intrinsics
from datagen.dataset_check.trajectory_check import check_trajectory
from datagen.dataset_format import FRAMES_FOLDER, frame_file
from datagen.errors import InputError
from datagen.open_dataset import open_dataset


@lru_cache(maxsize=1)
def _clean():
    return record(3, frames=16, size=(96, 72))


def _facts(dataset):
    return read_frames(dataset, dataset.frame_ids, lambda: None)


def _findings(recording):
    facts = _facts(recording.in_memory(None))
    return [*check_files(facts), *check_images(facts), *check_trajectory(facts)]


@pytest.fixture
def folder(tmp_path):
    return _clean().write(tmp_path, with_mesh=False)


def _frame(folder: Path, number: int, part: str) -> Path:
    return frame_file(folder / FRAMES_FOLDER, number, part)


def test_a_clean_recording_has_none():
    assert _findings(_clean()) == []


def test_missing_and_damaged_files_are_named(folder):
    _frame(folder, 2, "pose.txt").unlink()
    _frame(folder, 5, "depth.png").write_bytes(b"not a picture")
    image = _frame(folder, 6, "color.png")
    image.write_bytes(image.read_bytes()[:100])
    report = check_dataset(open_dataset(folder))
    by_kind = [(finding.kind, finding.severity) for finding in report.findings if finding.severity == "fault"]
    assert by_kind == [("missing-frames", "fault"), ("unreadable-file", "fault"), ("unreadable-file", "fault")]
    assert report.findings[0].evidence["frames"] == {"2": ["pose"]}
    assert list(report.findings[1].evidence["errors"]) == ["6"]
    assert list(report.findings[2].evidence["errors"]) == ["5"]


def test_a_pose_with_scale_is_named(folder):
    path = _frame(folder, 4, "pose.txt")
    pose = np.loadtxt(path)
    pose[:3, :3] *= 1.1
    np.savetxt(path, pose)
    (finding,) = check_files(_facts(open_dataset(folder)))
    assert finding.kind == "unusable-pose"
    assert list(finding.evidence["errors"]) == ["4"]


def test_poses_that_mirror_are_called_a_flipped_axis(folder):
    for number in range(16):
        path = _frame(folder, number, "pose.txt")
        np.savetxt(path, np.loadtxt(path) @ np.diag([1, -1, 1, 1]))
    report = check_dataset(open_dataset(folder))
    assert "flipped-axis" in [finding.kind for finding in report.findings]


def test_nothing_usable_is_an_input_error(folder):
    for number in range(16):
        _frame(folder, number, "depth.png").unlink()
    with pytest.raises(InputError, match="none of the 16 frames"):
        check_dataset(open_dataset(folder))


def test_images_that_freeze_are_named():
    clean = _clean()
    hold = [min(i, 6) if i < 10 else i for i in range(16)]
    frozen = replace(clean, colors=tuple(clean.colors[i] for i in hold), depths=tuple(clean.depths[i] for i in hold))
    (finding,) = _findings(frozen)
    assert (finding.kind, finding.evidence["frames"]) == ("frozen-frames", [7, 8, 9])


def test_poses_that_freeze_are_named():
    clean = _clean()
    frozen = replace(clean, poses=tuple(clean.poses[min(i, 6) if i < 10 else i] for i in range(16)))
    (finding,) = [each for each in _findings(frozen) if each.kind == "frozen-poses"]
    assert finding.evidence["frames"] == [7, 8, 9]


def test_empty_depth_is_named():
    clean = _clean()
    empty = np.zeros_like(clean.depths[0])
    (finding,) = _findings(replace(clean, depths=(*clean.depths[:9], empty, *clean.depths[10:])))
    assert (finding.kind, finding.evidence["frames"]) == ("empty-depth", [9])


def test_clipped_depth_is_named():
    clean = _clean()
    limit = np.quantile(np.concatenate([depth[depth > 0] for depth in clean.depths]), 0.9)
    clipped = tuple(np.minimum(depth, np.float32(limit)) for depth in clean.depths)
    (finding,) = _findings(replace(clean, depths=clipped))
    assert finding.kind == "clipped-depth"
    assert finding.evidence["limit_m"] == pytest.approx(limit, abs=1e-4)


def test_a_wrong_pose_is_told_from_a_cut():
    clean = _clean()
    lost = clean.poses[7].copy()
    lost[:3, 3] += (1.5, 0, 0)
    findings = _findings(replace(clean, poses=(*clean.poses[:7], lost, *clean.poses[8:])))
    (finding,) = findings
    assert (finding.kind, finding.severity) == ("pose-jump", "fault")
    assert finding.evidence["frames"] == [7, 8]


def test_lost_frames_are_noted():
    dataset = _clean().in_memory(None)
    facts = read_frames(dataset, tuple(i for i in range(16) if i not in (5, 6)), lambda: None)
    (finding,) = check_trajectory(facts)
    assert (finding.kind, finding.severity) == ("frame-gaps", "note")
    assert finding.evidence["lost"] == 2


@pytest.mark.parametrize(
    ("change", "word"),
    [({"cx": -20.0}, "principal point"), ({"fy": 200.0}, "twofold"), ({"fx": 3000.0, "fy": 3000.0}, "field of view")],
)
def test_intrinsics_that_can_hardly_be_are_named(change, word):
    camera = PinholeCamera(width=96, height=72, fx=90, fy=90, cx=47.5, cy=35.5)
    assert check_intrinsics(camera) == []
    (finding,) = check_intrinsics(replace(camera, **change))
    assert word in finding.message


def test_the_images_of_a_black_camera_are_noted():
    clean = _clean()
    (finding,) = _findings(replace(clean, colors=(np.zeros_like(clean.colors[0]), *clean.colors[1:])))
    assert (finding.kind, finding.evidence["frames"]) == ("uniform-color", [0])
