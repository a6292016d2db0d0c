import re

import numpy as np
import pytest
import trimesh
from three_balls import CAMERA, OFFSET, POSES, ball_model, see

from datagen.rigid import inverse, look_at
from fusion.pose.ambiguity import AS_GOOD, Ambiguity, find_ambiguity
from fusion.pose.comparison import comparison
from fusion.pose.confidence import Confidence, assess
from fusion.pose.depth_refinement import refine_with_depth
from fusion.pose.depth_uncertainty import depth_uncertainty
from fusion.pose.evidence import Evidence
from fusion.pose.pose_model import prepare_model
from fusion.pose.query import Query
from fusion.pose.se3 import exp_se3, perturb
from fusion.pose.shape_volume import volume_from_mesh
from fusion.pose.uncertainty import uncertainty
from fusion.pose.verdict import Verdict
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

VOXEL = 0.004


def model_and_view(shape, eye, device):
    mesh = Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))
    model = prepare_model(volume_from_mesh(mesh, voxel_size=VOXEL, device=device))
    pose = look_at(eye, (0, 0, 0))
    depth = cast_rays_at_mesh(mesh, CAMERA, [pose], device=device, depth_only=True).depth.numpy()[0]
    return model, Query(camera=CAMERA, depth=depth, mask=depth > 0), pose


def ambiguity(model, query, pose):
    return find_ambiguity(model, query, pose, depth_uncertainty(model, query, pose))


def mug():
    """A pot with a handle: a body of revolution about z, but for the handle on the side of x."""
    handle = trimesh.creation.box((0.08, 0.03, 0.1), trimesh.transformations.translation_matrix((0.13, 0, 0.03)))
    return trimesh.util.concatenate([trimesh.creation.cylinder(0.1, 0.2, sections=96), handle])


def test_three_balls_of_three_sizes_fit_in_one_way(device):
    query = Query(camera=CAMERA, depth=see(POSES[0]))
    found = ambiguity(ball_model(device), query, POSES[0])
    assert found.alternatives == ()
    assert found.weak == ()
    assert OFFSET.shape == (3,)


def test_a_pot_whose_handle_is_hidden_can_turn_about_its_axis(device):
    model, query, pose = model_and_view(mug(), (-0.7, 0, 0.4), device)
    found = ambiguity(model, query, pose)
    assert any("turning about the model's z, from -" in name for name in found.weak)
    told = assess(model, query, [refine_with_depth(model, query, pose)])
    assert any(reason.startswith("not fixed: turning about the model's z, from -") for reason in told.verdict.reasons)


def test_a_pot_whose_handle_is_seen_cannot(device):
    model, query, pose = model_and_view(mug(), (0.35, -0.65, 0.4), device)
    found = ambiguity(model, query, pose)
    assert not any("the model's z" in name for name in found.weak)
    assert found.alternatives == ()
    assert assess(model, query, [refine_with_depth(model, query, pose)]).verdict.answer == "found"


def test_a_box_looks_alike_from_four_sides_and_means_the_same(device):
    model, query, pose = model_and_view(trimesh.creation.box((0.3, 0.2, 0.1)), (0.5, -0.6, 0.4), device)
    found = ambiguity(model, query, pose)
    turns = {tuple(np.abs(np.round(one.axis)).astype(int)) for one in found.alternatives}
    assert turns == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}
    assert all(one.turn_deg == pytest.approx(180, abs=2) and one.symmetric for one in found.alternatives)
    told = assess(model, query, [refine_with_depth(model, query, pose)])
    assert told.verdict.answer == "found"
    assert "the model is symmetric: 3 other poses mean the same" in told.verdict.reasons


BEHIND = (0.8 * np.cos(np.radians(205)), 0.8 * np.sin(np.radians(205)), 0.1)
"""From here the mug's handle is 25° off the line right behind the pot. A ray that grazes the pot passes behind it where
the handle's tip is at some 38°: turned right-handed about z it stays hidden for 63°, the other way for 13°."""


def test_the_model_beside_what_the_view_shows_speaks_against_a_pose_and_behind_it_does_not(device):
    model, query, pose = model_and_view(mug(), BEHIND, device)
    for view in (query, Query(camera=CAMERA, depth=query.depth), Query(camera=CAMERA, mask=query.mask)):
        # As the camera turns about the pot one way, the pot turns the other way.
        twists = np.radians([[0, 0, 0, 0, 0, turn] for turn in (0, -50, 30)])
        there, hidden, in_sight = comparison(model, view, pose).costs(perturb(twists, pose, pivot_world=np.zeros(3)))
        assert hidden < there + AS_GOOD
        assert in_sight > there + AS_GOOD


def test_a_hidden_handle_lets_the_pot_turn_farther_the_way_that_keeps_it_hidden(device):
    model, query, pose = model_and_view(mug(), BEHIND, device)
    told = [name for name in ambiguity(model, query, pose).weak if "the model's z" in name]
    low, high = (float(number) for number in re.search(r"from (-?\d+)° to \+(\d+)°", told[0]).groups())
    assert high > -low
    assert low > -26  # steps are doubled, and 13° are hidden


def test_an_alternative_is_the_pose_found_with_the_model_turned_as_it_says(device):
    model, query, pose = model_and_view(trimesh.creation.box((0.2, 0.2, 0.12)), (0.5, -0.6, 0.4), device)
    found = ambiguity(model, query, pose).alternatives
    assert {round(one.turn_deg / 10) for one in found if abs(one.axis[2]) > 0.99} == {9, 18, 27}
    for one in found:
        turned = exp_se3(np.concatenate([np.zeros(3), np.radians(one.turn_deg) * one.axis]))
        # To the camera the model, turned in its own frame, then placed by the pose found.
        np.testing.assert_allclose(inverse(one.world_from_camera)[:3, :3], (inverse(pose) @ turned)[:3, :3], atol=1e-6)


def test_a_direction_that_can_be_moved_along_is_named_once():
    jacobian = np.eye(6)[[3, 4, 5]]
    known = uncertainty(jacobian.T @ jacobian, sigma=1e-3, pivot_world=np.zeros(3), radius_m=0.1)
    assert len(known.weak) == 3
    far = f"{known.weak[0]}, from -3 to +4 mm"
    confidence = Confidence(
        verdict=Verdict("found"), evidence=Evidence(), uncertainty=known, ambiguity=Ambiguity(weak=(far,))
    )
    assert confidence.weak == (far, *known.weak[1:])
