import numpy as np
import pytest
from synthetic_scene import CAMERA, SphereScene

from datagen.errors import InputError
from fusion.frames.frame_batch import FrameUploader
from fusion.integration.fuse_batch import find_batch_blocks, integrate_batch
from fusion.integration.options import Integration
from fusion.surface.marching_cubes import marching_cubes
from fusion.volume.tsdf_volume import Volume
from fusion.volume.volume_file import load_volume, save_volume


@pytest.fixture
def volume(device):
    frames = SphereScene().frames_around(3)
    volume = Volume(voxel_size=0.02, truncation=0.06, device=device, max_blocks=10**4)
    batch = FrameUploader(CAMERA, device=device)(
        [f.depth for f in frames], [f.world_from_camera for f in frames], [f.color for f in frames]
    )
    find_batch_blocks(volume.table, batch, truncation=0.06, voxel_size=0.02)
    volume.reserve(volume.table.count)
    integrate_batch(volume, batch, Integration())
    return volume


def test_a_volume_comes_back_bit_for_bit(device, volume, tmp_path):
    save_volume(tmp_path / "volume.npz", volume)
    loaded = load_volume(tmp_path / "volume.npz", device=device)
    assert (loaded.voxel_size, loaded.truncation) == (volume.voxel_size, volume.truncation)
    for name, array in volume.arrays().items():
        count = loaded.table.count * 512
        np.testing.assert_array_equal(loaded.arrays()[name].numpy()[:count], array.numpy()[:count])
    before, after = marching_cubes(volume), marching_cubes(loaded)
    np.testing.assert_array_equal(after.vertices, before.vertices)
    np.testing.assert_array_equal(after.triangles, before.triangles)
    np.testing.assert_array_equal(after.colors, before.colors)


@pytest.mark.parametrize("damage", ["cut", "flipped", "empty", "not a zip"])
def test_a_damaged_file_is_refused(device, volume, tmp_path, damage):
    path = tmp_path / "volume.npz"
    save_volume(path, volume)
    data = bytearray(path.read_bytes())
    if damage == "cut":
        data = data[: len(data) // 2]
    elif damage == "flipped":
        data[len(data) // 2] ^= 0xFF
    else:
        data = b"" if damage == "empty" else b"not a volume" * 100
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match=r"volume\.npz: damaged"):
        load_volume(path, device=device)


def test_a_volume_of_another_version_is_refused(device, volume, tmp_path):
    path = tmp_path / "volume.npz"
    save_volume(path, volume)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {"version": 99}))
    with pytest.raises(InputError, match="version 99, expected 2"):
        load_volume(path, device=device)


def test_a_missing_file_is_named(device, tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.npz: the file is missing"):
        load_volume(tmp_path / "nowhere.npz", device=device)


def test_pickles_are_never_loaded(device, tmp_path):
    path = tmp_path / "volume.npz"
    np.savez(path, version=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="damaged"):
        load_volume(path, device=device)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("voxel_size", np.nan),
        ("voxel_size", np.zeros(2)),
        ("truncation", -1.0),
        ("blocks", np.zeros((2, 3), np.int32)),
        ("blocks", np.full((1, 3), 1 << 30, np.int32)),
        ("blocks", np.zeros((1, 3))),
        ("weight", np.zeros(3, np.float32)),
        ("weight", np.zeros(512, complex)),
    ],
)
def test_arrays_that_make_no_volume_are_refused(device, volume, tmp_path, name, value):
    path = tmp_path / "volume.npz"
    save_volume(path, volume)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **(arrays | {name: value}))
    with pytest.raises(InputError, match=r"volume\.npz: damaged"):
        load_volume(path, device=device)
