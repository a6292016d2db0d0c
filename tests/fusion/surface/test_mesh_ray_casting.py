import numpy as np
import trimesh

from datagen.camera import PinholeCamera
from datagen.rigid import look_at
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CAMERA = PinholeCamera(width=160, height=120, fx=160.0, fy=150.0, cx=77.5, cy=61.0)


def test_rays_go_through_pixel_centres_and_depth_is_planar(device):
    # A plane z = 2.5 before a camera at the origin has depth 2.5 at every pixel, whatever the ray's length.
    plane = Mesh(
        vertices=np.array([[-9, -9, 2.5], [9, -9, 2.5], [9, 9, 2.5], [-9, 9, 2.5]], np.float32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    hits = cast_rays_at_mesh(plane, CAMERA, [np.eye(4)], device=device)
    np.testing.assert_allclose(hits.depth.numpy(), 2.5, rtol=1e-6)
    # Its edge falls where the projection has it, to the pixel.
    half = Mesh(vertices=plane.vertices - np.array([9, 0, 0], np.float32), triangles=plane.triangles)
    seen = cast_rays_at_mesh(half, CAMERA, [np.eye(4)], device=device, depth_only=True).depth.numpy()[0] > 0
    np.testing.assert_array_equal(seen[0], np.arange(CAMERA.width) <= CAMERA.cx)


def test_triangles_and_barycentric_coordinates_name_the_point_that_depth_does(device):
    sphere = trimesh.creation.icosphere(subdivisions=3, radius=0.4)
    mesh = Mesh(vertices=np.asarray(sphere.vertices, np.float32), triangles=np.asarray(sphere.faces, np.int32))
    poses = [look_at((0, -2, 0.3), (0, 0, 0)), look_at((1.5, 0.4, 0), (0.1, 0, 0))]
    hits = cast_rays_at_mesh(mesh, CAMERA, poses, device=device)
    depth, triangles, weights = hits.depth.numpy(), hits.triangles.numpy(), hits.barycentric.numpy()
    assert ((depth > 0) == (triangles >= 0)).all()
    assert 0.05 < (depth > 0).mean() < 0.5
    for view, pose in enumerate(poses):
        hit = triangles[view] >= 0
        points_camera = CAMERA.back_project(depth[view])[hit]
        points_world = points_camera @ pose[:3, :3].T + pose[:3, 3]
        shares = np.column_stack([weights[view][hit], 1 - weights[view][hit].sum(axis=1)])
        named = np.einsum("nk,nkc->nc", shares, mesh.vertices[mesh.triangles[triangles[view][hit]]])
        np.testing.assert_allclose(named, points_world, atol=2e-6)
