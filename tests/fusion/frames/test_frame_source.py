import threading

import numpy as np
import pytest
from synthetic_scene import SphereScene, write_dataset

from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from fusion.devices import resolve_device
from fusion.frames import frame_source
from fusion.frames.frame_source import FrameSource

FRAMES = SphereScene().frames_around(7)
IDS = tuple(range(7))


@pytest.fixture
def dataset(tmp_path):
    resolve_device("cpu")
    return open_dataset(write_dataset(tmp_path, FRAMES))


@pytest.mark.parametrize("cache_bytes", [0, 100_000, 10**9])
def test_frames_come_in_order_and_whole_however_much_is_kept(dataset, monkeypatch, cache_bytes):
    monkeypatch.setattr(frame_source, "CACHE_BYTES", cache_bytes)
    with FrameSource(dataset, IDS, depth_max=None, batch_size=3) as source:
        for batches, with_color in ((source.depth_batches(), False), (source.batches(), True)):
            seen = []
            for frames in batches:
                seen += frames.frame_ids
                for i, depth, pose in zip(frames.frame_ids, frames.depths, frames.poses, strict=True):
                    np.testing.assert_array_equal(depth, dataset.depth_steps(i))
                    np.testing.assert_array_equal(pose, dataset.world_from_camera(i))
                if with_color:
                    for i, color in zip(frames.frame_ids, frames.colors, strict=True):
                        np.testing.assert_array_equal(color, FRAMES[i].color)
            assert seen == list(IDS)
        assert source.surveys.keys() == set(IDS)
        assert source.decoding_seconds > 0


def test_depth_beyond_the_limit_is_invalid(dataset):
    with FrameSource(dataset, IDS, depth_max=0.8) as source:
        (frames,) = source.depth_batches()
    whole = dataset.depth_steps(2)
    np.testing.assert_array_equal(frames.depths[2], np.where(whole <= 8000, whole, 0))


def decoding_threads():
    return [thread for thread in threading.enumerate() if thread.name.startswith("decode")]


def test_no_thread_is_left_when_the_caller_gives_up(dataset):
    def give_up():
        with FrameSource(dataset, IDS, depth_max=None, batch_size=2) as source:
            next(source.batches())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        give_up()
    assert decoding_threads() == []


def test_a_damaged_frame_is_an_error_of_its_own_batch(dataset):
    path = dataset.depth_file(5)
    path.write_bytes(path.read_bytes()[:-50])
    with FrameSource(dataset, IDS, depth_max=None, batch_size=2) as source:
        batches = source.batches()
        assert [next(batches).frame_ids, next(batches).frame_ids] == [(0, 1), (2, 3)]
        with pytest.raises(InputError, match=r"frame-000005\.depth\.png: damaged or cut short"):
            next(batches)
    assert decoding_threads() == []
