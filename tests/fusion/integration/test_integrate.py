import dataclasses

import numpy as np
import pytest
import warp as wp
from synthetic_fusion import PAPER, TRUNCATION, VOXEL_SIZE, batches, by_block, fuse
from synthetic_scene import CAMERA, SphereScene

from datagen.camera import PinholeCamera
from datagen.rigid import inverse, transform_points
from fusion.frames.frame_batch import FrameUploader
from fusion.integration import integrate
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.integration.pixel_weights import pixel_weights
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.block_table import BLOCK_VOXELS
from fusion.volume.tsdf_volume import Volume


def lattice_of(blocks):
    local = np.arange(BLOCK_VOXELS)
    voxels = np.stack([local % 8, local // 8 % 8, local // 64], -1)
    return (8 * np.array(blocks)[:, None] + voxels).reshape(-1, 3)


def color_confidence(depth):
    """1, or 1/255 at pixels whose 3×3 neighbourhood spans more than the truncation or has a hole."""
    padded = np.pad(depth.astype(np.float64), 1, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
    low, high = windows.min((2, 3)), windows.max((2, 3))
    return np.where((low > 0) & (high - low <= TRUNCATION), 1, 1 / 255)


def neighbour_differs(inverse_depth, u, v, along, at):
    """Between pixels (u, v) + at and the next ``along`` an axis: how far that is, in metres, from what lies beside.

    Infinite where neither of the pixels beside has depth.
    """
    step = np.array(along)

    def of(number):
        x, y = u + at[0] + number * step[0], v + at[1] + number * step[1]
        inside = (x >= 0) & (y >= 0) & (x < CAMERA.width) & (y < CAMERA.height)
        return np.where(inside, inverse_depth[y % CAMERA.height, x % CAMERA.width], 0)

    before, a, b, after = (of(number) for number in (-1, 0, 1, 2))
    outside = np.minimum(a, b) == 0  # of the image: there the four pixels are two
    product = np.where(outside, 1, a * b)
    differences = [
        np.where(beside > 0, np.abs((b - a) - slope) / product, np.inf)
        for beside, slope in ((before, a - before), (after, after - b))
    ]
    return np.where(outside, 0, np.minimum(*differences))


def bilinear_depth(depth, pixels):
    """Between four pixels in inverse depth, 0 where they are not of one surface; its weight; how clear that is."""
    u0, v0 = np.floor(pixels).astype(int).T
    du, dv = (pixels - np.floor(pixels)).T
    corners = [
        depth[(v0 + j).clip(0, CAMERA.height - 1), (u0 + i).clip(0, CAMERA.width - 1)].astype(float)
        for j in (0, 1)
        for i in (0, 1)
    ]
    low, high = np.min(corners, 0), np.max(corners, 0)
    smooth = (low > 0) & (high - low <= TRUNCATION)
    inverse_depths = np.where(depth > 0, 1 / np.where(depth > 0, depth.astype(float), 1), 0)
    sides = (((1, 0), (0, 0)), ((1, 0), (0, 1)), ((0, 1), (0, 0)), ((0, 1), (1, 0)))
    bend = np.max([neighbour_differs(inverse_depths, u0, v0, *side) for side in sides], axis=0)
    whole = smooth | ((low > 0) & (bend <= TRUNCATION))
    a, b, c, e = (1 / np.where(whole, corner, 1) for corner in corners)
    inverse_depth = (1 - dv) * ((1 - du) * a + du * b) + dv * ((1 - du) * c + du * e)
    clear = np.where(smooth, np.inf, np.abs(bend - TRUNCATION))
    clear = np.where(low > 0, np.minimum(np.abs(high - low - TRUNCATION), clear), 1)
    return np.where(whole, 1 / inverse_depth, 0), np.where(smooth, 1, 1 / 255), clear


def reference(frames, confidences, lattice, options=PAPER):
    """Equations (1) to (5) for voxels (n, 3): every frame, one after the other, as running averages in float64."""
    n = len(lattice)
    distance, weight = np.ones(n), np.zeros(n)
    color, color_weight = np.zeros((n, 3)), np.zeros(n)
    nearest_tie = np.full(n, np.inf)
    for frame, confidence in zip(frames, confidences, strict=True):
        points = transform_points(inverse(frame.world_from_camera), lattice * VOXEL_SIZE)
        pixels = CAMERA.project(points)
        u, v = np.floor(pixels + 0.5).astype(int).T
        inside = (points[:, 2] > 0) & (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        u, v = u % CAMERA.width, v % CAMERA.height
        d_pixel = np.where(inside, frame.depth[v, u], 0)
        step, faint = np.inf, 1
        if options.depth_sampling == "bilinear":
            sampled, faint, step = bilinear_depth(frame.depth, pixels)
            step = np.minimum(step, np.abs(d_pixel - points[:, 2] + 2 * TRUNCATION))
            d_pixel = np.where(inside & (d_pixel > 0) & (d_pixel - points[:, 2] >= -2 * TRUNCATION), sampled, 0)
        d = d_pixel - points[:, 2]
        new = (d_pixel > 0) & (d >= -TRUNCATION)
        t_d = np.maximum(-1, np.minimum(1, d / TRUNCATION))
        w = np.ones(n)
        if options.weighting == "inverse-square":
            w = 1 / np.where(new, frame.depth[v, u].astype(float), 1) ** 2
        if options.drop_off:
            w = w * np.where(d < 0, 1 + d / TRUNCATION, 1)
        w = np.where(new, w * faint, 0)
        total = np.where(weight + w > 0, weight + w, 1)
        distance = np.where(new, (weight * distance + w * t_d) / total, distance)
        weight += w
        w_color = np.where(new & (d <= TRUNCATION), w * confidence[v, u], 0)
        total = np.where(color_weight + w_color > 0, color_weight + w_color, 1)
        color = (color_weight[:, None] * color + w_color[:, None] * frame.color[v, u]) / total[:, None]
        color_weight += w_color
        # Where rounding in float32 may take the neighbouring pixel, or the other side of the band, nothing is compared.
        tie = np.minimum(np.abs(pixels + 0.5 - np.round(pixels + 0.5)).min(1), np.abs(np.abs(d) - TRUNCATION) * 100)
        nearest_tie = np.minimum(nearest_tie, np.minimum(tie, step * 100))
    return distance, weight, color, color_weight, nearest_tie > 1e-3


@pytest.fixture(scope="module")
def frames():
    return SphereScene(wall_z=-0.4).frames_around(7)


@pytest.mark.parametrize(
    "options",
    [
        PAPER,
        Integration(depth_sampling="bilinear"),
        Integration(weighting="inverse-square"),
        Integration(drop_off=True),
        Integration(depth_sampling="bilinear", weighting="inverse-square", drop_off=True),
    ],
    ids=["paper", "bilinear", "inverse-square", "drop-off", "all"],
)
def test_every_voxel_follows_the_papers_equations(device, frames, options):
    # Every frame has its say in every block: that frames are left out where they see nothing must not show.
    confidences = [color_confidence(frame.depth) for frame in frames]
    by_its_block = by_block(fuse(frames, device, options))
    sums = np.concatenate(list(by_its_block.values()))
    lattice = lattice_of(list(by_its_block))
    distance, weight, color, color_weight, clear = reference(frames, confidences, lattice, options)
    np.testing.assert_allclose(sums[clear, 1], weight[clear], rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(sums[clear, 5], color_weight[clear], rtol=1e-5, atol=1e-5)
    seen, colored = clear & (weight > 0.02), clear & (color_weight > 0.02)
    np.testing.assert_allclose(sums[seen, 0] / sums[seen, 1], distance[seen], atol=5e-5)
    np.testing.assert_allclose(sums[colored, 2:5] / sums[colored, 5:], color[colored], atol=1e-2)
    assert seen.sum() > 20_000


@pytest.mark.parametrize("storage", ["full", "packed"])
def test_a_thread_for_each_voxel_does_the_same_as_one_for_each_block(device, frames, storage, monkeypatch):
    # One is made for CUDA, the other for the CPU; each runs everywhere.
    def fused_by(threads, *, by_voxel):
        kernel = integrate.kernel(wp.float32, by_voxel=by_voxel, bilinear=False, weighted=False, drop_off=False)
        monkeypatch.setattr(integrate, "kernel_for", lambda *_, **__: kernel)
        monkeypatch.setattr(integrate, "threads_a_block", lambda _: threads)
        return by_block(fuse(frames, device, storage=storage))

    expected = fused_by(1, by_voxel=False)
    for block, sums in fused_by(BLOCK_VOXELS, by_voxel=True).items():
        np.testing.assert_allclose(sums, expected[block], rtol=1e-4, atol=1e-3)


def test_depth_in_steps_is_the_same_as_in_metres(device, frames):
    scale = 1e-4
    steps = [np.rint(frame.depth / scale).astype(np.uint16) for frame in frames]
    metres = [
        dataclasses.replace(f, depth=s.astype(np.float32) * np.float32(scale))
        for f, s in zip(frames, steps, strict=True)
    ]
    volume = Volume(voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=device, max_blocks=10**5)
    upload = FrameUploader(CAMERA, device=device, depth_scale=scale)
    batch = upload(steps, [f.world_from_camera for f in frames], [f.color for f in frames])
    find_batch_blocks(volume.table, batch, truncation=TRUNCATION, voxel_size=VOXEL_SIZE)
    volume.table.sort()
    volume.reserve(volume.table.count)
    integrate_batch(volume, batch, PAPER)
    expected = by_block(fuse(metres, device))
    assert by_block(volume).keys() == expected.keys()
    for block, sums in by_block(volume).items():
        np.testing.assert_allclose(sums, expected[block], rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("batch_size", [1, 3])
def test_packed_voxels_differ_from_full_ones_by_no_more_than_is_said(device, frames, batch_size):
    writes = -(-len(frames) // batch_size)
    full, packed = (
        by_block(fuse(frames, device)),
        by_block(fuse(frames, device, batch_size=batch_size, storage="packed")),
    )
    for block, exact in full.items():
        rounded, seen = packed[block], exact[:, 1] > 0
        np.testing.assert_array_equal(rounded[:, 1], exact[:, 1])
        averages = [sums[seen, 0] / sums[seen, 1] for sums in (exact, rounded)]
        np.testing.assert_allclose(*averages, atol=1.6e-5 * writes)
        assert ((rounded[:, 5] > 0) == (exact[:, 5] > 0)).all()
        # Weights of colour are kept as shares in steps of 1/255, which shifts the average of unlike frames a little.
        sure = exact[:, 5] > 0.5
        colors = [sums[sure, 2:5] / sums[sure, 5:] for sums in (exact, rounded)]
        np.testing.assert_allclose(*colors, atol=1.0 * writes + 2)


@pytest.mark.parametrize(("storage", "tolerance"), [("full", 1e-5), ("packed", 1e-3)])
def test_removing_a_frame_leaves_the_others(device, frames, storage, tolerance):
    volume = fuse(frames, device, storage=storage)
    upload = FrameUploader(CAMERA, device=device)
    for batch in batches(upload, frames[2:4], 2):
        integrate_batch(volume, batch, PAPER, remove=True)
    rest = by_block(fuse(frames[:2] + frames[4:], device, blocks_of=frames))
    for block, sums in by_block(volume).items():
        np.testing.assert_array_equal(sums[:, 1], rest[block][:, 1])
        np.testing.assert_allclose(sums[:, 0], rest[block][:, 0], atol=tolerance * len(frames))


@pytest.mark.parametrize("storage", ["full", "packed"])
@pytest.mark.parametrize("options", [PAPER, Integration(weighting="inverse-square", drop_off=True)], ids=["1", "w"])
def test_removing_all_frames_leaves_nothing(device, frames, storage, options):
    volume = fuse(frames, device, options, storage=storage)
    for batch in batches(FrameUploader(CAMERA, device=device), frames, len(frames)):
        integrate_batch(volume, batch, options, remove=True)
    for sums in by_block(volume).values():
        assert np.abs(sums[:, 1]).max() < (1e-4 if storage == "full" else 1e-2)


def test_a_cap_bounds_the_weight_and_lets_new_frames_win(device, frames):
    frame = frames[0]
    nearer = dataclasses.replace(frame, depth=np.where(frame.depth > 0, frame.depth - np.float32(0.02), 0))
    seen = {}
    for cap in (None, 2.0):
        options = Integration(weight_cap=cap)
        volume = fuse([frame] * 6 + [nearer] * 3, device, options, batch_size=1, blocks_of=[frame, nearer])
        seen[cap] = np.concatenate(list(by_block(volume).values()))
    assert seen[2.0][:, 1].max() == 2
    assert seen[None][:, 1].max() == 9
    near = (seen[None][:, 1] == 9) & (np.abs(seen[None][:, 0]) < 4)
    # The latest frame moved the surface by 0.02 / 0.07 = 0.29 of the truncation; the cap lets it come closer to that.
    shift = seen[2.0][near, 0] / seen[2.0][near, 1] - seen[None][near, 0] / seen[None][near, 1]
    assert np.median(shift) < -0.1


def test_a_cosine_weighs_a_slanted_plane_by_its_angle(device):
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    normal = np.array([0.6, 0.0, -0.8])
    rays = camera.back_project(np.ones((48, 64)))
    depth = (normal @ (0, 0, 2.0)) / (rays @ normal)
    batch = FrameUploader(camera, device=device)([depth.astype(np.float32)], [np.eye(4)])
    weights = pixel_weights(batch, "cosine", step=1.0).numpy()[0]
    expected = np.abs(rays @ normal) / np.linalg.norm(rays, axis=-1)
    np.testing.assert_allclose(weights, expected, atol=1e-3)


def test_the_users_weights_decide_which_pixels_count(device, frames):
    batch = next(batches(FrameUploader(CAMERA, device=device), frames, len(frames)))
    weights = np.zeros(batch.depth.shape, np.float32)
    weights[1] = 0.5
    weighed = dataclasses.replace(batch, pixel_weights=wp.array(weights, dtype=float, device=device))
    volume = fuse([], device, blocks_of=frames)
    integrate_batch(volume, weighed, PAPER)
    expected = by_block(fuse([frames[1]], device, blocks_of=frames))
    for block, sums in by_block(volume).items():
        np.testing.assert_allclose(sums, 0.5 * expected[block], atol=1e-4)


def test_the_background_does_not_bleed_onto_outlines(device):
    # As a camera would, the outermost pixels of the sphere have gathered the wall's green.
    scene = SphereScene(wall_z=-0.4)
    frames = []
    for frame in scene.frames_around(24):
        mixed = frame.color.copy()
        mixed[color_confidence(frame.depth) < 1] = (20, 200, 20)
        frames.append(dataclasses.replace(frame, color=mixed))
    mesh = marching_cubes(fuse(frames, device))
    on_sphere = np.abs(np.linalg.norm(mesh.vertices - scene.centre, axis=1) - scene.radius) < VOXEL_SIZE
    assert on_sphere.sum() > 2000
    green = mesh.colors[on_sphere, 1]
    # What no frame shows but at an edge is left: the rim that the wall hides.
    assert (green <= 45).mean() > 0.99


@pytest.mark.parametrize("batch_size", [1, 3])
def test_batches_of_any_size_make_the_same_volume(device, frames, batch_size):
    whole, parts = by_block(fuse(frames, device)), by_block(fuse(frames, device, batch_size=batch_size))
    assert whole.keys() == parts.keys()
    for block, sums in whole.items():
        np.testing.assert_allclose(parts[block], sums, rtol=1e-5, atol=1e-5)


def test_the_order_of_the_frames_does_not_matter(device, frames):
    forwards = by_block(fuse(frames, device))
    backwards = by_block(fuse(frames, device, order=range(len(frames))[::-1]))
    assert forwards.keys() == backwards.keys()
    for block, sums in forwards.items():
        np.testing.assert_allclose(backwards[block], sums, rtol=1e-5, atol=1e-5)


def test_a_mistake_of_one_frame_is_outvoted_by_those_that_see_through_it(device):
    clean = SphereScene(wall_z=-0.4).frames_around(12)[0]
    spoilt = clean.depth.copy()
    spoilt[50:62, 70:82] = 0.5
    wrong = dataclasses.replace(clean, depth=spoilt)

    def nearest_vertex(frames):
        vertices = marching_cubes(fuse(frames, device)).vertices
        return np.linalg.norm(vertices - clean.world_from_camera[:3, 3], axis=1).min()

    assert nearest_vertex([wrong]) < 0.6
    assert nearest_vertex([wrong, clean, clean]) > 0.6


def test_a_batch_that_sees_nothing_changes_nothing(device, frames):
    blind = dataclasses.replace(frames[0], depth=np.zeros_like(frames[0].depth))
    with_blind, without = by_block(fuse([*frames, blind], device, batch_size=7)), by_block(fuse(frames, device))
    assert with_blind.keys() == without.keys()
    for block, sums in without.items():
        np.testing.assert_array_equal(with_blind[block], sums)


def test_a_voxel_that_no_frame_saw_keeps_weight_zero(device, frames):
    # Behind the only frame's surface, beyond the truncation, nothing is known.
    frame = frames[0]
    camera_from_world = inverse(frame.world_from_camera)
    hidden = 0
    for block, sums in by_block(fuse([frame], device)).items():
        local = np.arange(BLOCK_VOXELS)
        lattice = 8 * np.array(block) + np.stack([local % 8, local // 8 % 8, local // 64], -1)
        points = transform_points(camera_from_world, lattice * VOXEL_SIZE)
        u, v = np.floor(CAMERA.project(points) + 0.5).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < CAMERA.width) & (v < CAMERA.height)
        d = np.where(inside, frame.depth[v % CAMERA.height, u % CAMERA.width], 0) - points[:, 2]
        assert (sums[inside & (d < -TRUNCATION - 1e-5), 1] == 0).all()
        hidden += (inside & (d < -TRUNCATION)).sum()
    assert hidden > 100
