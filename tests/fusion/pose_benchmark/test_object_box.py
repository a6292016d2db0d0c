import numpy as np
import pytest
from synthetic_scene import CAMERA

from datagen.errors import InputError
from datagen.rigid import look_at, transform_points
from fusion.pose_benchmark.object_box import ObjectBox


def test_the_mask_shows_what_lies_in_the_box():
    box = ObjectBox(low=(-0.2, -0.1, 0.0), high=(0.3, 0.2, 0.5))
    pose = look_at((0.4, -1.2, 0.9), (0.05, 0.05, 0.2))
    depth = np.random.default_rng(0).uniform(0.8, 2.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth[::7] = 0
    mask = box.mask(depth, CAMERA, pose)
    assert 0 < mask.sum() < mask.size / 2
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    x, y, z = np.moveaxis(transform_points(pose, rays * depth[..., None]), -1, 0)
    inside = (x >= -0.2) & (x <= 0.3) & (y >= -0.1) & (y <= 0.2) & (z >= 0) & (z <= 0.5)
    np.testing.assert_array_equal(mask, inside & (depth > 0))


@pytest.mark.parametrize("high", [(0.3, -0.1, 0.5), (0.3, 0.2, np.nan), (0.3, 0.2, np.inf)])
def test_a_box_that_holds_nothing_is_refused(high):
    with pytest.raises(InputError, match="low corner and then its high one"):
        ObjectBox(low=(-0.2, -0.1, 0.0), high=high)
