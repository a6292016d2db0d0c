"""Ours into each format and back: what the format can carry comes back as it was."""

import cv2
import numpy as np
import pytest
from converted_datasets import assert_same_poses, convert

from datagen.dataset_format import Metadata
from datagen.dataset_summary import describe, summarise
from datagen.formats.registry import FORMAT_NAMES, FORMATS, format_named
from datagen.open_dataset import open_dataset


@pytest.fixture(params=FORMAT_NAMES)
def name(request):
    return request.param


def test_a_written_dataset_is_recognised_and_counted(source, name, tmp_path):
    opened = open_dataset(convert(source, tmp_path / "out", name))
    assert opened.format_name == format_named(name).title
    summary = summarise(opened)
    assert (summary["frames_complete"], summary["frames_declared"]) == (5, 5)
    assert summary["trajectory"]["length_m"] == pytest.approx(summarise(source)["trajectory"]["length_m"], abs=1e-9)
    assert f"format     {opened.format_name}" in describe(summary)


def test_there_and_back_nothing_changes(source, name, tmp_path):
    """Depth in steps of 0.1 mm is exact in 0.2 mm or 1 mm only where it was rounded so before: see the next test."""
    there = open_dataset(convert(source, tmp_path / "there", name))
    back = open_dataset(convert(there, tmp_path / "back", "scanback", depth_scale=source.depth_scale))
    assert_same_poses(there, source)
    assert_same_poses(back, source)
    for field in ("width", "height", "fx", "fy", "cx", "cy"):
        assert getattr(back.camera, field) == pytest.approx(getattr(source.camera, field), abs=1e-12)
    half_step = format_named(name).depth_scale or 0
    for i in source.frame_ids:
        np.testing.assert_array_equal(back.color(i), source.color(i))
        change = back.depth_steps(i).astype(int) - source.depth_steps(i)
        assert np.abs(change).max() * source.depth_scale <= half_step / 2 + 1e-12
        np.testing.assert_array_equal(back.depth_steps(i) == 0, source.depth_steps(i) == 0)


def test_depth_of_a_scale_that_a_format_can_say_comes_back_step_by_step(source, name, tmp_path):
    scale = format_named(name).depth_scale or 0.00025
    fitting = open_dataset(convert(source, tmp_path / "fitting", "scanback", depth_scale=scale))
    there = open_dataset(convert(fitting, tmp_path / "there", name))
    assert there.depth_scale == pytest.approx(scale, rel=1e-12)
    for i, j in zip(there.frame_ids, fitting.frame_ids, strict=True):
        np.testing.assert_array_equal(there.depth_steps(i), fitting.depth_steps(j))
        assert np.unique(there.depth_steps(i)).size > 100


def test_jpeg_and_png_keep_every_pixel(source, name, tmp_path):
    seven = convert(source, tmp_path / "seven", "7scenes")
    for path in seven.glob("*.color.png"):
        cv2.imwrite(str(path.with_suffix(".jpg")), cv2.imread(str(path)))
        path.unlink()
    with_jpeg = open_dataset(seven)
    there = open_dataset(convert(with_jpeg, tmp_path / "out", name))
    assert not np.array_equal(with_jpeg.color(1), source.color(1))
    for i in with_jpeg.frame_ids:
        np.testing.assert_array_equal(there.color(i), with_jpeg.color(i))
    if ".jpg" in format_named(name).color_suffixes:
        assert there.color_file(1).read_bytes() == with_jpeg.color_file(1).read_bytes()


def test_frame_numbers_are_kept_where_the_format_counts_freely(source, name, tmp_path):
    there = open_dataset(convert(source, tmp_path / "out", name, frames="1::2"))
    assert there.frame_ids == ((1, 3) if "frame numbers" in format_named(name).carries else (0, 1))
    for i, original in zip(there.frame_ids, (1, 3), strict=True):
        np.testing.assert_array_equal(there.color(i), source.color(original))
        np.testing.assert_allclose(there.world_from_camera(i), source.world_from_camera(original), atol=1e-9)


def test_times_are_kept_where_the_format_has_them_and_unknown_where_not(source, name, tmp_path):
    there = open_dataset(convert(source, tmp_path / "out", name))
    times = [there.timestamp_s(i) for i in there.frame_ids]
    expected = [i / 24 for i in range(5)] if "timestamps" in format_named(name).carries else [None] * 5
    assert times == pytest.approx(expected, abs=1e-9) if expected[0] is not None else times == expected


def test_every_format_is_told_apart_from_the_others(source, tmp_path):
    folders = {name: convert(source, tmp_path / name, name) for name in FORMAT_NAMES}
    for name, folder in folders.items():
        assert [other.name for other in FORMATS if other.detect(folder)] == [name]


def test_what_ours_knows_beyond_frames_comes_along(source, tmp_path):
    copy = open_dataset(convert(source, tmp_path / "out", "scanback"))
    assert isinstance(copy.metadata, Metadata)
    assert copy.metadata.recipe == {"name": "ball"}
    assert copy.metadata.provenance["converted_from"]["frames"] == [0, 1, 2, 3, 4]
    assert copy.ground_truth_mesh.read_bytes() == source.ground_truth_mesh.read_bytes()
    assert copy.metadata.frames_per_second == 24
