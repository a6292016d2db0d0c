"""Where rays come nearest to a mesh, against closed forms."""

import numpy as np
import pytest
import trimesh
import warp as wp

from datagen.rigid import look_at
from fusion.pose.nearest_approach import closest_passing

wp.set_module_options({"enable_backward": False})

SIZE, FOCAL = 80, 240.0
LEFT_PX = 0.05
"""To a twentieth of a pixel silhouettes are to know their edge."""
ENOUGH = 1e-4
"""Of the slope's square, over the depth: 0.001 pixels, of a body with a radius of 0.1 m."""


@wp.kernel
def _hit(mesh: wp.uint64, eye: wp.vec3, rays: wp.array(dtype=wp.vec3), hits: wp.array(dtype=float)):
    index = wp.tid()
    length = wp.length(rays[index])
    hit = wp.mesh_query_ray(mesh, eye, rays[index] / length, 1.0e6)
    hits[index] = wp.where(hit.result, hit.t / length, 0.0)


@wp.kernel
def _pass_by(
    mesh: wp.uint64,
    eye: wp.vec3,
    rays: wp.array(dtype=wp.vec3),
    starts: wp.array(dtype=wp.vec3),
    passings: wp.array(dtype=wp.vec2),
    feet: wp.array(dtype=wp.vec3),
):
    index = wp.tid()
    passing = closest_passing(mesh, eye, rays[index], starts[index], ENOUGH)
    passings[index] = wp.vec2(passing.t, passing.distance)
    feet[index] = passing.foot


def passings_beside(shape, eye, device):
    """Return the rays (n, 3) of the pixels beside a shape, their times and distances, and the feet."""
    corners = wp.array(np.asarray(shape.vertices, np.float32), dtype=wp.vec3, device=device)
    mesh = wp.Mesh(points=corners, indices=wp.array(shape.faces.ravel().astype(np.int32), dtype=int, device=device))
    v, u = np.mgrid[:SIZE, :SIZE] - (SIZE - 1) / 2
    rays = np.stack([u / FOCAL, v / FOCAL, np.ones_like(u)], axis=-1) @ look_at(eye, (0, 0, 0))[:3, :3].T
    hits = wp.zeros(SIZE * SIZE, dtype=float, device=device)
    held = wp.array(rays.reshape(-1, 3).astype(np.float32), dtype=wp.vec3, device=device)
    wp.launch(_hit, dim=SIZE * SIZE, inputs=[mesh.id, wp.vec3(*eye), held], outputs=[hits], device=device)
    hit = np.pad(hits.numpy().reshape(SIZE, SIZE), 1)
    pixels, starts = [], []
    for row, column in np.argwhere(hit[1:-1, 1:-1] == 0):
        around = hit[row : row + 3, column : column + 3]
        if (around > 0).any():
            there = np.unravel_index(np.where(around > 0, around, np.inf).argmin(), (3, 3))
            pixels.append(rays[row, column])
            starts.append(eye + around[there] * rays[row + there[0] - 1, column + there[1] - 1])
    inputs = [wp.array(np.array(some, np.float32), dtype=wp.vec3, device=device) for some in (pixels, starts)]
    passings, feet = (wp.zeros(len(pixels), dtype=kind, device=device) for kind in (wp.vec2, wp.vec3))
    wp.launch(
        _pass_by, dim=len(pixels), inputs=[mesh.id, wp.vec3(*eye), *inputs], outputs=[passings, feet], device=device
    )
    return np.array(pixels), passings.numpy(), feet.numpy()


def distances_from_edges(eye, rays, edges):
    """Return the least distance (n,) of rays' lines from any of the edges (m, 2, 3)."""
    offset = np.cross(edges[:, 0] - eye, rays[:, None])
    along = np.cross(edges[:, 1] - edges[:, 0], rays[:, None])
    share = np.clip(-(offset * along).sum(axis=-1) / (along**2).sum(axis=-1), 0, 1)[..., None]
    return (np.linalg.norm(offset + share * along, axis=-1) / np.linalg.norm(rays, axis=-1)[:, None]).min(axis=1)


def assert_right(expected, passings):
    assert len(passings) > 100
    times, distances = passings.T
    off_px = FOCAL * (distances - expected) / times
    assert np.abs(off_px).max() < LEFT_PX
    assert (distances > 0).all()


@pytest.mark.parametrize("eye", [(0.0, 0.3, -0.8), (2.0, -0.4, 0.5)])
def test_rays_beside_a_ball_are_as_far_from_it_as_from_its_centre_less_the_radius(device, eye):
    radius = 0.1 * np.linalg.norm(eye)
    shape = trimesh.creation.icosphere(subdivisions=6, radius=radius)
    rays, passings, feet = passings_beside(shape, eye, device)
    to_centre = np.linalg.norm(np.cross(eye, rays), axis=1) / np.linalg.norm(rays, axis=1)
    assert_right(to_centre - radius, passings)
    np.testing.assert_allclose(np.linalg.norm(feet, axis=1), radius, rtol=1e-4)


@pytest.mark.parametrize("eye", [(0.5, 0.3, -0.6), (0.05, 0.9, 0.02)])
def test_rays_beside_a_box_are_nearest_to_its_sharp_edges(device, eye):
    shape = trimesh.creation.box((0.2, 0.1, 0.15))
    rays, passings, _ = passings_beside(shape, eye, device)
    edges = shape.vertices[
        [edge for edge in shape.edges_unique if np.ptp(shape.vertices[edge], axis=0).astype(bool).sum() == 1]
    ]
    assert len(edges) == 12
    assert_right(distances_from_edges(eye, rays, edges), passings)


def test_rays_beside_a_plate_are_nearest_to_its_border(device):
    eye = (0.5, 0.3, -0.6)
    corners = np.array([[-0.1, -0.1, 0], [0.1, -0.1, 0], [0.1, 0.1, 0], [-0.1, 0.1, 0]])
    shape = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)
    rays, passings, _ = passings_beside(shape, eye, device)
    edges = np.stack([corners, np.roll(corners, 1, axis=0)], axis=1)
    assert_right(distances_from_edges(eye, rays, edges), passings)
