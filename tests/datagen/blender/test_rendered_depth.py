"""Depth from Blender against a plane, where the truth is a formula."""

import math

import numpy as np
import pytest

from datagen.camera import PinholeCamera
from datagen.dataset_format import FRAMES_FOLDER, frame_file
from datagen.images import read_color, read_depth

TURN_DEG = 20.0
TILT_DEG = math.degrees(math.asin(math.cos(math.radians(60)) / math.cos(math.radians(TURN_DEG))))
"""About x, so that after the turn about z the plane's normal stands 60 degrees off the view from −y."""


@pytest.fixture
def tilted_plane(open_session, make_scene):
    """A plane through the origin, tilted by 60 degrees against the view, from 2 m away."""
    return open_session(
        make_scene(
            render={"frames": 1, "size": [160, 120], "samples": 4, "seed": 5},
            objects=[
                {"name": "P", "shape": "plane", "material": "red", "scale": 20, "rotation_deg": [TILT_DEG, 0, TURN_DEG]}
            ],
            keyframes=[{"time": 0, "position": [0, -2, 0], "look_at": [0, 0, 0]}],
        )
    )


def plane_depth(camera, world_from_camera):
    """The depth of the plane through the origin, from the camera's model: z = −n·c / n·(R ray)."""
    tilt, turn = math.radians(TILT_DEG), math.radians(TURN_DEG)
    normal = np.array([math.sin(tilt) * math.sin(turn), -math.sin(tilt) * math.cos(turn), math.cos(tilt)])
    rays = camera.back_project(np.ones((camera.height, camera.width))) @ world_from_camera[:3, :3].T
    return -(normal @ world_from_camera[:3, 3]) / (rays @ normal)


def relative_rms(depth, truth):
    return float(np.sqrt(np.mean((depth / truth - 1) ** 2)))


def render(session):
    from datagen.blender.camera import read_intrinsics
    from datagen.blender.render import render_frame

    rendered = render_frame(session.scene, 0, seed=0, scratch=session.scratch)
    return rendered, read_intrinsics(session.scene)


def test_the_plane_is_tilted_by_60_degrees():
    tilt, turn = math.radians(TILT_DEG), math.radians(TURN_DEG)
    assert math.degrees(math.acos(math.sin(tilt) * math.cos(turn))) == pytest.approx(60)


def test_depth_is_the_analytic_planes_and_neither_half_a_pixel_off_nor_a_distance(tilted_plane):
    rendered, camera = render(tilted_plane)
    assert (rendered.depth > 0).all()
    right = relative_rms(rendered.depth, plane_depth(camera, rendered.world_from_camera))
    # The plane is 40 m wide: what is left is single precision's share of that, not of 2 m.
    assert right <= 1e-6

    numbers = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    for axis in ("cx", "cy"):
        shifted = PinholeCamera(**(numbers | {axis: numbers[axis] + 0.5}))
        assert relative_rms(rendered.depth, plane_depth(shifted, rendered.world_from_camera)) > 5e-4, axis

    distance_per_depth = np.linalg.norm(camera.back_project(np.ones((camera.height, camera.width))), axis=-1)
    distance = plane_depth(camera, rendered.world_from_camera) * distance_per_depth
    assert relative_rms(rendered.depth, distance) > 1e-2


def test_the_first_sample_goes_through_the_pixels_centre_and_without_the_shift_it_would_not(tilted_plane):
    from datagen.blender.camera import FIRST_SAMPLE_PX

    data, width = tilted_plane.scene.camera.data, tilted_plane.scene.render.resolution_x
    for shift, bound in ((FIRST_SAMPLE_PX, 3e-6), (-2 * FIRST_SAMPLE_PX, 3e-6)):  # without it, and twice
        data.shift_x += shift / width
        data.shift_y += shift / width
        rendered = render(tilted_plane)[0]
        assert relative_rms(rendered.depth, plane_depth(tilted_plane.camera, rendered.world_from_camera)) > bound


def test_depth_on_disk_is_within_half_a_step(tilted_plane, tmp_path):
    rendered, _ = render(tilted_plane)
    tilted_plane.write_frame(tmp_path, 0)
    path = frame_file(tmp_path / FRAMES_FOLDER, 0, "depth.png")
    read = read_depth(path, size=(160, 120), metres_per_step=0.0001)
    assert np.abs(read.astype(np.float64) - rendered.depth).max() <= 0.00005 + 1e-6


def test_depth_does_not_depend_on_samples_seed_or_denoiser(tilted_plane):
    first, _ = render(tilted_plane)
    tilted_plane.scene.cycles.samples = 1
    tilted_plane.scene.cycles.use_denoising = False
    second, _ = render(tilted_plane)
    np.testing.assert_array_equal(first.depth, second.depth)


def test_the_background_has_no_depth_and_the_colour_that_the_scene_declares(open_session, make_scene):
    session = open_session(make_scene(world={"color": "#4080c0", "strength": 1.0}))
    session.write_frame(session.scratch, 0)
    frames = session.scratch / FRAMES_FOLDER
    depth = read_depth(frame_file(frames, 0, "depth.png"), size=(64, 48), metres_per_step=0.0001)
    color = read_color(frame_file(frames, 0, "color.png"), size=(64, 48))
    assert depth[0, 0] == 0
    assert depth[24, 32] == pytest.approx(np.linalg.norm([-0.5, -2, 0.3]) - 0.4, abs=1e-3)
    np.testing.assert_array_equal(color[0, 0], [0x40, 0x80, 0xC0])
    assert color[24, 32, 0] > 1.5 * color[24, 32, 2]


def test_surfaces_beyond_the_clip_range_are_not_seen(open_session, make_scene):
    session = open_session(make_scene(camera={"clip_end": 1.0}))
    rendered, _ = render(session)
    assert not rendered.depth.any()


@pytest.mark.parametrize("size", [[64, 48], [48, 64], [63, 31]])
def test_intrinsics_are_the_lens_law_with_half_a_pixel_taken_off(open_session, make_scene, size):
    scene = make_scene(
        render={"frames": 1, "size": size, "samples": 1}, camera={"focal_length_mm": 35.0, "sensor_width_mm": 32.0}
    )
    _, camera = render(open_session(scene))
    focal_length_px = 35.0 / 32.0 * size[0]
    np.testing.assert_allclose(
        [camera.fx, camera.fy, camera.cx, camera.cy],
        [focal_length_px, focal_length_px, (size[0] - 1) / 2, (size[1] - 1) / 2],
        rtol=1e-6,
    )


def test_a_device_that_is_not_there_is_refused_and_auto_says_what_renders(open_session, make_scene):
    from datagen.blender.device import GPU_TYPES, select_device
    from datagen.errors import InputError

    session = open_session(make_scene())
    assert session.device.type == "cpu"
    assert select_device(session.scene, "auto").type in ("cpu", *GPU_TYPES)
    with pytest.raises(InputError, match=r"--device metal: .*there are: cpu"):
        select_device(session.scene, "metal")
