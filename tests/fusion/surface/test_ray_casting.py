import numpy as np
import pytest
from analytic_volume import analytic_volume, sphere

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import look_at
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh_ray_casting import cast_rays_at_mesh
from fusion.surface.ray_casting import cast_depths, cast_rays
from fusion.volume.tsdf_volume import Volume

CAMERA = PinholeCamera(width=80, height=60, fx=85.0, fy=82.0, cx=40.3, cy=28.9)
CENTRE, RADIUS = np.array([0.113, -0.052, 0.207]), 0.3
STORAGES = ["full", "packed"]


def sphere_volume(device, *, voxel_size=0.02, storage="full", centre=CENTRE, **fields):
    return analytic_volume(
        sphere(centre, RADIUS),
        centre - 0.5,
        centre + 0.5,
        device=device,
        voxel_size=voxel_size,
        truncation=4 * voxel_size,
        storage=storage,
        **fields,
    )


def rays_of(camera, pose):
    """Return the world directions (height, width, 3) of planar depth 1."""
    return camera.back_project(np.ones((camera.height, camera.width))) @ pose[:3, :3].T


def sphere_depth(camera, pose, centre=CENTRE):
    """Return the exact planar depth of the sphere, 0 beside it, and how far from its centre each ray passes."""
    rays, offset = rays_of(camera, pose), pose[:3, 3] - centre
    a, b, c = (rays**2).sum(-1), rays @ offset, offset @ offset - RADIUS**2
    discriminant = b**2 - a * c
    depth = np.where(discriminant > 0, (-b - np.sqrt(discriminant.clip(0))) / a, 0)
    return depth, np.linalg.norm(offset - (b / a)[..., None] * rays, axis=-1)


def poses_around(count, *, distance=1.0, centre=CENTRE):
    index = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * index / count), np.pi * (1 + 5**0.5) * index
    ways = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    return [look_at(centre + distance * way, centre) for way in ways]


def points_of(depth, camera, pose):
    return pose[:3, 3] + rays_of(camera, pose) * depth[..., None]


@pytest.mark.parametrize("storage", STORAGES)
def test_depth_converges_with_the_square_of_the_voxel_size_and_normals_follow(device, storage):
    pose = look_at(CENTRE + np.array([0.31, -0.62, 0.4]), CENTRE)
    truth, passes = sphere_depth(CAMERA, pose)
    well_inside = passes < 0.8 * RADIUS
    errors, angles = [], []
    for voxel_size in (0.04, 0.02, 0.01):
        seen = cast_rays(sphere_volume(device, voxel_size=voxel_size, storage=storage), CAMERA, pose)
        errors.append(np.sqrt(np.mean((seen.depth - truth)[well_inside] ** 2)))
        radial = (points_of(truth, CAMERA, pose) - CENTRE)[well_inside] / RADIUS
        angles.append(np.degrees(np.arccos((seen.normals[well_inside] * radial).sum(-1).clip(-1, 1))).mean())
        np.testing.assert_allclose(np.linalg.norm(seen.normals[seen.depth > 0], axis=-1), 1, atol=1e-5)
        assert (seen.normals[seen.depth == 0] == 0).all()
    assert (np.log2(np.array(errors[:-1]) / errors[1:]) >= 1.9).all(), errors
    assert errors[-1] < 0.02 * 0.01
    assert (np.log2(np.array(angles[:-1]) / angles[1:]) >= 0.9).all(), angles
    assert angles[-1] < 1


@pytest.mark.parametrize("storage", STORAGES)
def test_a_plane_is_exact_over_all_block_borders(device, storage):
    normal = np.array([0.31, -0.22, 0.93]) / np.linalg.norm([0.31, -0.22, 0.93])
    volume = analytic_volume(
        lambda points: points @ normal - 0.0123,
        (-0.6,) * 3,
        (0.6,) * 3,
        device=device,
        voxel_size=0.01,
        truncation=0.04,
        storage=storage,
    )
    pose = look_at((0.2, 0.1, 0.7), (0, 0, 0.0))
    camera = PinholeCamera(width=160, height=120, fx=200, fy=200, cx=79.5, cy=59.5)
    seen = cast_rays(volume, camera, pose)
    truth = (0.0123 - pose[:3, 3] @ normal) / (rays_of(camera, pose) @ normal)
    np.testing.assert_allclose(seen.depth, truth, atol=5e-6)
    np.testing.assert_allclose(seen.normals, np.broadcast_to(normal, seen.normals.shape), atol=1e-3)


def test_there_are_no_holes_and_nothing_beyond_the_outline(device):
    volume = sphere_volume(device)
    for pose in poses_around(24):
        truth, passes = sphere_depth(CAMERA, pose)
        depth = cast_rays(volume, CAMERA, pose).depth
        assert (depth[passes < RADIUS - 0.02] > 0).all()
        assert (depth[passes > RADIUS + 0.001] == 0).all()
        # A ray that misses the near side must not end at the far one, from within.
        assert np.abs(depth - truth)[passes < RADIUS - 0.02].max() < 0.02


def test_it_agrees_with_the_mesh_of_the_same_volume(device):
    def torus(points):
        x, y, z = np.moveaxis(points, -1, 0)
        ring = np.hypot(np.hypot(x + 0.03 * np.sin(9 * y), y) - 0.4, z + 0.07 * x)
        return ring - 0.17

    volume = analytic_volume(torus, (-0.8,) * 3, (0.8,) * 3, device=device, voxel_size=0.02, truncation=0.08)
    poses = poses_around(8, distance=1.3, centre=np.zeros(3))
    expected = cast_rays_at_mesh(marching_cubes(volume), CAMERA, poses, device=device).depth.numpy()
    for pose, theirs in zip(poses, expected, strict=True):
        ours = cast_rays(volume, CAMERA, pose)
        facing = -(ours.normals * rays_of(CAMERA, pose)).sum(-1) / np.linalg.norm(rays_of(CAMERA, pose), axis=-1)
        assert ((ours.depth > 0) != (theirs > 0)).mean() < 0.01
        steep = (facing > 0.4) & (theirs > 0)
        assert steep.sum() > 500
        assert np.abs(ours.depth - theirs)[steep].max() < 0.1 * 0.02 / 0.4


def test_a_ray_that_starts_inside_sees_no_surface(device):
    # Not the near wall from behind, and not what lies beyond it either.
    both = analytic_volume(
        lambda p: np.minimum(sphere(CENTRE, RADIUS)(p), sphere(CENTRE + np.array([1, 0, 0]), RADIUS)(p)),
        CENTRE - 0.5,
        CENTRE + np.array([1.5, 0.5, 0.5]),
        device=device,
        voxel_size=0.02,
        truncation=0.08,
    )
    for start in (CENTRE, CENTRE + np.array([0.25, 0, 0]), CENTRE + np.array([0.299, 0.01, 0])):
        depth = cast_rays(both, CAMERA, look_at(start, CENTRE + np.array([1, 0, 0]))).depth
        assert (depth == 0).all()
    outside = cast_rays(both, CAMERA, look_at(CENTRE + np.array([0.31, 0, 0]), CENTRE + np.array([1, 0, 0]))).depth
    assert outside[29, 40] == pytest.approx(0.39, abs=1e-3)


def test_depth_bounds_are_where_rays_begin_and_end(device):
    volume, pose = sphere_volume(device), look_at(CENTRE + np.array([1, 0, 0]), CENTRE)
    whole = cast_rays(volume, CAMERA, pose).depth
    assert whole.max() > 0.75
    near = cast_rays(volume, CAMERA, pose, depth_max=0.75).depth
    np.testing.assert_allclose(near, np.where(whole < 0.75, whole, 0), atol=1e-6)
    # Rays that begin behind the near side are inside.
    assert (cast_rays(volume, CAMERA, pose, depth_min=0.95).depth == 0).all()


def test_unseen_voxels_never_make_surface(device):
    volume = sphere_volume(device, weight=lambda points: 5.0 * (points[:, 2] < CENTRE[2]))
    limit = CENTRE[2] - CENTRE[2] % 0.02
    for pose in poses_around(10):
        truth, passes = sphere_depth(CAMERA, pose)
        depth = cast_rays(volume, CAMERA, pose).depth
        height = points_of(truth, CAMERA, pose)[..., 2]
        assert (depth[height > limit + 0.02] == 0).all()
        assert (depth[(passes < RADIUS - 0.02) & (height < limit - 0.02)] > 0).all()
    assert (cast_rays(volume, CAMERA, pose, min_weight=5).depth == 0).all()
    assert (cast_rays(volume, CAMERA, pose, min_weight=4.9).depth > 0).any()


@pytest.mark.parametrize("storage", STORAGES)
def test_colours_are_interpolated_among_voxels_that_have_one(device, storage):
    def color(points):
        return 128 + 200 * (points - CENTRE)

    pose = look_at(CENTRE + np.array([0.4, -0.5, 0.4]), CENTRE)
    seen = cast_rays(sphere_volume(device, storage=storage, color=color), CAMERA, pose)
    hit = seen.depth > 0
    expected = color(points_of(seen.depth, CAMERA, pose))[hit]
    # Packing moves each voxel's colour by less than a level.
    np.testing.assert_allclose(seen.color[hit], expected, atol=0.52 if storage == "full" else 1.5)
    assert (seen.color[~hit] == 0).all()

    sparse = sphere_volume(device, color_weight=lambda p: (np.random.default_rng(0).random(len(p)) < 0.3).astype(float))
    colors = cast_rays(sparse, CAMERA, pose).color[hit]
    assert set(np.unique(colors)) == {0, 128}
    # No corner of eight has a colour.
    assert 0.02 < (colors[:, 0] == 0).mean() < 0.1


@pytest.mark.parametrize("shift", [(2000.0, -1500.0, 800.0), (-0.32, -0.32, -0.32)])
def test_a_scene_far_from_the_origin_keeps_its_digits(device, shift):
    centre = CENTRE + shift
    volume = sphere_volume(device, centre=centre)
    pose = look_at(centre + np.array([0.31, -0.62, 0.4]), centre)
    truth, passes = sphere_depth(CAMERA, pose, centre)
    depth = cast_rays(volume, CAMERA, pose).depth
    well_inside = passes < 0.8 * RADIUS
    assert np.abs(depth - truth)[well_inside].max() < 0.05 * 0.02


def test_many_poses_at_once_are_the_same_as_one_by_one(device):
    volume, poses = sphere_volume(device), poses_around(5)
    together = cast_depths(volume, CAMERA, poses).numpy()
    for depth, pose in zip(together, poses, strict=True):
        np.testing.assert_array_equal(depth, cast_rays(volume, CAMERA, pose).depth)


def test_rays_along_the_axes_hit_too(device):
    # Exactly along lattice lines and through block corners, where directions have zeros.
    volume = sphere_volume(device, centre=np.zeros(3))
    camera = PinholeCamera(width=1, height=1, fx=1, fy=1, cx=0, cy=0)
    for axis in (*np.eye(3), *-np.eye(3)):
        pose = look_at(axis, (0, 0, 0), up=np.roll(axis, 1))
        seen = cast_rays(volume, camera, pose)
        assert seen.depth[0, 0] == pytest.approx(0.7, abs=1e-3)
        np.testing.assert_allclose(seen.normals[0, 0], axis, atol=0.05)


def test_an_empty_volume_shows_nothing(device):
    volume = Volume(voxel_size=0.1, truncation=0.3, device=device, max_blocks=10)
    seen = cast_rays(volume, CAMERA, np.eye(4))
    assert seen.depth.shape == (60, 80)
    assert not seen.depth.any()
    assert not seen.color.any()


@pytest.mark.parametrize(
    ("pose", "bounds", "message"),
    [
        (np.full((4, 4), np.nan), {}, "world_from_camera: the pose holds NaN"),
        (np.diag([2.0, 2, 2, 1]), {}, "the pose is not rigid"),
        (look_at((1e9, 0, 0), (0, 0, 0)), {}, "too far"),
        (np.eye(4), {"depth_min": 2.0, "depth_max": 1.0}, "depth from 2 to 1 m"),
        (np.eye(4), {"depth_max": np.nan}, "depth from 0 to nan m"),
        (np.eye(4), {"depth_min": -1.0}, "depth from -1 to inf m"),
    ],
)
def test_poses_and_bounds_that_make_no_sense_are_refused(device, pose, bounds, message):
    with pytest.raises(InputError, match=message):
        cast_rays(sphere_volume(device), CAMERA, pose, **bounds)
