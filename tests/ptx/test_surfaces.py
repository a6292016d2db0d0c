"""Meshes, rays and counts by CUDA's code against those of the CPU's kernels, of one and the same volume."""

import itertools

import numpy as np
import pytest
import trimesh
import warp as wp
from analytic_volume import analytic_volume
from dense_volume import closed_random_field, volume_of
from synthetic_scene import SphereScene

from datagen.camera import PinholeCamera
from fusion.evaluation import observed_surface
from fusion.evaluation.observed_surface import PointMarks
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.surface.closest_points import closest_points
from fusion.surface.dual_contouring import frame_scores
from fusion.surface.dual_contouring.depth_oracle import DepthField, depth_value
from fusion.surface.dual_contouring.dual_contouring import dual_contouring, oracle_kernels
from fusion.surface.dual_contouring.oracle import Oracle
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh import Mesh
from fusion.surface.mesh_pieces import mesh_each, weld
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh
from fusion.surface.ray_casting import cast_rays
from fusion.volume.tsdf_volume import Volume
from fusion.volume.vdb_export import _averages
from fusion.volume.volume_operations import crop, merge, to_storage
from fusion.volume.voxel_counts import UpdateCounter, count_observed
from ptx.coverage import never_ran

CAMERA = PinholeCamera(width=70, height=52, fx=74.0, fy=72.0, cx=35.3, cy=25.6)
VOXEL_SIZE, TRUNCATION, DEPTH_SCALE = 0.05, 0.16, 0.0005
ACCURACY = 0.05
"""Voxels, between a mesh and the true surface."""
SCENE = SphereScene()
POSE = SCENE.poses_around(3)[1]
MODULES = [
    "fusion.surface.cells",
    "fusion.surface.closest_points",
    "fusion.surface.marching_cubes",
    "fusion.surface.mesh_pieces",
    "fusion.surface.mesh_ray_casting",
    "fusion.surface.ray_casting",
    "fusion.surface.surface_cells",
    "fusion.surface.vertex_normals",
    "fusion.volume.vdb_export",
    "fusion.volume.volume_operations",
    "fusion.volume.voxel_counts",
    *(
        f"fusion.surface.dual_contouring.{stage}"
        for stage in (
            *("cell_points", "cells_from_faces", "close_gaps", "depth_oracle", "edge_points", "face_words"),
            *("find_grid", "frame_choice", "pins", "quad_corners", "quads", "rim", "rim_polygons", "rim_vertices"),
            *("several_loops", "snap_signs"),
            *(f"cell_merging.box_{stage}" for stage in ("flatness", "quads", "tree")),
            *(f"cell_merging.{stage}" for stage in ("extended_signs", "merge_boxes", "tame_cells")),
        )
    ),
]


def bumpy_volume(device, storage="full"):
    """A closed surface with creases and thin parts, seen but for a corner, so that there is a border too."""
    centre = np.array(SCENE.centre)

    def distance(points):
        p = points - centre
        ball = np.linalg.norm(p, axis=-1) - 0.3
        box = np.abs(p - (0.2, 0.05, -0.1)).max(axis=-1) - 0.16
        return np.minimum(ball, box) + 0.01 * np.sin(40 * p).prod(axis=-1)

    return analytic_volume(
        distance,
        centre - 0.6,
        centre + 0.6,
        device=device,
        voxel_size=VOXEL_SIZE,
        truncation=TRUNCATION,
        storage=storage,
        weight=lambda points: np.where((points - centre).sum(axis=-1) < 0.45, 1.0 + points[:, 0] ** 2, 0),
        color=lambda points: 127 + 120 * np.sin(9 * points),
    )


def assert_same_mesh(found, expected, *, voxels=1e-5):
    """The same triangles and colours, and vertices to ``voxels`` (float32 has 1e-6 of one here).

    Which diagonal a quad has may be a matter of rounding where both lie within the accuracy that is asked of meshes.
    """
    assert len(found.vertices) == len(expected.vertices) > 100
    assert np.abs(found.vertices - expected.vertices).max() <= voxels * VOXEL_SIZE
    assert np.abs(found.colors.astype(int) - expected.colors).max() <= 1
    assert found.triangles.shape == expected.triangles.shape
    other = np.flatnonzero((found.triangles != expected.triangles).any(axis=1))
    assert len(other) % 2 == 0
    for pair in other.reshape(-1, 2):
        quad, its = np.unique(expected.triangles[pair]), np.unique(found.triangles[pair])
        np.testing.assert_array_equal(its, quad)
        corners = expected.vertices[quad] - expected.vertices[quad].mean(axis=0)
        assert len(quad) == 4
        assert np.linalg.svd(corners)[1][2] <= ACCURACY * VOXEL_SIZE


def assert_same_surface(found, expected, *, flatness):
    """Which of several vertices stays is a matter of rounding; each mesh keeps the flatness that was asked for."""
    assert len(found.vertices) == pytest.approx(len(expected.vertices), rel=0.1)
    for some, others in ((found, expected), (expected, found)):
        apart = closest_points(some, others.vertices, device=wp.get_device("cpu")).distances
        assert apart.max() <= 2 * flatness * VOXEL_SIZE


@pytest.mark.parametrize("storage", ["full", "packed"])
def test_marching_cubes_is_the_same(cpu, cuda, storage):
    expected, found = (marching_cubes(bumpy_volume(device, storage), normals=True) for device in (cpu, cuda))
    assert_same_mesh(found, expected)
    # Where a vertex's gradient is small, a direction is worth less: of unit length it is 1e-4 at a hundredth.
    assert np.quantile(np.abs(found.normals - expected.normals).max(axis=1), 0.99) < 1e-4


def test_pieces_and_closest_points_are_the_same(cpu, cuda):
    volumes = [bumpy_volume(device) for device in (cpu, cuda)]
    expected, found = (weld(mesh_each(volume, np.arange(volume.table.count)).values()) for volume in volumes)
    assert_same_mesh(found, expected)
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (500, 3)) + SCENE.centre
    near = [closest_points(expected, points, device=device).distances for device in (cpu, cuda)]
    np.testing.assert_allclose(near[1], near[0], atol=1e-6)


@pytest.mark.parametrize("storage", ["full", "packed"])
def test_dual_contouring_of_the_volume_is_the_same(cpu, cuda, storage):
    expected, found = (dual_contouring(bumpy_volume(device, storage), normals=True) for device in (cpu, cuda))
    assert_same_mesh(found, expected, voxels=1e-3)


def test_dual_contouring_of_noise_is_the_same(cpu, cuda):
    # White noise has every kind of cell, beside every other.
    field = np.clip(closed_random_field(3, 12), -1, 1)
    expected, found = (dual_contouring(volume_of(field, device)) for device in (cpu, cuda))
    assert_same_mesh(found, expected, voxels=1e-3)


def test_fewer_vertices_where_it_is_flat_give_the_same_surface(cpu, cuda):
    flatness = 0.1
    expected, found = (dual_contouring(bumpy_volume(device), flatness=flatness) for device in (cpu, cuda))
    assert_same_surface(found, expected, flatness=flatness)


def frames_of(device, *, steps, count=6):
    frames = SCENE.poses_around(count)
    frames = [SCENE.frame(i, pose, CAMERA) for i, pose in enumerate(frames)]
    upload = FrameUploader(CAMERA, device=device, capacity=8, depth_scale=DEPTH_SCALE if steps else None)
    depths = [np.rint(f.depth / DEPTH_SCALE).astype(np.uint16) if steps else f.depth for f in frames]
    return upload(depths, [f.world_from_camera for f in frames], [f.color for f in frames])


def depth_oracle(device, *, steps, weighted):
    """Return a volume of six frames and the oracle of their depth images; its voxels are those of the CPU."""
    options = Integration(
        depth_sampling="bilinear", drop_off=True, weighting="inverse-square" if weighted else "constant"
    )
    volume = Volume(voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=device, max_blocks=10**4)
    batch = frames_of(device, steps=steps)
    find_batch_blocks(volume.table, batch, truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.table.sort()
    volume.reserve(volume.table.count)
    counter = UpdateCounter(volume)
    counter.add(integrate_batch(volume, batch, options))
    field = DepthField(volume, options, frames=len(batch), most_frames=4)
    field.add(batch)
    return volume, field.oracle(), counter.updates


@pytest.mark.parametrize(("steps", "weighted"), list(itertools.product((True, False), repeat=2)))
def test_dual_contouring_of_depth_images_is_the_same(cpu, cuda, steps, weighted):
    reference, oracle, updates = depth_oracle(cpu, steps=steps, weighted=weighted)
    expected = dual_contouring(reference, oracle=oracle)
    volume, oracle, updates_there = depth_oracle(cuda, steps=steps, weighted=weighted)
    assert updates_there == updates
    found = dual_contouring(volume, oracle=oracle)
    # Searches end within their tolerance: a hundredth of a voxel is a fifth of the accuracy that is asked of meshes.
    assert_same_mesh(found, expected, voxels=1e-2)
    if steps and not weighted:
        flat = dual_contouring(volume, oracle=oracle, flatness=0.1)
        assert len(flat.vertices) < len(found.vertices)
        apart = closest_points(expected, flat.vertices, device=cpu).distances
        assert apart.max() <= 2 * 0.1 * VOXEL_SIZE


def test_rays_into_the_volume_meet_the_same(cpu, cuda):
    expected, found = (cast_rays(bumpy_volume(device), CAMERA, POSE) for device in (cpu, cuda))
    both = (expected.depth > 0) & (found.depth > 0)
    assert both.sum() > 300
    # At an outline one ray may pass where the other meets.
    assert ((expected.depth > 0) != (found.depth > 0)).sum() <= 2
    apart = np.abs(found.depth - expected.depth)[both]
    assert np.quantile(apart, 0.99) < 1e-5 * VOXEL_SIZE / 0.1
    assert (apart > 1e-3 * VOXEL_SIZE).sum() <= 2
    assert np.quantile(np.abs(found.color.astype(int) - expected.color)[both], 0.99) <= 1


def test_rays_at_a_mesh_meet_the_same_and_the_same_points_are_observed(cpu, cuda):
    ball = trimesh.creation.icosphere(subdivisions=3, radius=SCENE.radius).apply_translation(SCENE.centre)
    mesh = Mesh(vertices=np.asarray(ball.vertices, np.float32), triangles=np.asarray(ball.faces, np.int32))
    expected, found = (cast_rays_at_mesh(mesh, CAMERA, [POSE], device=device).depth.numpy() for device in (cpu, cuda))
    np.testing.assert_allclose(found, expected, atol=1e-6)
    for steps in (True, False):
        seen = []
        for device in (cpu, cuda):
            marks = PointMarks(ball.vertices, ball.vertex_normals, mesh, device=device)
            marks.mark(frames_of(device, steps=steps))
            seen.append(marks.observed())
        assert seen[0].mean() > 0.5
        assert (seen[0] != seen[1]).sum() <= 1


def test_operations_on_volumes_give_the_same(cpu, cuda):
    results = []
    for device in (cpu, cuda):
        volume = bumpy_volume(device)
        part = crop(volume, np.array(SCENE.centre) - 0.2, np.array(SCENE.centre) + 0.3)
        whole = to_storage(merge([volume, part]), "packed")
        sums = to_storage(whole, "full").arrays()
        arrays = [array.numpy() for array in (*part.arrays().values(), *sums.values())]
        results.append([*arrays, *_averages(volume), np.array(count_observed(volume))])
    for expected, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)


def test_every_kernel_of_these_ran(machine):
    made = [observed_surface.kernel(depth) for depth in (wp.uint16, wp.float32)]
    for depth, weighted in itertools.product((wp.uint16, wp.float32), (False, True)):
        value, state_type = depth_value(depth, weighted=weighted)
        made += [frame_scores.score_kernel(depth, weighted=weighted)]
        made += oracle_kernels(Oracle(value, state_type, None))
    assert never_ran(machine, MODULES, made) == []
