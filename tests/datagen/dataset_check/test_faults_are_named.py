"""The law of the whole check: each fault is named, alone, and nothing is named where nothing is wrong.

The same with 200 recordings of each kind: benchmarks/validate.py.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from ray_cast_recordings import CORRUPTIONS, Recording, record, with_sensor_noise

from datagen.dataset_check.check import check_dataset
from datagen.rigid import look_at

SEEDS = range(5)


@lru_cache(maxsize=len(SEEDS))
def _clean(seed: int) -> Recording:
    return record(seed, frames=18, size=(112, 84))


@pytest.fixture(scope="session")
def mesh_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")

    def file_of(seed):
        path = folder / f"{seed}.ply"
        if not path.exists():
            _clean(seed).mesh.export(path)
        return path

    return file_of


def _faults(recording, mesh=None):
    report = check_dataset(recording.in_memory(mesh))
    return [finding for finding in report.findings if finding.severity == "fault"], report


def _mesh(seed, mesh_files):
    return mesh_files(seed) if seed % 2 else None  # without the mesh, frames have only each other


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("kind", CORRUPTIONS)
def test_a_fault_is_named_and_no_other(kind, seed, mesh_files):
    corrupted, size = CORRUPTIONS[kind](_clean(seed), np.random.default_rng([seed, 11]))
    faults, _ = _faults(corrupted, _mesh(seed, mesh_files))
    assert [fault.kind for fault in faults] == [kind], size


@pytest.mark.parametrize("seed", SEEDS)
def test_a_clean_recording_has_no_fault(seed, mesh_files):
    faults, _ = _faults(_clean(seed), _mesh(seed, mesh_files))
    assert faults == []


@pytest.mark.parametrize("seed", SEEDS)
def test_a_depth_cameras_noise_is_no_fault(seed, mesh_files):
    noisy = with_sensor_noise(_clean(seed), np.random.default_rng(seed))
    faults, _ = _faults(noisy, _mesh(seed, mesh_files))
    assert faults == []


def test_sizes_are_measured():
    clean = _clean(0)
    camera = clean.camera
    (shifted,), _ = _faults(replace(clean, camera=replace(camera, cx=camera.cx + 0.5, cy=camera.cy - 0.5)))
    np.testing.assert_allclose(shifted.evidence["shift_px"], (-0.5, 0.5), atol=0.02)
    (scaled,), _ = _faults(replace(clean, depth_scale=clean.depth_scale * 1.015))
    assert scaled.evidence["depth_factor"] == pytest.approx(1 / 1.015, abs=1e-3)
    (zoomed,), _ = _faults(replace(clean, camera=replace(camera, fy=camera.fy * 1.04)))
    assert zoomed.evidence["fx_factor"] == 1
    assert zoomed.evidence["fy_factor"] == pytest.approx(1 / 1.04, abs=1e-3)


def test_two_faults_are_both_named():
    clean = _clean(1)
    poses = tuple(pose @ np.diag([1.0, -1, -1, 1]) for pose in clean.poses)
    camera = replace(clean.camera, cx=clean.camera.cx + 0.5, cy=clean.camera.cy + 0.5)
    faults, _ = _faults(replace(clean, poses=poses, camera=camera))
    assert {fault.kind for fault in faults} == {"flipped-axis", "half-pixel"}


def test_the_evidence_says_by_how_much_frames_disagree_before_and_after(mesh_files):
    corrupted, _ = CORRUPTIONS["ray-distance"](_clean(1), np.random.default_rng(0))
    (fault,), _ = _faults(corrupted, mesh_files(1))
    for evidence in (fault.evidence["frames"], fault.evidence["mesh"]):
        assert evidence["after"]["median_m"] < 0.01 * evidence["before"]["median_m"]
    assert "after the correction" in fault.message


def _shuffled(clean):
    order = np.random.default_rng(0).permutation(len(clean.poses))
    return replace(clean, poses=tuple(clean.poses[i] for i in order))


def test_frames_that_no_fault_explains_are_called_inconsistent():
    faults, _ = _faults(_shuffled(_clean(0)))
    assert [fault.kind for fault in faults] == ["inconsistent-geometry"]


def test_a_mesh_in_other_axes_is_told_from_wrong_poses(tmp_path):
    clean = _clean(1)
    path = tmp_path / "mesh.ply"
    turned = clean.mesh.copy()
    turned.apply_transform([[1, 0, 0, 0.3], [0, 0, -1, 0], [0, 1, 0, 0.2], [0, 0, 0, 1]])
    turned.export(path)
    faults, _ = _faults(clean, path)
    assert [fault.kind for fault in faults] == ["mesh-mismatch"]


def test_a_wall_seen_straight_on_cannot_tell():
    """From frames that slide along a plane nothing but flips could be known: nothing is claimed, and that is said."""
    clean = _clean(1)
    depth = np.full(clean.depths[0].shape, 2.0, np.float32)
    poses = tuple(look_at((0.05 * i, 0, 0.02 * np.sin(i)), (0.05 * i, 2, 0.02 * np.sin(i))) for i in range(18))
    faults, report = _faults(replace(clean, depths=(depth,) * 18, poses=poses))
    assert faults == []
    unsure = {
        kind for finding in report.findings if finding.kind == "cannot-tell" for kind in finding.evidence["kinds"]
    }
    assert {"half-pixel", "focal-length", "depth-scale", "time-shift", "color-offset"} <= unsure


def test_a_camera_that_stands_still_cannot_tell():
    clean = _clean(1)
    still = replace(clean, poses=(clean.poses[0],) * 6, depths=(clean.depths[0],) * 6, colors=(clean.colors[0],) * 6)
    faults, report = _faults(still)
    assert faults == []
    assert any(finding.kind == "cannot-tell" for finding in report.findings)


@pytest.mark.parametrize("seed", [41, 101, 110])
def test_colour_beside_depth_is_named_where_depth_has_few_edges(seed):
    clean = record(seed)
    corrupted, size = CORRUPTIONS["color-offset"](clean, np.random.default_rng([seed, 11]))
    for recording, kinds in ((clean, []), (corrupted, ["color-offset"])):
        faults, report = _faults(recording)
        assert [fault.kind for fault in faults] == kinds, size
        assert not [finding for finding in report.findings if "color-offset" in finding.evidence.get("kinds", ())]
