import numpy as np
import pytest

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, look_at, transform_points
from datagen.trajectory.path_faults import Box, Fault, default_subjects, describe_faults, part_in_view, view_faults

CAMERA = PinholeCamera(width=100, height=80, fx=100.0, fy=100.0, cx=49.5, cy=39.5)
CLIP = (0.1, 50.0)


def box(name, center, size):
    world_from_unit = np.diag([*size, 1.0])
    world_from_unit[:3, 3] = np.subtract(center, np.array(size) / 2)
    return Box(name=name, world_from_unit=world_from_unit)


def views(*targets, position=(0.0, -3.0, 0.0)):
    return np.stack([look_at(position, target) for target in targets])


def test_all_of_a_box_in_the_image_is_in_view_and_nothing_of_one_behind_the_camera():
    path = views((0, 0, 0), (0, -9, 0), (5, -3, 0))
    np.testing.assert_array_equal(part_in_view(box("cube", (0, 0, 0), (1, 1, 1)), path, CAMERA, CLIP), [1, 0, 0])


def test_a_thin_box_across_the_image_is_in_view_as_far_as_the_image_reaches():
    """A rod along x at distance 3: the image spans x from −1.5 to 1.5, of the rod's 5 points at −4 … 4 one is in it."""
    rod = box("rod", (0, 0, 0), (8, 1e-9, 1e-9))
    assert part_in_view(rod, views((0, 0, 0)), CAMERA, CLIP) == pytest.approx(1 / 5)
    # At 2.999 a point at x = 1.5 has just left the image, at 3.001 it has come in.
    rod = box("rod", (0, 0, 0), (6, 1e-9, 1e-9))
    for distance, part in ((2.999, 1 / 5), (3.001, 3 / 5)):
        path = views((0, 0, 0), position=(0.0, -distance, 0.0))
        assert part_in_view(rod, path, CAMERA, CLIP) == pytest.approx(part)


def test_random_boxes_are_in_view_as_their_points_are_one_by_one():
    random = np.random.default_rng(0)
    path = np.stack([look_at(random.uniform(-3, 3, 3), random.uniform(-3, 3, 3)) for _ in range(40)])
    parts = []
    for _ in range(20):
        world_from_unit = np.eye(4)
        world_from_unit[:3] = random.normal(size=(3, 4)) * (0.5, 0.5, 0.5, 2)
        tilted = Box(name="tilted", world_from_unit=world_from_unit)
        found = part_in_view(tilted, path, CAMERA, CLIP)
        for part, world_from_camera in zip(found, path, strict=True):
            points = transform_points(inverse(world_from_camera), tilted.points_world)
            points = points[(points[:, 2] > CLIP[0]) & (points[:, 2] < CLIP[1])]
            u, v = CAMERA.project(points).T
            assert part == np.count_nonzero((np.abs(u - 49.5) <= 50) & (np.abs(v - 39.5) <= 40)) / 125
        np.testing.assert_allclose(
            tilted.range_world, [tilted.points_world.min(axis=0), tilted.points_world.max(axis=0)], atol=1e-12
        )
        parts += found.tolist()
    assert np.count_nonzero(parts) > 100
    assert np.count_nonzero(np.equal(parts, 0)) > 100


def test_beyond_the_clip_range_nothing_is_in_view():
    cube = box("cube", (0, 0, 0), (1, 1, 1))
    for clip_range in ((4.0, 50.0), (0.1, 2.0)):
        assert part_in_view(cube, views((0, 0, 0)), CAMERA, clip_range) == 0


def test_what_the_camera_moves_above_or_inside_is_no_subject_by_itself():
    floor, room = box("floor", (0, 0, 0), (10, 10, 0)), box("room", (0, 0, 2), (12, 12, 8))
    table, lamp = box("table", (0, 0, 0.5), (1, 1, 1)), box("lamp", (3, 3, 1), (0.1, 0.1, 2))
    circle = np.stack([look_at((2 * np.cos(a), 2 * np.sin(a), 1.5), (0, 0, 0.5)) for a in np.linspace(0, 6, 30)])
    assert default_subjects([floor, room, table, lamp], circle) == (table, lamp)


def test_frames_out_of_view_are_named_for_each_named_subject_or_for_all_together():
    near, far = box("near", (0, 0, 0), (1, 1, 1)), box("far", (40, 0, 0), (1, 1, 1))
    path = views((0, 0, 0), (0, -9, 0), (0, 0, 0), (40, 0, 0))

    def faults(**more):
        found = view_faults([near, far], path, CAMERA, CLIP, **more)
        return {fault.what.removeprefix("0% of ").split(" is in view")[0]: fault.frames for fault in found}

    assert faults(subject=(), min_in_view=0.1) == {"any of 'far', 'near'": (1,)}
    assert faults(subject=("near",), min_in_view=0.1) == {"'near'": (1, 3)}
    assert faults(subject=("near", "far"), min_in_view=0.1) == {"'near'": (1, 3), "'far'": (0, 1, 2)}
    assert faults(subject=("near",), min_in_view=0.0) == {}


def test_copies_of_a_subject_count_together():
    left, right = box("tree", (0, 0, 0), (1, 1, 1)), box("tree", (40, 0, 0), (1, 1, 1))
    path = views((0, 0, 0), (40, 0, 0))
    assert view_faults([left, right], path, CAMERA, CLIP, subject=("tree",), min_in_view=0.5) == []


def test_many_faults_make_a_short_message():
    faults = [Fault(frames=(i, i + 1), what=f"fault {i}") for i in range(20)]
    message = describe_faults(faults)
    assert "frames 7–8: fault 7; and 12 faults more" in message
    assert "fault 8" not in message
