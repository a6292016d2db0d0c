"""The layers of a dataset: made while rendering, and added afterwards."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from analytic_depth import CAMERA, tilted_plane

import datagen
from datagen.cli import main
from datagen.dataset_format import Intrinsics, Metadata, read_metadata, write_metadata
from datagen.dataset_writer import write_frame
from datagen.errors import InputError
from datagen.open_dataset import open_dataset
from datagen.rendering.render_job import render_dataset
from datagen.scene_spec.lens_settings import LensSettings
from datagen.scene_spec.sensor_settings import SensorSettings
from datagen.sensors.add_layers import add_lens_layers, add_sensor_depth
from datagen.sensors.extra_layers import extra_layers, sensor_depth, sensor_of
from datagen.sensors.lens import lens_map
from datagen.sensors.lens_images import distort_color, distort_depth

CHECKOUT = Path(datagen.__file__).parents[1]
FRAMES = 4
KINECT = SensorSettings(model="kinect-v1", seed=3)


def exact_depth(frame):
    depth, _ = tilted_plane(CAMERA, distance=1.2 + 0.2 * frame, tilt_deg=30)
    depth[60:120, 100:180] = 1.0
    return depth


@pytest.fixture
def folder(tmp_path):
    """A dataset without layers."""
    intrinsics = {name: getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    metadata = Metadata(
        frame_count=FRAMES,
        intrinsics=Intrinsics(**intrinsics),
        depth_scale=0.0001,
        frames_per_second=30.0,
        recipe={"name": "test", "render": {"seed": 5}},
        provenance={},
    )
    write_metadata(tmp_path, metadata)
    for frame in range(FRAMES):
        write_frame(
            tmp_path / "frames",
            frame,
            color=np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8),
            depth=exact_depth(frame),
            world_from_camera=np.eye(4),
            depth_scale=0.0001,
        )
    return tmp_path


def images(folder):
    return {path.name: path.read_bytes() for path in sorted((folder / "sensor_depth").iterdir())}


def test_the_added_layer_is_what_the_sensor_makes_of_each_frame(folder):
    clean = open_dataset(folder).depth(1)
    dataset = add_sensor_depth(open_dataset(folder), KINECT)
    assert dataset.layers == ("sensor_depth",)
    assert read_metadata(folder).sensor == KINECT
    expected = sensor_depth(exact_depth(2), CAMERA, KINECT, frame=2, depth_scale=0.0001)
    np.testing.assert_allclose(dataset.read_layer("sensor_depth", 2), expected, atol=0.51e-4)
    np.testing.assert_array_equal(dataset.depth(1), clean)


def test_adding_goes_on_where_it_was_cut_short_and_ends_the_same(folder):
    add_sensor_depth(open_dataset(folder), KINECT)
    whole = images(folder)
    (folder / "sensor_depth" / "frame-000001.depth.png").unlink()
    kept = (folder / "sensor_depth" / "frame-000002.depth.png").stat().st_mtime_ns
    add_sensor_depth(open_dataset(folder), KINECT)
    assert images(folder) == whole
    assert (folder / "sensor_depth" / "frame-000002.depth.png").stat().st_mtime_ns == kept


def test_other_settings_replace_the_whole_layer(folder):
    add_sensor_depth(open_dataset(folder), KINECT)
    before = images(folder)
    other = KINECT.model_copy(update={"seed": 4})
    add_sensor_depth(open_dataset(folder), other)
    after = images(folder)
    assert before.keys() == after.keys()
    assert all(before[name] != after[name] for name in before)
    assert read_metadata(folder).sensor == other


class CutShortError(Exception):
    pass


def test_a_layer_that_is_half_replaced_is_not_listed_and_never_mixed(folder):
    add_sensor_depth(open_dataset(folder), KINECT)
    other = KINECT.model_copy(update={"seed": 4})

    def dies_after_two(stage, total):
        done = []

        def advance():
            done.append(stage)
            if len(done) == 2:
                raise CutShortError

        return advance

    with pytest.raises(CutShortError):
        add_sensor_depth(open_dataset(folder), other, progress=dies_after_two)
    assert open_dataset(folder).layers == ()
    add_sensor_depth(open_dataset(folder), KINECT)
    mixed = images(folder)
    add_sensor_depth(open_dataset(folder), other)
    add_sensor_depth(open_dataset(folder), KINECT)
    assert images(folder) == mixed


def test_a_dataset_that_is_being_rendered_is_left_alone(folder):
    holds = "import sys; from pathlib import Path; from datagen.rendering.folder_lock import claiming\n"
    holds += f"with claiming(Path({str(folder)!r}), range(1)): print('held', flush=True); sys.stdin.read()"
    other = subprocess.Popen(
        [sys.executable, "-c", holds], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=CHECKOUT
    )
    with other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another process"):
            add_sensor_depth(open_dataset(folder), KINECT)
    assert read_metadata(folder).sensor is None


def test_a_missing_depth_image_is_named(folder):
    (folder / "frames" / "frame-000002.depth.png").unlink()
    with pytest.raises(InputError, match=r"frame-000002\.depth\.png"):
        add_sensor_depth(open_dataset(folder), KINECT)
    assert not (folder / "sensor_depth").exists()


def test_depth_that_the_file_cannot_hold_is_out_of_range():
    far = np.full((CAMERA.height, CAMERA.width), 6.5, np.float32)
    wanted = SensorSettings(model="realsense-d435", seed=0)
    noisy = sensor_depth(far, CAMERA, wanted, frame=0, depth_scale=0.0001)
    assert noisy.max() < 6.5535
    assert 0.2 < (noisy > 0).mean() < 0.7


def test_the_command_takes_the_renderings_seed_and_says_what_it_did(folder, capsys):
    assert main(["sensor", str(folder), "--model", "realsense-d435", "--no-shadow", "--axial", "2"]) == 0
    assert "realsense-d435" in capsys.readouterr().out
    sensor = json.loads((folder / "dataset.json").read_text())["sensor"]
    assert (sensor["seed"], sensor["shadow"], sensor["axial"], sensor["grazing"]) == (5, False, 2.0, True)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [(["--axial", "-1"], "axial: expected"), (["--nearest", "2", "--farthest", "1"], "greater than nearest")],
)
def test_the_command_refuses_what_no_sensor_has(folder, options, complaint, capsys):
    assert main(["sensor", str(folder), "--model", "kinect-v1", *options]) == 2
    assert complaint in capsys.readouterr().err
    assert not (folder / "sensor_depth").exists()


def test_a_lens_is_added_recorded_and_replaced(folder, capsys):
    camera = open_dataset(folder).camera
    assert main(["lens", str(folder), "--k1", "-0.25", "--k2", "0.06"]) == 0
    first = open_dataset(folder)
    assert first.layers == ("distorted_color", "distorted_depth")
    assert (first.metadata.distortion.k1, first.metadata.distortion.intrinsics.fx) == (-0.25, camera.fx)
    mapped = lens_map(camera, LensSettings(k1=-0.25, k2=0.06))
    assert f"{mapped.inside.mean():.1%} of their pixels" in capsys.readouterr().out
    expected = distort_depth(first.depth(2), mapped)
    np.testing.assert_allclose(first.read_layer("distorted_depth", 2), expected, atol=0.51e-4)
    assert main(["lens", str(folder), "--k1", "0.1", "--magnification", "cover"]) == 0
    second = open_dataset(folder)
    assert second.layers == first.layers
    assert second.metadata.distortion.shown == 1
    assert not np.array_equal(second.read_layer("distorted_depth", 2), expected)


@pytest.mark.parametrize("magnification", ["20", "0.01", "nan"])
def test_a_magnification_that_no_lens_has_is_refused_in_one_line(folder, magnification, capsys):
    assert main(["lens", str(folder), "--magnification", magnification]) == 2
    error = capsys.readouterr().err
    assert f'magnification: expected a number from 0.1 to 10, or "cover", found {float(magnification)}' in error
    assert error.count("\n") == 1


def test_sensor_and_lens_keep_each_other(folder):
    add_sensor_depth(open_dataset(folder), KINECT)
    before = images(folder)
    dataset = add_lens_layers(open_dataset(folder), LensSettings(k1=-0.1))
    assert dataset.layers == ("sensor_depth", "distorted_color", "distorted_depth")
    assert images(folder) == before
    assert dataset.metadata.sensor == KINECT


LAYERED = {
    "sensor": {"model": "kinect-v1", "nearest": 0.1},
    "lens": {"k1": -0.2, "k2": 0.05, "magnification": "cover"},
}


def test_a_rendered_dataset_has_the_layers_of_its_scene(blender, make_scene, tmp_path):
    scene = make_scene(**LAYERED)
    dataset = render_dataset(scene, tmp_path / "layered", device="cpu")
    assert {"sensor_depth", "distorted_color", "distorted_depth"} <= set(dataset.layers)
    assert dataset.metadata.sensor == sensor_of(scene)
    assert dataset.metadata.distortion.shown == 1
    assert dataset.metadata.distortion.intrinsics.fx > dataset.camera.fx
    mapped = lens_map(dataset.camera, scene.lens)
    for frame in dataset.frame_ids:
        color, depth = dataset.color(frame), dataset.depth(frame)
        np.testing.assert_array_equal(dataset.read_layer("distorted_color", frame), distort_color(color, mapped))
        shown = dataset.read_layer("distorted_depth", frame)
        expected = distort_depth(depth, mapped)
        np.testing.assert_array_equal(shown > 0, expected > 0)
        # It was made from depth before its rounding to 1e-4, which at a silhouette can decide what is one surface.
        assert (np.abs(shown - expected) <= 1.1e-4).mean() > 0.99
    assert (dataset.read_layer("sensor_depth", 0) > 0).any()
    before = images(dataset.folder)
    for image in (dataset.folder / "frames").glob("frame-000001.*"):
        image.unlink()
    (dataset.folder / "sensor_depth" / "frame-000001.depth.png").unlink()
    render_dataset(scene, tmp_path / "layered", device="cpu")
    assert images(dataset.folder) == before


def test_replacing_a_rendered_sensor_makes_it_a_dataset_of_another_scene(blender, make_scene, tmp_path):
    scene = make_scene(sensor=LAYERED["sensor"])
    dataset = render_dataset(scene, tmp_path / "d", device="cpu")
    other = dataset.metadata.sensor.model_copy(update={"seed": 99})
    add_sensor_depth(dataset, other)
    with pytest.raises(InputError, match=r"its sensor\.seed is 99"):
        render_dataset(scene, tmp_path / "d", device="cpu")


def test_info_tells_of_sensor_and_lens(blender, make_scene, tmp_path, capsys):
    dataset = render_dataset(make_scene(**LAYERED | {"lens": {"k1": -0.3}}), tmp_path / "d", device="cpu")
    assert main(["info", str(dataset.folder)]) == 0
    told = capsys.readouterr().out
    assert "kinect-v1, seed 0" in told
    assert f"k1 -0.3; {dataset.metadata.distortion.shown:.1%} of its pixels show something" in told
    assert dataset.metadata.distortion.shown < 1


def test_a_layer_made_while_rendering_is_the_one_added_later_bit_for_bit(blender, make_scene, tmp_path):
    with_sensor = render_dataset(make_scene(sensor=LAYERED["sensor"]), tmp_path / "with", device="cpu")
    without = render_dataset(make_scene(), tmp_path / "without", device="cpu")
    add_sensor_depth(open_dataset(without.folder), with_sensor.metadata.sensor)
    assert images(with_sensor.folder) == images(without.folder)


def test_a_scene_without_sensor_and_lens_adds_nothing(make_scene):
    scene = make_scene()
    depth = exact_depth(0)
    assert extra_layers(scene, 0, np.zeros((*depth.shape, 3), np.uint8), depth, CAMERA) == {}
