import numpy as np
import pytest
import trimesh
from synthetic_scene import CAMERA, write_dataset

from datagen.dataset import Frame
from datagen.open_dataset import open_dataset
from datagen.rigid import look_at
from fusion.devices import resolve_device
from fusion.evaluation.evaluate import Observers
from fusion.evaluation.sharp_edges import seen_sharp_edges, sharp_edge_error, sharp_edge_points, smooth_error
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh

CPU = resolve_device("cpu")


def as_mesh(shape):
    return Mesh(vertices=np.asarray(shape.vertices, np.float32), triangles=np.asarray(shape.faces, np.int32))


def test_points_lie_evenly_along_the_edges_of_a_box():
    size = np.array([0.2, 0.3, 0.5])
    points = sharp_edge_points(as_mesh(trimesh.creation.box(size)), spacing=0.001)
    assert len(points) == pytest.approx(4 * size.sum() / 0.001, abs=1)
    on_faces = np.isclose(np.abs(points), size / 2, atol=1e-7)
    assert (on_faces.sum(axis=1) >= 2).all()


def test_a_smooth_surface_has_no_sharp_edges():
    assert len(sharp_edge_points(as_mesh(trimesh.creation.icosphere(subdivisions=3)), spacing=0.01)) == 0


def test_a_chamfered_cube_misses_each_edge_by_the_chamfers_depth(tmp_path):
    # Every corner of the truth is seen: one camera before each corner.
    side, cut = 0.4, 0.02
    cube = as_mesh(trimesh.creation.box((side, side, side)))
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T
    frames = []
    for i, corner in enumerate(corners):
        pose = look_at(0.6 * corner, (0, 0, 0))
        depth = cast_rays_at_mesh(cube, CAMERA, [pose], device=CPU).depth.numpy()[0]
        color = np.zeros((*depth.shape, 3), np.uint8)
        frames.append(Frame(frame_id=i, color=color, depth=depth, world_from_camera=pose))
    dataset = open_dataset(write_dataset(tmp_path, frames))
    seen = Observers(dataset=dataset, frame_ids=dataset.frame_ids)
    # The hull of the points that lie cut metres from the edges, on the faces: chamfered at 45 degrees.
    h, low = side / 2, side / 2 - cut
    points = [p for a in (-h, h) for b in (-low, low) for c in (-low, low) for p in ((a, b, c), (b, a, c), (b, c, a))]
    chamfered = as_mesh(trimesh.PointCloud(points).convex_hull)
    edges = seen_sharp_edges(cube, spacing=0.002, observed_by=seen, device=CPU)
    assert len(edges) == len(sharp_edge_points(cube, spacing=0.002))
    error = sharp_edge_error(chamfered, edges, device=CPU)
    # Along an edge the chamfer is cut/√2 away; at its ends, over the length of one cut each, up to 2/√3 cut.
    assert cut / 2**0.5 < error < 1.05 * cut / 2**0.5
    assert sharp_edge_error(cube, edges, device=CPU) == pytest.approx(0, abs=1e-7)
    # One camera before a corner sees the three edges there, perhaps those on its outline, none of the three behind.
    one = Observers(dataset=dataset, frame_ids=dataset.frame_ids[:1])
    some = seen_sharp_edges(cube, spacing=0.002, observed_by=one, device=CPU)
    assert 3 / 12 * len(edges) <= len(some) + 3 <= 9 / 12 * len(edges) + 6
    behind = np.isclose(some, -corners[0] * side / 2, atol=1e-6).sum(axis=1)
    # But where these meet the outline, and two pixels' widths, 7 mm of each, are not told from it.
    assert (behind == 2).sum() <= 3 * 2 * 0.01 / 0.002
    assert sharp_edge_error(cube, np.empty((0, 3)), device=CPU) is None


def test_smooth_parts_are_those_away_from_the_edges():
    # A cube whose faces are moved out by 1 cm each, and whose truth's edges are thereby 1.7 cm off.
    truth, moved = (as_mesh(trimesh.creation.box([side] * 3)) for side in (0.4, 0.42))
    assert smooth_error(moved, truth, beyond=0.03, device=CPU) == pytest.approx(0.01, abs=1e-6)
    assert smooth_error(moved, truth, beyond=0.5, device=CPU) is None
    ball, larger = (as_mesh(trimesh.creation.icosphere(subdivisions=4, radius=r)) for r in (0.3, 0.31))
    assert smooth_error(larger, ball, beyond=0.03, device=CPU) == pytest.approx(0.01, rel=0.02)
