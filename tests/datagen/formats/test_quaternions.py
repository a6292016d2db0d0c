import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from datagen.errors import InputError
from datagen.formats.quaternions import quat_wxyz_from_rotation, rotation_from_quat_wxyz

ANGLES = st.floats(-np.pi, np.pi)


@given(ANGLES, ANGLES, ANGLES)
def test_a_rotation_survives_as_a_quaternion_and_scipy_agrees(a, b, c):
    expected = Rotation.from_euler("xyz", [a, b, c])
    quat = quat_wxyz_from_rotation(expected.as_matrix())
    assert quat[0] >= 0
    assert np.linalg.norm(quat) == pytest.approx(1, abs=1e-15)
    assert abs(quat @ np.roll(expected.as_quat(), 1)) == pytest.approx(1, abs=1e-14)
    np.testing.assert_allclose(rotation_from_quat_wxyz(quat, source=""), expected.as_matrix(), atol=2e-15)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("angle_deg", [0, 1e-6, 90, 120, 179.999999, 180])
def test_half_turns_and_no_turn_keep_their_digits(axis, angle_deg):
    rotation = Rotation.from_rotvec(np.radians(angle_deg) * np.eye(3)[axis]).as_matrix()
    quat = quat_wxyz_from_rotation(rotation)
    np.testing.assert_allclose(rotation_from_quat_wxyz(quat, source=""), rotation, atol=1e-15)


def test_w_comes_first():
    quarter_about_z = rotation_from_quat_wxyz([np.sqrt(0.5), 0, 0, np.sqrt(0.5)], source="")
    np.testing.assert_allclose(quarter_about_z @ [1, 0, 0], [0, 1, 0], atol=1e-15)


def test_a_quaternion_that_was_rounded_is_mended_and_one_that_is_none_is_refused():
    rounded = rotation_from_quat_wxyz([0.7071, 0, 0, 0.7071], source="")
    np.testing.assert_allclose(rounded.T @ rounded, np.eye(3), atol=1e-15)
    with pytest.raises(InputError, match=r"file, line 3: the quaternion .* length 0, expected 1"):
        rotation_from_quat_wxyz([0, 0, 0, 0], source="file, line 3")
    with pytest.raises(InputError, match=r"length 2"):
        rotation_from_quat_wxyz([2, 0, 0, 0], source="file")
