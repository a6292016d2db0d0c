import cv2
import numpy as np
import pytest

from datagen.errors import InputError
from datagen.images import clear_beyond, read_color, read_depth, write_color, write_depth

SIZE = (8, 6)
STEP = 0.0001


def test_colour_survives_the_disk(tmp_path):
    color = np.random.default_rng(0).integers(0, 256, (6, 8, 3), dtype=np.uint8)
    write_color(tmp_path / "c.png", color)
    np.testing.assert_array_equal(read_color(tmp_path / "c.png", size=SIZE), color)


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (9, 1), (3, 5), (48, 64)])
@pytest.mark.parametrize("last", [0, 1, 9999, 65534, 65535])
def test_what_is_beyond_the_last_step_becomes_invalid_wherever_it_is_written(shape, last):
    values = np.array([0, 1, 2, 9998, 9999, 10000, 32767, 32768, 65533, 65534, 65535], dtype=np.uint16)
    images = np.random.default_rng(last).choice(values, size=(3, *shape))
    expected, others = np.where(images[1] > last, 0, images[1]), images[::2].copy()
    elsewhere = np.zeros(shape, dtype=np.uint16)
    clear_beyond(images[1][::-1][::-1], last, out=elsewhere)
    clear_beyond(images[1], last, out=images[1])
    np.testing.assert_array_equal(elsewhere, expected)
    np.testing.assert_array_equal(images[1], expected)
    np.testing.assert_array_equal(images[::2], others)
    clear_beyond(images[0][:, ::-1], last, out=elsewhere)
    np.testing.assert_array_equal(elsewhere, np.where(others[0] > last, 0, others[0])[:, ::-1])


@pytest.mark.parametrize(
    ("suffix", "shape", "dtype"),
    [
        ("png", (6, 8), np.uint8),
        ("png", (6, 8, 4), np.uint8),
        ("png", (6, 8, 3), np.uint16),
        ("jpg", (6, 8), np.uint8),
        ("jpg", (6, 8, 3), np.uint8),
    ],
)
def test_colour_of_any_form_comes_as_rgb_of_eight_bits(tmp_path, suffix, shape, dtype, monkeypatch):
    image = np.random.default_rng(0).integers(0, np.iinfo(dtype).max, shape).astype(dtype)
    path = tmp_path / f"c.{suffix}"
    cv2.imwrite(str(path), image)
    color = read_color(path, size=SIZE)
    assert (color.shape, color.dtype) == ((6, 8, 3), np.uint8)
    monkeypatch.setattr("datagen.images._READ_RGB", None)
    np.testing.assert_array_equal(color, read_color(path, size=SIZE))


def test_depth_survives_the_disk_within_half_a_step_and_holes_stay_holes(tmp_path):
    depth = np.random.default_rng(0).uniform(0.2, 6.5, (6, 8)).astype(np.float32)
    depth[0, :3] = 0
    write_depth(tmp_path / "d.png", depth, metres_per_step=STEP)
    read = read_depth(tmp_path / "d.png", size=SIZE, metres_per_step=STEP)
    assert np.abs(read - depth).max() <= STEP / 2 * (1 + 1e-3)
    np.testing.assert_array_equal(read == 0, depth == 0)


def test_the_largest_value_is_a_missing_return(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.full((6, 8), 65535, np.uint16))
    assert not read_depth(tmp_path / "d.png", size=SIZE, metres_per_step=0.001).any()


@pytest.mark.parametrize("suffix", ["png", "jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_cut_image_is_refused(tmp_path, suffix, kept):
    path = tmp_path / f"c.{suffix}"
    noise = np.random.default_rng(0).integers(0, 256, (60, 80, 3), dtype=np.uint8)
    whole = cv2.imencode(f".{suffix}", noise)[1].tobytes()
    path.write_bytes(whole[: int(len(whole) * kept)])
    with pytest.raises(InputError, match=f"c.{suffix}: damaged or cut short"):
        read_color(path, size=(80, 60))


@pytest.mark.parametrize(
    ("depth", "complaint"),
    [(6.6, "does not fit 16 bits.*set depth_scale"), (-0.1, "negative"), (np.nan, "NaN"), (np.inf, "infinity")],
)
def test_depth_that_cannot_be_stored_is_refused_and_nothing_is_written(tmp_path, depth, complaint):
    image = np.full((6, 8), depth, np.float32)
    with pytest.raises(InputError, match=complaint):
        write_depth(tmp_path / "d.png", image, metres_per_step=STEP)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("farthest", [6.56, 7.0, 12.06, 12.34, 99.9, 1234.5])
def test_the_scale_that_an_error_proposes_fits(tmp_path, farthest):
    image = np.full((6, 8), farthest, np.float32)
    with pytest.raises(InputError) as caught:
        write_depth(tmp_path / "d.png", image, metres_per_step=STEP)
    proposed = float(str(caught.value).split("depth_scale to ")[1].split()[0])
    write_depth(tmp_path / "d.png", image, metres_per_step=proposed)


def test_an_image_of_another_size_is_refused(tmp_path):
    write_color(tmp_path / "c.png", np.zeros((6, 9, 3), np.uint8))
    with pytest.raises(InputError, match=r"9×6.*8×6"):
        read_color(tmp_path / "c.png", size=SIZE)


def test_an_8_bit_picture_is_no_depth(tmp_path):
    cv2.imwrite(str(tmp_path / "d.png"), np.zeros((6, 8), np.uint8))
    with pytest.raises(InputError, match=r"uint8.*16-bit"):
        read_depth(tmp_path / "d.png", size=SIZE, metres_per_step=STEP)


def test_a_missing_image_is_named(tmp_path):
    with pytest.raises(InputError, match=r"c.png: the file is missing"):
        read_color(tmp_path / "c.png", size=SIZE)
