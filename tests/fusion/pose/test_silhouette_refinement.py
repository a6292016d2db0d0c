from functools import lru_cache

import cv2
import numpy as np
import pytest
from boxes import POSES, VOXEL, box_model, see_boxes
from scipy.ndimage import gaussian_filter
from three_balls import CAMERA, twist

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import inverse, rotation_angle_deg
from fusion.devices import resolve_device
from fusion.pose.query import Query
from fusion.pose.reference_frame import ReferenceFrame
from fusion.pose.se3 import perturb
from fusion.pose.silhouette_refinement import (
    SilhouetteRefinementOptions,
    refine_with_silhouette,
)
from fusion.pose.silhouette_target import silhouette_from_depth
from fusion.pose.soft_silhouette import SilhouetteRenderer


@lru_cache(maxsize=2)
def _box(device_name):
    return box_model(resolve_device(device_name))


@pytest.fixture
def model(device):
    return _box(device.alias)


MIDDLE = np.zeros(3)


def errors(found, truth):
    """Return the angle, degrees, and how far the model's middle is off, metres."""
    return rotation_angle_deg(inverse(found) @ truth), np.linalg.norm((found @ inverse(truth))[:3, 3])


def all_pixels():
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([u.ravel(), v.ravel()], axis=-1).astype(float)


def renderer(model, softness_px=1.0, poses=1):
    return SilhouetteRenderer(model, CAMERA, all_pixels(), softness_px=softness_px, pivot_world=MIDDLE, poses=poses)


def test_the_silhouette_is_sharp_at_the_outline_and_as_far_from_it_as_pixels_are(model):
    views = renderer(model)
    for pose in POSES:
        seen = views.render(pose[None], with_jacobian=False)
        inside = see_boxes(pose, model.device) > 0
        edge = seen.edge_px.reshape(inside.shape)
        # A pixel is inside where its centre's ray meets the shape. Interpolation rounds a right edge by at most a
        # quarter of a voxel along each axis, across it 0.35 voxels: 0.2 px of the nearest parts, 0.6 m away.
        rounded_px = 0.35 * VOXEL * CAMERA.fx / 0.6
        wrong = (edge < 0) != inside
        assert edge[wrong & inside].max(initial=0) < rounded_px + 0.05
        # One within is told of by one beside, whose piece of the edge goes on straight for up to a pixel.
        assert -edge[wrong & ~inside].min(initial=0) < 1
        # So of the strip from one pixel within to one without, no larger part can be wrong.
        assert wrong.sum() < rounded_px / 2 * (np.abs(edge) < 1).sum()
        blurred = gaussian_filter(inside.astype(float), 1.0)
        # Whole pixels have the edge wrong by 0.29 px, and coverage changes by 0.4 a pixel; it does so near edges alone.
        near = (blurred > 0.005) & (blurred < 0.995)
        assert np.abs(seen.coverage.reshape(inside.shape) - blurred).mean() < 0.29 * 0.4 * near.mean()


@pytest.mark.parametrize("softness_px", [1.0, 3.0])
def test_the_tapes_gradient_of_the_loss_is_that_of_finite_differences(model, softness_px):
    target = gaussian_filter((see_boxes(POSES[0], model.device) > 0).astype(float), softness_px).ravel()
    pose = perturb(twist(np.random.default_rng(2), 2.0, 0.01), POSES[0], pivot_world=MIDDLE)

    steps = 5e-4 * np.concatenate([np.eye(6), -np.eye(6)])
    seen = renderer(model, softness_px, poses=12).render(perturb(steps, pose, pivot_world=MIDDLE), with_jacobian=False)
    losses = 0.5 * ((seen.coverage - target) ** 2).sum(axis=1)
    numeric = (losses[:6] - losses[6:]) / (2 * 5e-4)
    seen = renderer(model, softness_px).render(pose[None])
    gradient = seen.jacobian[0].T @ (seen.coverage[0] - target)
    # Rays' nearest approaches jump between the field's cells: single differences carry that noise, their sum little.
    length = np.linalg.norm(numeric)
    assert gradient @ numeric / (np.linalg.norm(gradient) * length) > 0.99
    np.testing.assert_allclose(gradient, numeric, atol=0.12 * length)


def test_the_silhouettes_area_and_middle_move_as_those_that_rays_hit(model):
    # Independent of the field and of the tape: exact silhouettes at five times the size, moved to and fro.
    fine = PinholeCamera(width=800, height=600, fx=800.0, fy=800.0, cx=399.5, cy=299.5)
    coarse = fine.subsampled(5)
    v, u = np.mgrid[: coarse.height, : coarse.width].reshape(2, -1)
    pixels = np.stack([u, v], axis=-1).astype(float)
    # Narrow, as at the finer levels: in the fan beyond a corner a piece of the edge tells of its own normal alone.
    seen = SilhouetteRenderer(model, coarse, pixels, softness_px=1.0, pivot_world=MIDDLE).render(POSES[1][None])
    rows, columns = np.mgrid[: fine.height, : fine.width] / 5

    def moments(pose):
        """Return the area and its first moments about the image's middle, in coarse pixels."""
        inside = see_boxes(pose, model.device, fine) > 0
        return np.array([inside.sum(), (columns - 80)[inside].sum(), (rows - 60)[inside].sum()]) / 25

    for axis in range(6):
        size = 0.01 if axis < 3 else 0.04  # metres or radians: two pixels, so that counting whole ones matters little
        step = size * np.eye(6)[axis]
        ahead, back = (moments(perturb(sign * step, POSES[1], pivot_world=MIDDLE)) for sign in (1, -1))
        rays = (ahead - back) / (2 * size)
        tape = np.array([1 + 0 * u, u - 80, v - 60]) @ seen.jacobian[0, :, axis]
        # As shares of all that the edge moves. What a step of Gauss and Newton leaves of an error is as much: of six
        # steps, as a level has, a millionth. In the fan beyond a corner the tape knows less than all of the motion.
        moved = np.array([1, 40, 40]) * np.abs(seen.jacobian[0, :, axis]).sum()
        np.testing.assert_allclose(tape / moved, rays / moved, atol=0.1)


def test_many_poses_are_rendered_as_one_alone_whatever_was_rendered_before(model):
    poses = np.stack(POSES)
    views = renderer(model, poses=len(poses))
    together = [views.render(some) for some in (poses[::-1].copy(), poses)][-1]
    for i, pose in enumerate(poses):
        alone = renderer(model).render(pose[None])
        np.testing.assert_array_equal(together.coverage[i], alone.coverage[0])
        np.testing.assert_array_equal(together.jacobian[i], alone.jacobian[0])


@pytest.mark.parametrize(("turn_deg", "shift"), [(3.0, 0.01), (10.0, 0.04)])
def test_a_mask_alone_locates_the_view(model, turn_deg, shift):
    for i, truth in enumerate(POSES):
        start = perturb(twist(np.random.default_rng(i), turn_deg, shift), truth, pivot_world=MIDDLE)
        found = refine_with_silhouette(model, Query(camera=CAMERA, mask=see_boxes(truth, model.device) > 0), start)
        angle, distance = errors(found.world_from_camera, truth)
        assert angle < 0.5
        # Some 250 whole pixels have the outline, 32 of them from its middle, to 0.29/√250 px: 0.5 mm of depth, and
        # where turning and shifting look alike some times that.
        assert distance < 4e-3
        assert found.overlap > 0.93
        assert found.residual < 0.5


def test_depth_tells_the_silhouette_where_there_is_no_mask(model):
    depth = see_boxes(POSES[0], model.device)
    room = np.where(depth > 0, depth, 2.5).astype(np.float32)
    start = perturb(twist(np.random.default_rng(0), 5.0, 0.02), POSES[0], pivot_world=MIDDLE)
    mask = silhouette_from_depth(model, Query(camera=CAMERA, depth=room), start)
    np.testing.assert_array_equal(mask, depth > 0)
    found = refine_with_silhouette(model, Query(camera=CAMERA, depth=room), start)
    assert errors(found.world_from_camera, POSES[0])[0] < 0.5


def test_an_outline_that_is_partly_hidden_does_not_carry_the_pose_away(model):
    truth = POSES[2]
    mask = see_boxes(truth, model.device) > 0
    columns = np.flatnonzero(mask.any(axis=0))
    mask[:, : columns[len(columns) // 6]] = False
    start = perturb(twist(np.random.default_rng(4), 3.0, 0.008), truth, pivot_world=MIDDLE)
    options = SilhouetteRefinementOptions(starts="one")
    found = refine_with_silhouette(model, Query(camera=CAMERA, mask=mask), start, options=options)
    angle, distance = errors(found.world_from_camera, truth)
    # What is asked of views of which up to 30 % are hidden.
    assert angle < 1
    assert distance < 0.01


def test_the_spread_of_poses_under_wavy_outlines_is_that_of_the_covariance(model):
    truth = POSES[0]
    mask = see_boxes(truth, model.device) > 0
    exact = refine_with_silhouette(model, Query(camera=CAMERA, mask=mask), truth).world_from_camera
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float32)
    squares = []
    for seed in range(20):
        # Displaced by 0.4 pixels, along five pixels of the outline alike: 1.5 √2 pixels of deviation.
        waves = np.random.default_rng(seed).standard_normal((2, *mask.shape))
        waves = np.stack([gaussian_filter(wave, 1.5) for wave in waves])
        waves = (0.4 * waves / waves.std()).astype(np.float32)
        wavy = cv2.remap(mask.astype(np.uint8), u + waves[0], v + waves[1], cv2.INTER_NEAREST) > 0
        found = refine_with_silhouette(model, Query(camera=CAMERA, mask=wavy), truth)
        known = found.uncertainty
        middle = np.eye(4)
        middle[:3, 3] = known.pivot_world
        moved = inverse(middle) @ exact @ inverse(found.world_from_camera) @ middle
        small = np.concatenate([moved[:3, 3], [moved[2, 1], moved[0, 2], moved[1, 0]]])
        squares.append(small @ np.linalg.solve(known.covariance, small))
    # Chi squared with six degrees of freedom has the mean 6. Taken for independent, pixels would make it some 100:
    # a piece of the outline five pixels long, and as many across it, would count as 25. Of a covariance that some 20
    # clusters tell, the mean is 6 · 19/(20 − 6 − 2) (Hotelling 1931), and its own spread over 20 draws is a third.
    assert 3 < np.mean(squares) < 18


def reference(pose, depth):
    color = np.zeros((*depth.shape, 3), np.uint8)
    return ReferenceFrame(camera=CAMERA, color=color, depth=depth, world_from_camera=pose)


def test_what_the_models_outline_is_off_by_is_told_by_a_frame_nearby(device):
    model, truth = box_model(device, grown_by=0.0015), POSES[0]
    query = Query(camera=CAMERA, mask=see_boxes(truth, device) > 0)
    beside = perturb(twist(np.random.default_rng(1), 3.0, 0.01), truth, pivot_world=MIDDLE)
    seen = see_boxes(beside, device)
    alone = refine_with_silhouette(model, query, beside)
    # Larger by 1.5 mm of 0.15 m, and so taken for nearer by 8 mm of 0.8 m, give or take the 4 mm of a right model.
    assert errors(alone.world_from_camera, truth)[1] > 4e-3
    found = refine_with_silhouette(model, query, beside, references=[reference(beside, seen)])
    # As of a right model above, but with two outlines of whole pixels.
    assert errors(found.world_from_camera, truth)[1] < 4e-3 * 2**0.5
    # A frame whose depth ends some pixels within its outline tells of its sensor, and one far away of other outlines.
    frayed = np.where(cv2.erode(seen, np.ones((9, 9), np.uint8)) > 0, seen, 0)
    others = [reference(beside, frayed), reference(POSES[1], see_boxes(POSES[1], device))]
    same = refine_with_silhouette(model, query, beside, references=others)
    np.testing.assert_array_equal(same.world_from_camera, alone.world_from_camera)


def test_without_an_outline_it_declines_with_the_reason(model):
    nothing = Query(camera=CAMERA, mask=np.zeros((120, 160), bool))
    assert "the mask has 0 pixels" in refine_with_silhouette(model, nothing, POSES[0]).reason
    everything = Query(camera=CAMERA, mask=np.ones((120, 160), bool))
    assert "outline is not in the image" in refine_with_silhouette(model, everything, POSES[0]).reason
    neither = refine_with_silhouette(model, Query(camera=CAMERA), POSES[0])
    assert "neither a mask nor a depth" in neither.reason
    assert neither.declined
    np.testing.assert_allclose(neither.world_from_camera, POSES[0], atol=1e-15)


def test_a_start_that_is_not_rigid_is_an_error(model):
    with pytest.raises(InputError, match="not rigid"):
        refine_with_silhouette(model, Query(camera=CAMERA, mask=np.ones((120, 160), bool)), np.diag([2.0, 1, 1, 1]))
