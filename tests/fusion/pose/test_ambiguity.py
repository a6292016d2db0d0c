import numpy as np
import pytest
import trimesh
from three_balls import CAMERA, OFFSET, POSES, ball_model, see

from datagen.rigid import look_at
from fusion.pose.ambiguity import find_ambiguity
from fusion.pose.confidence import assess
from fusion.pose.depth_refinement import refine_with_depth
from fusion.pose.depth_uncertainty import depth_uncertainty
from fusion.pose.pose_model import prepare_model
from fusion.pose.query import Query
from fusion.pose.shape_volume import volume_from_mesh
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
