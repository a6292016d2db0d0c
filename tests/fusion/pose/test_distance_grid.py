"""Distances of a ball, whole and with a hole, whose inside and outside are known."""

import numpy as np
import pytest
import trimesh

from fusion.pose.distance_grid import distance_grid
from fusion.surface.mesh import Mesh

RADIUS = 0.3


def ball(hole_below=-np.inf):
    """Return a ball's mesh about the origin without the triangles below a height."""
    shape = trimesh.creation.icosphere(5, RADIUS)
    kept = shape.triangles_center[:, 2] > hole_below
    shape.update_faces(kept)
    shape.remove_unreferenced_vertices()
    vertices = np.asarray(shape.vertices, np.float32)
    return Mesh(vertices=vertices, triangles=np.asarray(shape.faces, np.int32), normals=vertices / np.float32(RADIUS))


def nodes_of(grid):
    shape = grid.distances.shape
    return grid.origin_world + grid.spacing * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1)


def test_distances_are_those_of_the_ball(device):
    mesh = ball()
    grid = distance_grid(mesh, device=device, nodes=48)
    corners = mesh.vertices[mesh.triangles].astype(np.float64)
    middles = corners.mean(axis=1)
    # Triangles lie within the ball by their sagitta; from a vertex no point of them is farther than the gap.
    sagitta = RADIUS - np.linalg.norm(middles, axis=1).min()
    gap = np.linalg.norm(corners - middles[:, None], axis=2).max()
    exact = np.linalg.norm(nodes_of(grid), axis=-1) - RADIUS
    sides, distances = np.sign(exact), np.abs(grid.distances.numpy())
    near = np.abs(exact) < grid.spacing - gap
    assert near.sum() > 1000
    assert (np.sign(grid.distances.numpy())[np.abs(exact) > sagitta] == sides[np.abs(exact) > sagitta]).all()
    np.testing.assert_allclose(distances[near], np.abs(exact[near]), atol=sagitta + 1e-6)
    # Farther out it is the distance to a point of the ball, and never too small.
    assert (distances > np.abs(exact) - sagitta - 1e-6).all()
    assert (distances < np.abs(exact) + gap + 2 * 3**0.5 * grid.spacing).all()
    # Half a cell's diagonal is what the nearest node is off by where nothing is known of the surface in the cell.
    assert np.sqrt(np.mean((distances - np.abs(exact)) ** 2)) < np.sqrt(3) / 2 * grid.spacing


@pytest.mark.parametrize("hole_below", [-0.25, -0.2])
def test_a_hole_does_not_turn_the_inside_out(device, hole_below):
    # As of an object that stood on something: its bottom was never seen, and its inside is one region with the outside.
    grid = distance_grid(ball(hole_below), device=device, nodes=48)
    nodes, distances = nodes_of(grid), grid.distances.numpy()
    reach = np.linalg.norm(nodes, axis=-1)
    inside = (reach < RADIUS - 3 * grid.spacing) & (nodes[..., 2] > -0.1)
    outside = (reach > RADIUS + 3 * grid.spacing) & (nodes[..., 2] > -0.1)
    assert (distances[inside] < 0).all()
    assert (distances[outside] > 0).all()


def test_one_wrong_normal_throws_no_wedge(device):
    mesh = ball()
    assert mesh.normals is not None
    normals = mesh.normals.copy()
    normals[np.argsort(np.linalg.norm(mesh.vertices - (0, 0, RADIUS), axis=1))[:30]] *= -1
    turned = Mesh(vertices=mesh.vertices, triangles=mesh.triangles, normals=normals)
    grid = distance_grid(turned, device=device, nodes=48)
    reach = np.linalg.norm(nodes_of(grid), axis=-1)
    assert (grid.distances.numpy()[reach > RADIUS + 4 * grid.spacing] > 0).all()
    assert (grid.distances.numpy()[reach < RADIUS - 4 * grid.spacing] < 0).all()
