"""The pictures of a dataset, opened again."""

import subprocess
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image
from preview_datasets import FRAMES, gray, write_dataset

import datagen
from datagen.cli import main
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.preview.contact_sheet import write_contact_sheet
from datagen.preview.make_preview import make_preview
from datagen.preview.moving_pictures import write_moving_pictures
from datagen.preview.source import preview_source
from datagen.preview.trajectory_plot import write_trajectory_plot
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.add_layers import add_sensor_depth


@pytest.fixture
def source(tmp_path):
    dataset = open_dataset(write_dataset(tmp_path / "floor"))
    return preview_source(dataset, dataset.frame_ids)


@pytest.fixture
def moving(source, tmp_path):
    video, gif = tmp_path / "out" / "v.mp4", tmp_path / "out" / "a.gif"
    write_moving_pictures(video, gif, source, source.scale())
    return video, gif


def test_the_video_shows_every_frame_in_order_at_the_datasets_pace(moving):
    with av.open(str(moving[0])) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        assert stream.codec_context.pix_fmt == "yuv420p"
        assert stream.average_rate == 25
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(pictures) == FRAMES
    inside = [picture[60:300, 60:500].mean() for picture in pictures]  # of the left panel
    np.testing.assert_allclose(inside, [gray(i) for i in range(FRAMES)], atol=4)


def test_the_gif_shows_the_frames_on_white_paper_and_repeats(moving):
    with Image.open(moving[1]) as gif:
        assert gif.n_frames == FRAMES
        assert gif.info["loop"] == 0
        for i in (0, FRAMES - 1):
            gif.seek(i)
            pixels = np.array(gif.convert("RGB"))
            assert tuple(pixels[1, 1]) == (255, 255, 255)
            assert pixels[60:100, 60:200].mean() == pytest.approx(gray(i), abs=3)


def test_the_contact_sheet_shows_the_first_and_the_last_frame_and_depth_below(source, tmp_path):
    path = tmp_path / "sheet.png"
    write_contact_sheet(path, source, source.scale(), frames=4, columns=2)
    with Image.open(path) as image:
        pixels = np.array(image)
    shown = [i for i in range(FRAMES) if ((pixels == gray(i)).all(axis=-1)).sum() > 10_000]
    assert shown == [0, 3, 6, 9]
    first, last = (np.argwhere((pixels == gray(i)).all(axis=-1)).min(axis=0) for i in (0, 9))
    assert (first < last).all()  # reading order
    height = np.ptp(np.argwhere((pixels == gray(0)).all(axis=-1))[:, 0])
    below = pixels[first[0] + height + 10 : first[0] + 2 * height - 10, first[1] + 5 : first[1] + 300]
    assert np.ptp(below.astype(int), axis=-1).mean() > 30  # coloured, where the photograph is grey


def test_the_plot_of_the_path_is_a_picture_with_the_path_in_it(source, tmp_path):
    path = tmp_path / "plot.png"
    write_trajectory_plot(path, source)
    with Image.open(path) as image:
        pixels = np.array(image.convert("RGB")).astype(int)
    assert pixels.shape[1] > 1500
    colored = np.ptp(pixels, axis=-1) > 60
    left, right = colored[200:700, :850], colored[200:700, 1000:]
    assert left.sum() > 500
    assert right.sum() > 500
    assert (pixels[0] == 255).all()


@pytest.mark.parametrize("foreign", [False, True])
def test_the_command_makes_all_pictures_of_any_dataset(tmp_path, capsys, foreign):
    folder = write_dataset(tmp_path / "floor", foreign=foreign)
    assert main(["preview", str(folder), "--out", str(tmp_path / "out"), "--frames", "::2"]) == 0
    assert "5 frames" in capsys.readouterr().out
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["animation.gif", "contact_sheet.png", "trajectory.png", "video.mp4"]


def test_frames_that_lack_a_file_are_left_out_and_counted(tmp_path, capsys):
    folder = write_dataset(tmp_path / "floor")
    (folder / "frames" / "frame-000004.pose.txt").unlink()
    assert main(["preview", str(folder), "--out", str(tmp_path / "out")]) == 0
    assert "9 frames; 1 left out" in capsys.readouterr().out


def test_a_dataset_without_a_complete_frame_is_refused_by_file(tmp_path):
    folder = write_dataset(tmp_path / "floor", frames=1)
    (folder / "frames" / "frame-000000.depth.png").unlink()
    with pytest.raises(InputError, match=r"frame-000000\.depth\.png"):
        make_preview(open_dataset(folder), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_image_leaves_no_half_video(tmp_path):
    folder = write_dataset(tmp_path / "floor", frames=60)
    (folder / "frames" / "frame-000007.depth.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"frame-000007\.depth\.png.*damaged"):
        make_preview(open_dataset(folder), tmp_path / "out")
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["contact_sheet.png", "trajectory.png"]


def test_one_frame_is_enough(tmp_path):
    shown, files = make_preview(open_dataset(write_dataset(tmp_path / "floor", frames=1)), tmp_path / "out")
    assert shown == 1
    assert all(path.stat().st_size > 0 for path in files)


def test_a_layer_can_be_shown_as_depth_and_only_one_of_depth(tmp_path):
    dataset = open_dataset(write_dataset(tmp_path / "floor", frames=2))
    noisy = add_sensor_depth(dataset, SensorSettings(model="kinect-v1", seed=0))
    shown = preview_source(noisy, noisy.frame_ids, depth_layer="sensor_depth").depth(1)
    np.testing.assert_array_equal(shown, noisy.read_layer("sensor_depth", 1))
    with pytest.raises(InputError, match="no layer 'normals'"):
        preview_source(noisy, noisy.frame_ids, depth_layer="normals")


def test_without_the_extra_the_command_says_what_to_install(tmp_path):
    code = (
        "import sys; sys.modules['av'] = None; from datagen.cli import main; "
        f"sys.exit(main(['preview', {str(tmp_path)!r}]))"
    )
    checkout = Path(datagen.__file__).parents[1]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=checkout)
    assert done.returncode == 2
    assert 'the Python module av, which is not installed: pip install "scanback[preview]"' in done.stderr
