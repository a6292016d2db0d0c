import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from datagen.errors import InputError
from datagen.rigid import inverse, look_at, rigid, rotation_angle_deg, transform_points

coordinates = nps.arrays(np.float64, 3, elements=st.floats(-100, 100))


@st.composite
def rigid_transforms(draw):
    quaternion = draw(nps.arrays(np.float64, 4, elements=st.floats(-1, 1)))
    assume(np.linalg.norm(quaternion) > 0.1)
    w, x, y, z = quaternion / np.linalg.norm(quaternion)
    transform = np.eye(4)
    transform[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    transform[:3, 3] = draw(coordinates)
    return transform


@given(rigid_transforms())
def test_a_rigid_matrix_is_left_as_it_is(a_from_b):
    np.testing.assert_allclose(rigid(a_from_b, source="test"), a_from_b, atol=1e-12)


@given(rigid_transforms(), nps.arrays(np.float64, (3, 3), elements=st.floats(-1, 1)))
def test_rounding_within_the_tolerance_is_made_orthonormal(a_from_b, noise):
    rounded = a_from_b.copy()
    rounded[:3, :3] += 2e-4 * noise
    mended = rigid(rounded, source="test")
    np.testing.assert_allclose(mended[:3, :3].T @ mended[:3, :3], np.eye(3), atol=1e-12)
    assert np.abs(mended - a_from_b).max() < 1e-3


@given(rigid_transforms())
def test_inverse_undoes(a_from_b):
    np.testing.assert_allclose(inverse(a_from_b) @ a_from_b, np.eye(4), atol=1e-10)


@given(rigid_transforms(), rigid_transforms(), coordinates)
def test_transforming_points_composes(a_from_b, b_from_c, point_c):
    together = transform_points(a_from_b @ b_from_c, point_c)
    np.testing.assert_allclose(together, transform_points(a_from_b, transform_points(b_from_c, point_c)), atol=1e-9)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-5, 1.0, 90.0, 179.9999, 180.0])
def test_the_angle_of_a_rotation_keeps_its_digits(angle_deg):
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    turned = np.array([[c, -s, 0, 5], [s, c, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]])
    assert rotation_angle_deg(turned) == pytest.approx(angle_deg, abs=1e-9)


@given(coordinates, coordinates)
def test_look_at_puts_the_target_on_the_optical_axis_and_up_upwards(position, target):
    assume(np.linalg.norm((target - position)[:2]) > 1e-3)
    world_from_camera = look_at(position, target)
    x, y, z = transform_points(inverse(world_from_camera), target)
    assert abs(x) < 1e-9
    assert abs(y) < 1e-9
    assert z == pytest.approx(np.linalg.norm(target - position))
    assert world_from_camera[2, 1] < 0  # the image's y axis points down
    rigid(world_from_camera, source="look_at")


def test_looking_along_up_is_refused():
    with pytest.raises(InputError, match="along the up direction"):
        look_at([0, 0, 0], [0, 0, 1])


def corrupted(**entries):
    matrix = np.eye(4)
    for place, value in entries.items():
        matrix[int(place[1]), int(place[2])] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "complaint"),
    [
        (corrupted(m00=1.002), "not rigid"),
        (corrupted(m01=0.01), "not rigid"),
        (corrupted(m22=-1), "determinant -1"),
        (corrupted(m03=np.nan), "NaN or infinity"),
        (corrupted(m11=np.inf), "NaN or infinity"),
        (corrupted(m30=0.5), "last row"),
        (np.eye(3), "4×4"),
    ],
)
def test_what_is_not_rigid_is_refused_by_name(matrix, complaint):
    with pytest.raises(InputError, match=f"pose.txt: .*{complaint}"):
        rigid(matrix, source="pose.txt")
