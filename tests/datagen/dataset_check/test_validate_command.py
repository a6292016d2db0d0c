import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from ray_cast_recordings import inverse_pose, record

from datagen.cli import main

KITCHEN = Path(__file__).parents[4] / "shared" / "data" / "7scenes_redkitchen"


@lru_cache(maxsize=1)
def _clean():
    return record(1, frames=20, size=(96, 72))


def test_a_clean_dataset_leaves_with_0_and_says_so(tmp_path, capsys):
    _clean().write(tmp_path, with_mesh=True)
    assert main(["validate", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "no faults" in printed
    assert "against the true mesh" in printed


def test_a_fault_leaves_with_1_and_is_named_with_its_remedy(tmp_path, capsys):
    corrupted, _ = inverse_pose(_clean(), np.random.default_rng(0))
    corrupted.write(tmp_path, with_mesh=False)
    assert main(["validate", str(tmp_path)]) == 1
    printed = capsys.readouterr().out
    assert "fault: inverse-pose" in printed
    assert "Invert every pose" in printed


def test_json_is_all_that_is_printed_and_holds_the_same(tmp_path, capsys):
    clean = _clean()
    replace(clean, depth_scale=clean.depth_scale * 1.1).write(tmp_path, with_mesh=False)
    assert main(["validate", str(tmp_path), "--json"]) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "faults"
    (finding,) = [each for each in report["findings"] if each["severity"] == "fault"]
    assert finding["kind"] == "depth-scale"
    assert finding["evidence"]["depth_factor"] == pytest.approx(1 / 1.1, rel=1e-3)


def test_frames_are_chosen_by_a_slice(tmp_path, capsys):
    _clean().write(tmp_path, with_mesh=False)
    assert main(["validate", str(tmp_path), "--frames", "::2", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["basis"]["frames_read"] == 10


def test_what_is_no_dataset_leaves_with_2(tmp_path, capsys):
    assert main(["validate", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the frames of 7-Scenes' RedKitchen are not here")
def test_the_real_kitchen_has_colour_of_another_lens_and_no_fault(capsys):
    assert main(["validate", str(KITCHEN), "--frames", "::8", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    (offset,) = [finding for finding in report["findings"] if finding["kind"] == "color-offset"]
    assert offset["severity"] == "note"
    # The colour camera's focal length is some 525 px, the depth camera's 585.
    assert offset["evidence"]["zoom"] == pytest.approx(525 / 585, abs=0.021)
    assert -12 < offset["evidence"]["offset_px"][0] < -5
