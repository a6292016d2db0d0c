import numpy as np
import pytest
import trimesh
from synthetic_scene import SphereScene, icosphere, write_dataset

from datagen.camera import PinholeCamera
from datagen.open_dataset import open_dataset
from datagen.rigid import look_at
from fusion.devices import resolve_device
from fusion.reconstruction_config import ReconstructionConfig
from fusion.report.coloured_figure import photograph_in_view
from fusion.report.heat_map import heat, heat_bar
from fusion.report.mesh_picture import picture_of_mesh
from fusion.report.subject import Subject, view_of
from fusion.surface.mesh import Mesh

CPU = resolve_device("cpu")
SCENE = SphereScene()


def test_an_object_fills_the_picture_and_the_photograph_agrees_with_the_mesh(tmp_path):
    vertices, triangles = icosphere(SCENE)
    mesh = Mesh(vertices=vertices.astype(np.float32), triangles=triangles.astype(np.int32))
    dataset = open_dataset(write_dataset(tmp_path, SCENE.frames_around(1)))
    subject = Subject(
        name="ball",
        dataset=dataset,
        truth=None,
        folder=tmp_path,
        base=ReconstructionConfig(voxel_size=0.02),
        view=view_of(dataset, 0),
        device=CPU,
    )
    seen = (subject.picture(mesh) < 250).all(axis=-1)
    rows, columns = np.nonzero(seen)
    height, width = seen.shape
    spare = min(rows.min(), columns.min(), height - 1 - rows.max(), width - 1 - columns.max())
    assert 0.02 * width < spare < 0.08 * width
    # The sphere's pixels are coloured in the photograph, the others are black: the outlines are one.
    photograph = photograph_in_view(subject).max(axis=-1) > 60
    assert (photograph != seen).mean() < 0.015


def test_a_mesh_seen_from_behind_is_told_apart():
    square = Mesh(
        vertices=np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    camera = PinholeCamera(width=20, height=20, fx=40, fy=40, cx=9.5, cy=9.5)
    # Its normal is (0, -1, 0).
    front, back = (
        picture_of_mesh(square, camera, look_at((0, y, 0), (0, 0, 0)), device=CPU)[10, 10].astype(int) for y in (-1, 1)
    )
    assert front[0] > front[2]
    assert back[2] > back[0] + 20


def test_wires_are_drawn_where_the_edges_are():
    square = Mesh(
        vertices=np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32),
        triangles=np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    camera = PinholeCamera(width=41, height=41, fx=30, fy=30, cx=20, cy=20)
    picture = picture_of_mesh(square, camera, look_at((0, -1, 0), (0, 0, 0)), device=CPU, wires=True)
    dark = (picture < 150).all(axis=-1)
    # The only edge in view is the diagonal: x grows to the right, z upwards.
    assert dark[np.arange(41), 40 - np.arange(41)].all()
    assert dark.sum() < 3.5 * 41


def test_a_picture_shows_a_sphere_where_the_camera_sees_it():
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=0.3)
    mesh = Mesh(vertices=np.asarray(sphere.vertices, np.float32), triangles=np.asarray(sphere.faces, np.int32))
    camera = PinholeCamera(width=200, height=160, fx=300, fy=300, cx=110, cy=70)
    picture = picture_of_mesh(mesh, camera, look_at((0, -2, 0), (0, 0, 0)), device=CPU)
    v, u = np.nonzero((picture < 250).all(axis=-1))
    assert (u.mean(), v.mean()) == pytest.approx((110, 70), abs=0.3)
    # Its outline is seen at the tangent's angle.
    radius = 300 * np.tan(np.arcsin(0.3 / 2))
    assert len(u) == pytest.approx(np.pi * radius**2, rel=0.03)


def test_unshaded_colours_are_shown_as_they_are():
    square = trimesh.creation.box((1, 1, 1))
    mesh = Mesh(vertices=np.asarray(square.vertices, np.float32), triangles=np.asarray(square.faces, np.int32))
    camera = PinholeCamera(width=20, height=20, fx=20, fy=20, cx=9.5, cy=9.5)
    colors = np.tile([0.2, 0.5, 0.9], (len(mesh.vertices), 1))
    picture = picture_of_mesh(mesh, camera, look_at((0, -1, 0), (0, 0, 0)), device=CPU, colors=colors, shaded=False)
    np.testing.assert_array_equal(picture[10, 10], np.rint(255 * colors[0]))


def test_heat_grows_brighter_and_ends_at_the_most():
    brightness = heat(np.linspace(0, 2, 9), most=2.0) @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(brightness) > 0).all()
    np.testing.assert_array_equal(heat(2.0, most=2.0), heat(50.0, most=2.0))
    np.testing.assert_array_equal(heat_bar()[0, -1], np.rint(255 * heat(1, most=1.0)))
