import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree
from synthetic_fusion import PAPER, TRUNCATION, VOXEL_SIZE, by_block, fuse
from synthetic_scene import CAMERA, SphereScene

from datagen.camera import PinholeCamera
from datagen.errors import InputError
from datagen.rigid import look_at
from fusion.integration.live_volume import LiveVolume
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.surface.mesh_pieces import weld
from fusion.volume.block_table import BlockLimitError


@pytest.fixture(scope="module")
def frames():
    return SphereScene(wall_z=-0.4).frames_around(7)


@pytest.fixture
def live(device):
    def make(**options):
        lengths = {"voxel_size": VOXEL_SIZE, "truncation": TRUNCATION, "integration": PAPER}
        return LiveVolume(CAMERA, device=str(device.alias), **(lengths | options))

    return make


def integrate_now(volume, frame):
    volume.integrate(frame)
    volume.finish()


def test_in_blocks_that_were_there_it_is_one_pass_over_all_frames(device, live, frames):
    volume = live()
    for frame in frames:
        volume.integrate(frame)
    # The second time round all blocks are there; the first is taken away again.
    copies = [dataclasses.replace(frame, frame_id=100 + frame.frame_id) for frame in frames]
    for frame in copies:
        volume.integrate(frame)
    for frame in frames:
        volume.remove(frame)
    expected, streamed = by_block(fuse(frames, device)), by_block(volume.volume)
    assert streamed.keys() == expected.keys()
    for block, sums in streamed.items():
        np.testing.assert_allclose(sums, expected[block], rtol=1e-5, atol=2e-3)
        np.testing.assert_array_equal(sums[:, 1], expected[block][:, 1])


def test_blocks_found_later_miss_only_free_space(device, live, frames):
    volume = live()
    for frame in frames:
        volume.integrate(frame)
    expected, streamed = by_block(fuse(frames, device)), by_block(volume.volume)
    assert streamed.keys() == expected.keys()
    missing = 0
    for block, sums in streamed.items():
        lacks = expected[block][:, 1] - sums[:, 1]
        np.testing.assert_allclose(expected[block][:, 0] - sums[:, 0], lacks, atol=1e-4)
        missing += (lacks > 0).sum()
    assert missing > 0


def test_a_growing_table_loses_no_block(device, frames, monkeypatch):
    monkeypatch.setattr("fusion.integration.live_volume._FIRST_CAPACITY", 64)
    volume = LiveVolume(
        CAMERA, voxel_size=VOXEL_SIZE, truncation=TRUNCATION, device=str(device.alias), integration=PAPER
    )
    ample = fuse(frames, device)
    for frame in frames:
        volume.integrate(frame)
    assert by_block(volume.volume).keys() == by_block(ample).keys()
    for frame in frames:
        volume.remove(frame)
    assert all(sums[:, 1].max() == 0 for sums in by_block(volume.volume).values())


def test_pieces_of_what_changed_make_up_the_mesh(live, frames):
    volume, pieces = live(), {}
    sizes = []
    for frame in frames:
        volume.integrate(frame)
        changes = volume.mesh_changes()
        sizes.append(len(changes))
        pieces |= changes
        whole = volume.mesh()
        welded = weld(pieces[number] for number in sorted(pieces) if pieces[number] is not None)
        np.testing.assert_array_equal(welded.vertices, whole.vertices)
        np.testing.assert_array_equal(welded.triangles, whole.triangles)
    assert volume.mesh_changes() == {}
    assert marching_cubes(volume.volume).triangles.shape == volume.mesh().triangles.shape


def test_a_small_view_changes_few_blocks(live):
    scene = SphereScene(wall_z=-0.4)
    volume = live()
    for frame in scene.frames_around(5):
        volume.integrate(frame)
    all_blocks = len(volume.mesh_changes())
    part = scene.frame(99, look_at(np.array([0.3, 0.4, 0.9]), np.array(scene.centre)))
    depth = part.depth.copy()
    depth[:, 60:] = 0
    volume.integrate(dataclasses.replace(part, depth=depth))
    assert 0 < len(volume.mesh_changes()) < all_blocks / 2


def test_frames_that_do_not_fit_are_refused_and_leave_no_trace(live, frames):
    volume = live()
    volume.integrate(frames[0])
    before = by_block(volume.volume)
    other = PinholeCamera(width=80, height=60, fx=80.0, fy=80.0, cx=40.0, cy=30.0)
    small = SphereScene().frame(5, frames[1].world_from_camera, other)
    skewed = frames[1].world_from_camera.copy()
    skewed[0, 0] += 0.3
    far = np.full_like(frames[1].depth, 1e10)
    for frame, message in (
        (frames[0], "frame 0 is in the volume already"),
        (small, r"frame 5: its depth is float32 \(60, 80\), expected float32 \(120, 160\)"),
        (dataclasses.replace(frames[1], world_from_camera=skewed), "frame 1: .*rotation"),
        (dataclasses.replace(frames[2], depth=far), r"frame 2: a surface is more than .*; the frame was left out"),
    ):
        with pytest.raises(InputError, match=message):
            integrate_now(volume, frame)
    with pytest.raises(InputError, match="frame 3 is not in the volume"):
        volume.remove(frames[3])
    assert volume.frame_ids == (0,)
    after = by_block(volume.volume)
    for block, sums in before.items():
        np.testing.assert_allclose(after[block], sums, rtol=1e-5, atol=1e-5)


def test_a_frame_that_asks_for_too_much_is_named_and_left_out(device, live, frames):
    volume = live(max_blocks=600)
    near = dataclasses.replace(frames[0], depth=np.where(frames[0].depth < 1.0, frames[0].depth, 0))
    volume.integrate(near)
    before = by_block(volume.volume)
    wall = dataclasses.replace(frames[1], frame_id=17, depth=np.full_like(frames[1].depth, 6.0))
    with pytest.raises(BlockLimitError, match=r"frame 17: the volume needs more than the 600 blocks.*left out"):
        integrate_now(volume, wall)
    after = by_block(volume.volume)
    assert volume.frame_ids == (0,)
    for block, sums in after.items():
        np.testing.assert_allclose(sums, before.get(block, np.zeros_like(sums)), rtol=1e-5, atol=1e-5)
    # What it asked for and did not get is not taken for granted later.
    with pytest.raises(BlockLimitError, match="frame 18"):
        integrate_now(volume, dataclasses.replace(wall, frame_id=18))


def test_pixels_without_a_finite_depth_count_as_invalid(device, live, frames):
    spoilt = frames[0].depth.copy()
    spoilt[::7, ::5], spoilt[1::7, ::5], spoilt[2::7, ::5] = np.nan, np.inf, -np.inf
    holes = np.where(np.isfinite(spoilt), spoilt, 0)
    volumes = [live(), live()]
    for volume, depth in zip(volumes, (spoilt, holes), strict=True):
        volume.integrate(dataclasses.replace(frames[0], depth=depth))
    one, other = (by_block(volume.volume) for volume in volumes)
    assert one.keys() == other.keys()
    for block, sums in one.items():
        np.testing.assert_array_equal(sums, other[block])


@pytest.mark.parametrize("options", [PAPER, Integration(weight_cap=2.0)], ids=["paper", "capped"])
@pytest.mark.parametrize("storage", ["full", "packed"])
def test_a_refused_frame_changes_no_voxel(live, frames, options, storage):
    volume = live(integration=options, storage=storage)
    for frame in frames[:4]:
        volume.integrate(frame)
    volume.finish()
    before = by_block(volume.volume)
    spoilt = frames[5].depth.copy()
    spoilt[50:60, 50:60] = 1e7
    with pytest.raises(InputError, match=r"frame 5: .*left out"):
        integrate_now(volume, dataclasses.replace(frames[5], depth=spoilt))
    for block, sums in by_block(volume.volume).items():
        np.testing.assert_array_equal(sums, before.get(block, np.zeros_like(sums)))


def test_a_volume_at_its_bound_grows_no_further(live, frames):
    volume = live()
    volume.integrate(frames[0])
    volume.finish()
    tight = live(max_blocks=int(1.2 * volume.volume.table.count))
    capacities = []
    for i in range(6):
        tight.integrate(dataclasses.replace(frames[0], frame_id=i))
        capacities.append(tight.volume.table.capacity)
    assert capacities[-1] <= 1 << 13


def test_steps_of_65535_are_no_surface(live, frames):
    steps = np.rint(frames[0].depth / 1e-3).astype(np.uint16)
    meshes = []
    for invalid in (0, 65535):
        volume = live(depth_scale=1e-3)
        volume.integrate(dataclasses.replace(frames[0], depth=np.where(steps > 0, steps, invalid).astype(np.uint16)))
        meshes.append(volume.mesh())
    # Threads number the blocks of a live volume, and a mesh follows the numbers: its order is not the frames' alone.
    zero, full = (mesh.vertices[np.lexsort(mesh.vertices.T)] for mesh in meshes)
    np.testing.assert_array_equal(zero, full)


def test_frames_of_the_wrong_kind_are_refused_by_name(live, frames):
    frame, volume = frames[0], live()
    height, width = frame.depth.shape
    for changes in (
        {"depth": frame.depth.astype(np.float64)},
        {"depth": np.zeros((height, width), np.uint16)},
        {"depth": frame.depth[..., None]},
        {"depth": frame.depth[0]},
        {"depth": frame.depth.tolist()},
        {"color": frame.color.astype(np.float32)},
        {"color": np.zeros((height, width, 4), np.uint8)},
        {"color": None},
        {"world_from_camera": np.full((4, 4), np.nan)},
    ):
        with pytest.raises(InputError, match="frame 0"):
            volume.integrate(dataclasses.replace(frame, **changes))
    far = frame.world_from_camera.copy()
    far[0, 3] = 5e4
    with pytest.raises(InputError, match="frame 0: the camera stands 5e"):
        volume.integrate(dataclasses.replace(frame, world_from_camera=far))
    assert volume.frame_ids == ()


def test_a_pose_is_mended_as_a_reconstruction_does(live, frames):
    scaled = frames[0].world_from_camera.copy()
    scaled[:3, :3] *= 1.0004
    volumes = [live(), live()]
    volumes[0].integrate(frames[0])
    volumes[1].integrate(dataclasses.replace(frames[0], world_from_camera=scaled))
    vertices = [volume.mesh().vertices for volume in volumes]
    assert len(vertices[0]) == len(vertices[1])
    # Threads number the blocks, and vertices follow the numbers: each has its like in the other mesh, wherever that is.
    for some, others in (vertices, vertices[::-1]):
        assert cKDTree(others).query(some)[0].max() < 1e-5


@pytest.mark.parametrize(
    "options",
    [
        {"voxel_size": np.nan},
        {"voxel_size": -0.1},
        {"voxel_size": 0.0},
        {"truncation": 0.001},
        {"truncation": np.nan},
        {"depth_scale": 0.0},
        {"depth_scale": np.nan},
        {"storage": "none"},
        {"max_blocks": 0},
        {"max_blocks": 1 << 40},
    ],
    ids=str,
)
def test_options_that_make_no_volume_are_refused(live, options):
    with pytest.raises(InputError, match=next(iter(options)).replace("_", ".")):
        live(**options)


def test_the_users_weights_weigh_pixels(device, live, frames):
    weights = np.random.default_rng(3).uniform(0.2, 2, frames[0].depth.shape).astype(np.float32)
    volume = live()
    volume.integrate(frames[0], pixel_weights=weights)
    plain = by_block(fuse(frames[:1], device))
    for block, sums in by_block(volume.volume).items():
        seen = plain[block][:, 1] > 0
        assert ((sums[seen, 1] >= 0.2) & (sums[seen, 1] <= 2)).all()
        np.testing.assert_allclose(sums[seen, 0], sums[seen, 1] * plain[block][seen, 0], atol=1e-5)
    with pytest.raises(InputError, match="frame 0: its images or pose are not those"):
        volume.remove(frames[0])
    volume.remove(frames[0], pixel_weights=weights)
    assert all((sums == 0).all() for sums in by_block(volume.volume).values())
    with pytest.raises(InputError, match="frame 1: expected pixel_weights"):
        volume.integrate(frames[1], pixel_weights=-weights)


def test_another_image_under_the_same_number_is_not_removed(live, frames):
    volume = live()
    volume.integrate(frames[0])
    with pytest.raises(InputError, match="frame 0: its images or pose are not those"):
        volume.remove(dataclasses.replace(frames[1], frame_id=0))
    volume.remove(frames[0])
    assert len(volume.mesh().triangles) == 0


def test_capped_weights_cannot_be_taken_away(live, frames):
    volume = live(integration=Integration(weight_cap=3.0))
    volume.integrate(frames[0])
    with pytest.raises(InputError, match="weights are capped"):
        volume.remove(frames[0])
