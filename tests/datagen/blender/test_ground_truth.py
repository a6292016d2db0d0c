import numpy as np
import pytest
import trimesh


def test_the_mesh_holds_every_object_in_the_world_with_its_modifiers(open_session, make_scene, tmp_path):
    session = open_session(
        make_scene(
            objects=[
                {"name": "A", "shape": "cube", "material": "red", "scale": 0.5, "location": [3, 0, 0]},
                {"name": "B", "shape": "sphere", "material": "red", "scale": [1, 2, 1], "rotation_deg": [0, 0, 90]},
                {"name": "C", "shape": "suzanne", "material": "red", "subdivision": 1, "location": [0, 0, 5]},
            ]
        )
    )
    session.write_ground_truth(tmp_path)
    mesh = trimesh.load(tmp_path / "ground_truth" / "mesh.ply")
    middles = mesh.triangles_center
    cube = mesh.submesh([middles[:, 0] > 2.4], append=True, repair=False)
    ball = mesh.submesh([(middles[:, 0] < 2.4) & (middles[:, 2] < 3)], append=True, repair=False)
    np.testing.assert_allclose(cube.bounds, [[2.5, -0.5, -0.5], [3.5, 0.5, 0.5]], atol=1e-6)
    np.testing.assert_allclose(ball.bounds, [[-2, -1, -1], [2, 1, 1]], atol=0.01)
    assert ball.volume == pytest.approx(4 / 3 * np.pi * 2, rel=2e-3)  # positive: the triangles face outwards
    assert mesh.vertices[:, 2].max() > 5.5


def test_rendered_depth_lies_on_the_ground_truth(open_session, make_scene, tmp_path):
    from datagen.blender.camera import read_intrinsics
    from datagen.blender.render import render_frame
    from datagen.rigid import transform_points

    suzanne = {"name": "S", "shape": "suzanne", "material": "red", "scale": 0.3, "subdivision": 2, "smooth": True}
    session = open_session(make_scene(objects=[suzanne]))
    session.write_ground_truth(tmp_path)
    mesh = trimesh.load(tmp_path / "ground_truth" / "mesh.ply")
    rendered = render_frame(session.scene, 1, seed=0, scratch=session.scratch)
    seen = rendered.depth > 0
    points_camera = read_intrinsics(session.scene).back_project(rendered.depth)[seen]
    points_world = transform_points(rendered.world_from_camera, points_camera)
    corners = mesh.triangles
    # Cycles samples within a thousandth of a pixel of its centre, and a pixel covers 23 mm here. Brute force needs no
    # search structure.
    assert len(points_world) > 100
    for point in points_world[::17]:
        nearest = trimesh.triangles.closest_point(corners, np.repeat(point[None], len(corners), axis=0))
        assert np.linalg.norm(nearest - point, axis=1).min() < 0.002 * 0.023
