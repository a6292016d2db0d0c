import cv2
import numpy as np
import pytest
from synthetic_scene import SphereScene, write_dataset
from three_balls import CAMERA

from datagen.errors import InputError
from datagen.layers import write_layer
from datagen.open_dataset import open_dataset
from fusion.pose.mask_source import MaskChoice, dataset_masks, mask_from_depth, mask_path, read_mask

SIZE = (CAMERA.width, CAMERA.height)
DISC = np.hypot(*(np.mgrid[: CAMERA.height, : CAMERA.width] - np.array([60, 80])[:, None, None])) < 30


def written(path, image):
    cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize("value", [1, 255])
def test_a_mask_of_two_values_is_where_it_is_not_0(tmp_path, value):
    path = written(tmp_path / "m.png", (DISC * value).astype(np.uint8))
    np.testing.assert_array_equal(read_mask(path, size=SIZE), DISC)


def test_grey_levels_are_cut_at_the_middle_and_colours_by_their_brightest(tmp_path):
    soft = cv2.GaussianBlur((DISC * 255).astype(np.uint8), (0, 0), 1.5)
    path = written(tmp_path / "m.png", np.stack([soft] * 3, axis=-1))
    np.testing.assert_array_equal(read_mask(path, size=SIZE), soft > 127)


def test_of_numbered_objects_one_is_chosen(tmp_path):
    image = (DISC * 14).astype(np.uint8)
    image[:10] = 8
    path = written(tmp_path / "labels.png", image)
    np.testing.assert_array_equal(read_mask(path, size=SIZE, object_name="14"), image == 14)
    with pytest.raises(InputError, match=r"holds the values 0, 8, 14, so it numbers several.*--object"):
        read_mask(path, size=SIZE)
    with pytest.raises(InputError, match=r"no object 5; its values are 0, 8, 14"):
        read_mask(path, size=SIZE, object_name="5")


def test_masks_that_cannot_be_used_are_refused_by_name(tmp_path):
    path = written(tmp_path / "m.png", np.zeros((60, 80), np.uint8))
    with pytest.raises(InputError, match=r"m\.png: the mask has 80×60 pixels, the query's camera 160×120"):
        read_mask(path, size=SIZE)
    with pytest.raises(InputError, match="no such mask; --mask takes layer, derived"):
        read_mask(tmp_path / "layers", size=SIZE)
    (tmp_path / "text.png").write_text("no image")
    with pytest.raises(InputError, match="cannot be read as an image"):
        read_mask(tmp_path / "text.png", size=SIZE)
    with pytest.raises(InputError, match=r"--mask \{number\}\.png.*write \{frame\}"):
        mask_path("{number}.png", 3)
    assert mask_path("a/{frame:06d}.png", 3).name == "000003.png"


def test_the_layer_of_masks_gives_the_object_of_a_name(tmp_path):
    recipe = {"objects": [{"name": "Mug"}, {"name": "Book"}]}
    folder = write_dataset(tmp_path, SphereScene().frames_around(2), layers=["masks"], recipe=recipe)
    indices = np.zeros((CAMERA.height, CAMERA.width), np.uint16)
    indices[:50], indices[50:] = 1, 2
    write_layer(folder, "masks", 1, indices, depth_scale=0.001)
    dataset = open_dataset(folder)
    for name in ("book", "2"):
        np.testing.assert_array_equal(
            dataset_masks(dataset, MaskChoice(source="layer", object_name=name))(1), indices == 2
        )
    with pytest.raises(InputError, match=r"choose one with --object: 1 Mug, 2 Book"):
        dataset_masks(dataset, MaskChoice(source="layer"))
    with pytest.raises(InputError, match=r"--object cup: .* has no such object; its objects: 1 Mug, 2 Book"):
        dataset_masks(dataset, MaskChoice(source="layer", object_name="cup"))


def test_a_dataset_without_masks_says_so(tmp_path):
    dataset = open_dataset(write_dataset(tmp_path, SphereScene().frames_around(1)))
    with pytest.raises(InputError, match=r"has no masks \(its layers: none\); render it with --layers masks"):
        dataset_masks(dataset, MaskChoice(source="layer"))


def test_what_stands_on_a_table_is_told_from_depth():
    rays = CAMERA.back_project(np.ones((CAMERA.height, CAMERA.width)))
    table = 0.6 / (rays[..., 1] * 0.7 + 0.7)  # a plane, tilted by 45°
    depth = np.where((table > 0.3) & (table < 2), table, 0).astype(np.float32)
    depth[DISC] -= 0.12 + 0.0005 * (30 - np.hypot(*(np.argwhere(DISC) - [60, 80]).T)).astype(np.float32)
    mask = mask_from_depth(depth, CAMERA, 0.45)
    assert (mask & DISC).sum() > 0.95 * DISC.sum()
    assert (mask & ~DISC).sum() < 0.05 * DISC.sum()
    # An object alone is all that there is; of another size it is not there.
    alone = np.where(DISC, depth, 0).astype(np.float32)
    np.testing.assert_array_equal(mask_from_depth(alone, CAMERA, 0.45), DISC)
    assert not mask_from_depth(depth, CAMERA, 0.02).any()
    assert not mask_from_depth(np.zeros_like(depth), CAMERA, 0.45).any()
