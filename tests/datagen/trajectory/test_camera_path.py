import numpy as np
import pytest

from datagen.errors import InputError
from datagen.scene_spec.scene_files import load_scene, with_render_settings
from datagen.scene_spec.trajectory_settings import BlendCameraTrajectory
from datagen.trajectory.camera_path import camera_path, scene_camera_path


def test_keyframes_of_a_scene_file_and_of_its_trajectory_are_the_same_motion(make_scene):
    by_keys = make_scene(render={"frames": 7})
    keys = [key.model_dump(mode="json", exclude_none=True) for key in by_keys.keyframes]
    by_trajectory = make_scene(
        render={"frames": 7}, keyframes=None, trajectory={"type": "keyframes", "keyframes": keys}
    )
    np.testing.assert_array_equal(scene_camera_path(by_keys), scene_camera_path(by_trajectory))


def test_a_scene_s_render_settings_make_its_path(make_scene):
    shell = {"type": "shell", "radius": [1, 2]}
    scene = make_scene(keyframes=None, trajectory=shell)
    seeded = with_render_settings(scene, seed=1, frames=5)
    assert scene_camera_path(seeded).shape == (5, 4, 4)
    assert not np.isclose(scene_camera_path(seeded)[:3], scene_camera_path(scene)).all()
    np.testing.assert_array_equal(scene_camera_path(seeded), camera_path(seeded.trajectory, 5, 30.0, 1))


def test_a_scene_moves_its_camera_in_exactly_one_way(make_scene):
    with pytest.raises(ValueError, match="keyframes: missing; give keyframes or a trajectory"):
        make_scene(keyframes=None)
    with pytest.raises(ValueError, match="give keyframes or a trajectory, not both"):
        make_scene(trajectory={"type": "orbit", "radius": 1})


def test_the_camera_of_a_blend_is_left_to_blender():
    with pytest.raises(InputError, match="moves in Blender alone"):
        camera_path(BlendCameraTrajectory(type="blend-camera"), 3, 30.0, 0)


def test_the_shipped_scene_moves_upright_around_its_subject():
    path = scene_camera_path(with_render_settings(load_scene("suzanne"), frames=500))
    assert path.shape == (500, 4, 4)
    assert (path[:, 2, 1] < 0).all()
