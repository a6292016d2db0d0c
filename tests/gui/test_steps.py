"""The four steps in Blender's interface, and how alive it stays meanwhile."""

import math

import pytest

STALL_MS = 50.0
"""The longest that the extension may keep Blender's main thread while a job runs, in processor time."""


@pytest.fixture(scope="module")
def seen(desktop):
    return desktop.run("steps_session.py")


@pytest.mark.parametrize("step", ["scan", "fuse", "locate", "compare"])
def test_each_step_goes_through(seen, step):
    state, message = seen[step]["ended"]
    assert state == "done", message


@pytest.mark.parametrize("step", ["scan", "fuse", "locate", "compare"])
def test_the_extension_keeps_the_main_thread_no_longer_than_a_moment(seen, step):
    assert seen[step]["ticks"] > 10
    assert seen[step]["call_processor_ms"] <= STALL_MS, seen[step]["longest_calls"]


def test_the_results_are_in_the_scene_and_on_disk(seen):
    assert {"mesh.ply", "poses.json", "reconstruction.json"} <= set(seen["files"])
    kinds = [kind for _, kind in seen["objects"]]
    assert kinds.count("MESH") == 2  # Suzanne and her reconstruction
    assert kinds.count("CAMERA") > 12  # a camera for each of the twelve frames that were left out, and the scene's


def test_what_the_viewport_shows_is_located_within_a_voxel(seen):
    """It is a view of the reconstruction itself: its true pose is the one that fits best."""
    view = seen["view"]
    assert view["of"] == "ORTHO"
    state, message = view["ended"]
    assert state == "done", message
    (found,) = view["poses"]
    assert message == f"Nearest to this view is frame {found['nearest']} (found)"
    located = [row[3] for row in found["refined"]["world_from_camera"][:3]]
    assert math.dist(view["place"], located) < view["voxel_m"]


def test_looking_through_the_nearest_frame_enters_the_cameras_view(seen):
    assert seen["look"] == ["FINISHED"]
    assert seen["perspective"] == "CAMERA"
    before, after, ranking = seen["stepped"]
    assert [before, after] == ranking


def test_the_original_stands_aside_for_its_reconstruction_and_comes_back_when_asked(seen):
    original, reconstruction = 0, 1
    assert seen["scan"]["sides"] == [True, False]
    for step in ("fuse", "locate", "compare"):
        assert seen[step]["sides"] == [False, True]
    sides = seen["sides"]
    assert sides["ORIGINAL"][original]
    assert not sides["ORIGINAL"][reconstruction]
    assert sides["BOTH"] == sides["UNDONE"] == [True, True]
    assert sides["RECONSTRUCTION"] == [False, True]


def test_the_sidebar_can_be_narrow(seen):
    before, after = seen["width"]
    assert after < 0.8 * before


def test_what_is_refused_is_told_in_words(seen):
    state, message = seen["refused"]
    assert (state, message) == ("failed", "There is no frame 1000; the dataset's are 0 to 23")
