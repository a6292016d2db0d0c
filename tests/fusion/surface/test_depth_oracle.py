import numpy as np
import pytest
import warp as wp
from mesh_topology import is_closed, is_manifold, self_intersections
from synthetic_fusion import TRUNCATION, VOXEL_SIZE, fuse
from synthetic_scene import CAMERA, SphereScene

from datagen.errors import InputError
from datagen.rigid import inverse, look_at
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.options import Integration
from fusion.surface.dual_contouring import depth_oracle
from fusion.surface.dual_contouring.depth_oracle import BEHIND, DepthField
from fusion.surface.dual_contouring.dual_contouring import dual_contouring
from fusion.surface.dual_contouring.oracle import NOT_KNOWN
from fusion.surface.marching_cubes import marching_cubes

EXACT = Integration(depth_sampling="bilinear", drop_off=True)
SCENE = SphereScene()


def field_of(volume, frames, options=EXACT, *, batch_size, **choice):
    """Keep frames in batches; ``choice`` may say ``most_frames``."""
    field = DepthField(volume, options, frames=len(frames), **choice)
    upload = FrameUploader(CAMERA, device=volume.device)
    for first in range(0, len(frames), batch_size):
        some = frames[first : first + batch_size]
        field.add(upload([frame.depth for frame in some], [frame.world_from_camera for frame in some]))
    return field.oracle()


def ask(oracle, volume, numbers, points):
    """Return an oracle's answers at points on the lattice, each in a block."""
    value, state_type = oracle.value, oracle.state_type

    @wp.kernel(module="unique")
    def ask_points(
        state: state_type, numbers: wp.array(dtype=int), points: wp.array(dtype=wp.vec3), values: wp.array(dtype=float)
    ):
        i = wp.tid()
        values[i] = value(state, numbers[i], points[i])

    values = wp.empty(len(points), dtype=float, device=volume.device)
    inputs = [
        oracle.state,
        wp.array(numbers, dtype=int, device=volume.device),
        wp.array(points.astype(np.float32), dtype=wp.vec3, device=volume.device),
    ]
    wp.launch(ask_points, dim=len(points), inputs=inputs, outputs=[values], device=volume.device)
    return values.numpy()


def said_by(frame, point):
    """Return the distance in voxels that a frame says a point of the world has, and its weight; None for nothing."""
    x, y, z = (inverse(frame.world_from_camera) @ np.append(point, 1))[:3]
    ray = np.array([x / z, y / z, 1])
    u, v = CAMERA.fx * ray[0] + CAMERA.cx, CAMERA.fy * ray[1] + CAMERA.cy
    if z <= 0 or not (-0.5 <= u < CAMERA.width - 0.5 and -0.5 <= v < CAMERA.height - 0.5):
        return None
    column, row = (int(np.clip(np.floor(at), 0, n - 2)) for at, n in ((u, CAMERA.width), (v, CAMERA.height)))
    around = frame.depth[row : row + 2, column : column + 2].astype(float)
    if around.min() <= 0 or np.ptp(around) > TRUNCATION:
        return None

    def inverse_depth(u, v):
        du, dv = u - column, v - row
        return [1 - dv, dv] @ (1 / around) @ [1 - du, du]

    # The plane through the point that is seen and what is seen a little beside it, in the camera.
    def seen(u, v):
        return np.array([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1]) / inverse_depth(u, v)

    here, step = seen(u, v), 1e-4
    normal = np.cross(seen(u + step, v) - here, seen(u, v + step) - here)
    normal *= -np.sign(normal @ here) / np.linalg.norm(normal)
    if here[2] - z < -TRUNCATION:
        return None
    cosine = -normal @ ray / np.linalg.norm(ray)
    return normal @ (z * ray - here) / VOXEL_SIZE, (cosine * np.linalg.norm(ray) / here[2]) ** 2


def in_numpy(frames, point):
    """Return the field at a point of the world in voxels, frame by frame; None where no frame says anything."""
    total, weights, hidden = 0.0, 0.0, False
    for frame in frames:
        said = said_by(frame, point)
        if said is None:
            continue
        distance, weight = said
        if distance <= -BEHIND:
            hidden = True
            continue
        weight *= 1 + min(distance, 0) / BEHIND
        total += weight * min(distance, TRUNCATION / VOXEL_SIZE)
        weights += weight
    if weights > 0:
        return total / weights
    return -BEHIND if hidden else None


def part_of(number, point):
    """Return the row of ``chosen`` that a point on the lattice falls to, by its block's number."""
    return 4 * number + int(point[1] % 8 >= 4) + 2 * int(point[2] % 8 >= 4)


@pytest.mark.parametrize("batch_size", [32, 5])
def test_it_is_the_weighted_average_of_the_distances_that_the_chosen_frames_say(device, batch_size):
    frames = SCENE.frames_around(37)
    volume = fuse(frames, device, EXACT)
    oracle = field_of(volume, frames, batch_size=batch_size)
    rng = np.random.default_rng(0)
    ways = rng.normal(size=(300, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    points = np.array(SCENE.centre) + (SCENE.radius + rng.uniform(-0.02, 0.03, 300))[:, None] * ways
    lattice = points / VOXEL_SIZE
    number_of = {tuple(b): n for n, b in enumerate(volume.table.blocks.numpy()[: volume.table.count].tolist())}
    numbers = [number_of[tuple(b)] for b in np.floor(lattice / 8).astype(int).tolist()]
    found = ask(oracle, volume, numbers, lattice)
    chosen, counts = oracle.state.chosen.numpy(), oracle.state.counts.numpy()
    rows = [part_of(number, at) for number, at in zip(numbers, lattice, strict=True)]
    expected = [
        in_numpy([frames[f] for f in chosen[row, : counts[row]]], point)
        for row, point in zip(rows, points, strict=True)
    ]
    assert sum(value is None for value in expected) < 20
    for ours, theirs in zip(found, expected, strict=True):
        assert ours == pytest.approx(NOT_KNOWN if theirs is None else theirs, abs=2e-3)


def test_it_vanishes_where_the_surface_is(device):
    frames = SCENE.frames_around(40)
    volume = fuse(frames, device, EXACT)
    mesh = dual_contouring(volume, oracle=field_of(volume, frames, batch_size=16))
    radii = np.linalg.norm(mesh.vertices - np.array(SCENE.centre), axis=1)
    cubes = np.linalg.norm(marching_cubes(volume).vertices - np.array(SCENE.centre), axis=1)
    assert np.abs(radii - SCENE.radius).mean() < 0.5 * np.abs(cubes - SCENE.radius).mean()
    assert is_closed(mesh)
    assert is_manifold(mesh)
    assert self_intersections(mesh) == 0


def test_a_side_that_no_frame_saw_stays_open(device):
    frames = [frame for frame in SCENE.frames_around(40) if frame.world_from_camera[2, 3] > SCENE.centre[2]]
    volume = fuse(frames, device, EXACT)
    mesh = dual_contouring(volume, oracle=field_of(volume, frames, batch_size=16))
    assert len(mesh.triangles) > 1000
    assert is_manifold(mesh)
    assert not is_closed(mesh)
    # The cameras are above the centre; to its underside, beyond where their rays graze it, nothing reaches.
    assert mesh.vertices[:, 2].min() > SCENE.centre[2] - 0.95 * SCENE.radius


@pytest.mark.parametrize("weighting", ["inverse-square", "cosine"])
def test_weighted_frames_have_the_same_surface(device, weighting):
    frames = SCENE.frames_around(30)
    options = Integration(depth_sampling="bilinear", drop_off=True, weighting=weighting)
    volume = fuse(frames, device, options)
    mesh = dual_contouring(volume, oracle=field_of(volume, frames, options, batch_size=16))
    radii = np.linalg.norm(mesh.vertices - np.array(SCENE.centre), axis=1)
    assert np.abs(radii - SCENE.radius).mean() < 0.02 * VOXEL_SIZE


def errors(mesh):
    """Return how far vertices lie from the sphere, metres."""
    return np.abs(np.linalg.norm(mesh.vertices - np.array(SCENE.centre), axis=1) - SCENE.radius)


@pytest.mark.parametrize("copies", [1, 5])
def test_few_views_are_asked_of_however_many_and_they_tell_enough(device, copies):
    views = SCENE.frames_around(40)
    volume = fuse(views, device, EXACT)
    oracle = field_of(volume, copies * views, batch_size=32, most_frames=12)
    chosen, counts = oracle.state.chosen.numpy(), oracle.state.counts.numpy()
    assert counts.max() == chosen.shape[1] == 12
    for frames, count in zip(chosen, counts, strict=True):
        assert len(set(frames[:count])) == count
    mesh = dual_contouring(volume, oracle=oracle)
    assert is_closed(mesh)
    assert errors(mesh).mean() < 0.5 * errors(marching_cubes(volume)).mean()


def test_views_that_graze_a_surface_do_not_outvote_those_that_face_it(device):
    angles = np.linspace(0, 2 * np.pi, 60, endpoint=False)

    def from_height(elevation, azimuths):
        ways = [[np.cos(a) * np.cos(elevation), np.sin(a) * np.cos(elevation), np.sin(elevation)] for a in azimuths]
        return [look_at(np.array(SCENE.centre) + way, SCENE.centre) for way in np.array(ways)]

    poses = from_height(np.radians(20), angles) + from_height(np.radians(75), angles[::15])
    frames = [SCENE.frame(i, pose) for i, pose in enumerate(poses)]
    volume = fuse(frames, device, EXACT)
    found = []
    for mesh in (marching_cubes(volume), dual_contouring(volume, oracle=field_of(volume, frames, batch_size=32))):
        # The ring sees it at 70° and more.
        around_pole = mesh.vertices[:, 2] > SCENE.centre[2] + 0.9 * SCENE.radius
        assert around_pole.sum() > 50
        found.append(errors(mesh)[around_pole].max())
    assert found[1] < 0.5 * found[0]


def test_images_that_do_not_fit_into_memory_are_refused(device, monkeypatch):
    frames = SCENE.frames_around(3)
    volume = fuse(frames, device, EXACT)
    monkeypatch.setattr(depth_oracle, "free_memory", lambda _: 200_000)
    with pytest.raises(InputError, match=r"3 depth images take .* take fewer --frames, or --oracle volume"):
        field_of(volume, frames, batch_size=3)
