import cv2
import numpy as np
import pytest
import trimesh
from boxes import POSES, boxes, see_boxes
from PIL import Image
from three_balls import CAMERA, sphere_points

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import inverse, look_at, rotation_angle_deg, transform_points
from fusion.pose.cad_model import CadModel, Renderer, check_size, views_around
from fusion.pose.cad_model_file import read_cad_model
from fusion.pose.query import Query
from fusion.pose.se3 import perturb
from fusion.pose.stages import STAGES, refine
from fusion.pose.target import open_cad_model
from fusion.surface.mesh import Mesh


def test_the_views_see_the_whole_model_from_everywhere():
    corners = np.array(np.meshgrid([0, 0.3], [0, 0.2], [1, 1.1])).reshape(3, -1).T
    centre, diameter = corners.mean(axis=0), np.linalg.norm(np.ptp(corners, axis=0))
    poses = views_around(centre, diameter, CAMERA)
    for pose in poses:
        pixels = CAMERA.project(transform_points(inverse(pose), corners))
        assert pixels.min() >= 0
        assert (pixels.max(axis=0) <= (CAMERA.width - 1, CAMERA.height - 1)).all()
    ways = np.array([pose[:3, 2] for pose in poses])
    rng = np.random.default_rng(0)
    for way in rng.normal(size=(50, 3)):
        assert (ways @ way).max() / np.linalg.norm(way) > np.cos(np.radians(15))


def test_a_scale_turns_the_files_units_into_metres(tmp_path):
    path = tmp_path / "box.ply"
    trimesh.creation.box((300, 200, 100)).export(path)
    assert read_cad_model(path, scale=0.001).diameter == pytest.approx(np.hypot(0.3, np.hypot(0.2, 0.1)))
    with pytest.raises(InputError, match=r"box\.ply: the model is 374.* m large.*--model-scale 0\.001"):
        check_size(read_cad_model(path), 0.8)
    with pytest.raises(InputError, match=r"too small to be seen; give --model-scale"):
        check_size(read_cad_model(path, scale=1e-6), 0.8)
    check_size(read_cad_model(path, scale=0.001), 0.8)
    with pytest.raises(InputError, match="--model-scale -1: expected a positive number"):
        read_cad_model(path, scale=-1)


def test_a_mesh_wound_the_other_way_round_has_the_same_inside(device):
    turned = Mesh(vertices=boxes().vertices, triangles=np.ascontiguousarray(boxes().triangles[:, ::-1]))
    for mesh in (boxes(), turned):
        cad = CadModel(source="boxes", mesh=mesh, points=mesh.vertices.astype(float))
        volume = cad.volume(device=device, voxels_across=48)
        assert volume.table.count > 0
    blocks = [
        CadModel(source="", mesh=mesh, points=mesh.vertices.astype(float))
        .volume(device=device, voxels_across=48)
        .voxels.distance_sum.numpy()
        .sum()
        for mesh in (boxes(), turned)
    ]
    assert blocks[0] == pytest.approx(blocks[1], rel=1e-3)


def test_points_alone_are_a_model_too(device, tmp_path):
    np.savetxt(tmp_path / "balls.xyz", sphere_points(1500))
    target = open_cad_model(
        tmp_path / "balls.xyz", scale=1.0, camera=CAMERA, typical_depth=0.7, device=device, frames_for=STAGES
    )
    assert target.model.diameter == pytest.approx(0.43, abs=0.02)
    assert target.references(target.views[0], np.arange(3)) == []  # no colours, no features


def test_a_shell_without_an_inside_is_refused(device, tmp_path):
    sheet = trimesh.Trimesh([[0, 0, 0], [0.3, 0, 0], [0.3, 0.3, 0], [0, 0.3, 0.05]], [[0, 1, 2], [0, 2, 3]])
    sheet.export(tmp_path / "sheet.ply")
    with pytest.raises(InputError, match=r"sheet\.ply: .*closed"):
        open_cad_model(
            tmp_path / "sheet.ply", scale=1.0, camera=CAMERA, typical_depth=0.7, device=device, frames_for=STAGES
        )


def test_a_texture_is_rendered_where_it_lies(device, tmp_path):
    # A square of 1 m in the plane z = 0, its texture a quarter of each colour, seen from above.
    colors = np.array([[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]], np.uint8)
    picture = cv2.resize(colors, (64, 64), interpolation=cv2.INTER_NEAREST)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], float)
    visual = trimesh.visual.TextureVisuals(uv=uv, image=Image.fromarray(picture))
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]])
    trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False).export(tmp_path / "square.obj")
    cad = read_cad_model(tmp_path / "square.obj")
    assert cad.colored
    pose = look_at((0, 0, 1.5), (0, 0, 0), up=(0, 1, 0))
    color, depth = Renderer.of(cad, cad.mesh, device=device).view(CAMERA, pose)
    for x, y, expected in ((-0.25, 0.25, 0), (0.25, 0.25, 1), (-0.25, -0.25, 2), (0.25, -0.25, 3)):
        u, v = CAMERA.project(transform_points(inverse(pose), np.array([x, y, 0.0]))).round().astype(int)
        np.testing.assert_array_equal(color[v, u], colors.reshape(4, 3)[expected])
        assert depth[v, u] == pytest.approx(1.5, abs=1e-5)
    assert not color[depth == 0].any()


def test_a_plain_mesh_is_shaded_by_its_slope(device):
    cad = CadModel(source="boxes", mesh=boxes(), points=boxes().vertices.astype(float))
    assert not cad.colored
    color, depth = Renderer.of(cad, boxes(), device=device).view(CAMERA, POSES[0])
    np.testing.assert_allclose(depth, see_boxes(POSES[0], device), atol=1e-6)
    assert len(np.unique(color[depth > 0][:, 0])) > 3


def test_texture_tells_sides_apart_that_are_alike_in_shape(device, tmp_path):
    shape = trimesh.creation.box((0.3, 0.3, 0.3))
    for _ in range(5):
        shape = shape.subdivide()
    rng = np.random.default_rng(1)
    shape.visual.vertex_colors = rng.integers(0, 255, (len(shape.vertices), 3)).astype(np.uint8)
    shape.export(tmp_path / "cube.ply")
    camera = PinholeCamera(width=320, height=240, fx=340.0, fy=340.0, cx=160.0, cy=119.0)
    target = open_cad_model(
        tmp_path / "cube.ply", scale=1.0, camera=camera, typical_depth=0.8, device=device, frames_for=STAGES
    )
    cad = read_cad_model(tmp_path / "cube.ply")
    truth = look_at((0.45, -0.5, 0.4), (0, 0, 0))
    color, depth = Renderer.of(cad, cad.mesh, device=device).view(camera, truth)
    noisy = np.clip(0.9 * color + rng.normal(0, 3, color.shape) + 8, 0, 255).astype(np.uint8)
    query = Query(camera=camera, color=noisy, depth=depth, mask=depth > 0)
    # By shape alone a quarter turn away: depth would stay there.
    wrong = perturb(np.array([0, 0, 0, 0.03, 0.02, np.pi / 2]), truth, pivot_world=np.zeros(3))
    references = target.references(wrong, np.arange(3))
    for features in ("sift", "orb"):
        stages = ("nearest", "epipolar", "depth")
        epipolar, found = refine(target.model, query, references, wrong, stages, features=features)
        assert not epipolar.declined, epipolar.reason
        assert rotation_angle_deg(inverse(found.world_from_camera) @ truth) < 0.3
        assert np.linalg.norm(found.world_from_camera[:3, 3] - truth[:3, 3]) < 0.003
