import numpy as np
import warp as wp
from scipy.ndimage import map_coordinates

from fusion.volume.trilinear import (
    BACK_FACE,
    NO_CROSSING,
    Corners,
    cubic_along,
    cubic_at,
    first_crossing,
    trilinear_gradient,
)

RAYS = 3000


@wp.kernel
def _along(
    corners: wp.array(dtype=Corners),
    starts: wp.array(dtype=wp.vec3),
    ends: wp.array(dtype=wp.vec3),
    samples: wp.array2d(dtype=float),
    crossings: wp.array(dtype=float),
    gradients: wp.array(dtype=wp.vec3),
) -> None:
    i = wp.tid()
    c = cubic_along(corners[i], starts[i], ends[i])
    for j in range(samples.shape[1]):
        samples[i, j] = cubic_at(c, float(j) / float(samples.shape[1] - 1))
    crossings[i] = first_crossing(c)
    gradients[i] = trilinear_gradient(corners[i], starts[i])


def along_random_rays(device, count=2001):
    rng = np.random.default_rng(5)
    corners, starts, ends = rng.normal(size=(RAYS, 8)), rng.random((RAYS, 3)), rng.random((RAYS, 3))
    corners[: RAYS // 2] += 2 * np.sign(rng.normal(size=(RAYS // 2, 1)))  # of one sign but for a few
    samples = wp.zeros((RAYS, count), dtype=float, device=device)
    crossings = wp.zeros(RAYS, dtype=float, device=device)
    gradients = wp.zeros(RAYS, dtype=wp.vec3, device=device)
    inputs = [
        wp.array(corners.astype(np.float32), dtype=Corners, device=device),
        wp.array(starts.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(ends.astype(np.float32), dtype=wp.vec3, device=device),
    ]
    wp.launch(_along, dim=RAYS, inputs=inputs, outputs=[samples, crossings, gradients], device=device)
    return corners, starts, ends, samples.numpy(), crossings.numpy(), gradients.numpy()


def interpolated(corners, points):
    """SciPy's trilinear interpolation; corner x + 2·y + 4·z."""
    grid = corners.reshape(2, 2, 2).transpose(2, 1, 0)
    return map_coordinates(grid, points.T, order=1)


def test_the_field_along_a_ray_is_this_cubic(device):
    corners, starts, ends, samples, _, _ = along_random_rays(device, count=11)
    for i in range(0, RAYS, 30):
        points = starts[i] + np.linspace(0, 1, 11)[:, None] * (ends[i] - starts[i])
        np.testing.assert_allclose(samples[i], interpolated(corners[i], points), atol=1e-5)


def test_the_gradient_is_that_of_the_interpolation(device):
    corners, starts, _, _, _, gradients = along_random_rays(device, count=2)
    step = 1e-4
    for i in range(0, RAYS, 30):
        at = starts[i].clip(step, 1 - step)
        expected = [
            (interpolated(corners[i], at + step * e) - interpolated(corners[i], at - step * e))[0] / (2 * step)
            for e in np.eye(3)[:, None]
        ]
        np.testing.assert_allclose(gradients[i], expected, atol=3e-3)


def test_the_first_fall_through_zero_is_found_to_rounding(device):
    _, _, _, samples, crossings, _ = along_random_rays(device)
    kinds = set()
    for values, found in zip(samples, crossings, strict=True):
        positive = values >= 0
        falls = np.flatnonzero(positive[:-1] & ~positive[1:])
        rises = np.flatnonzero(~positive[:-1] & positive[1:])
        if len(rises) and (not len(falls) or rises[0] < falls[0]):
            assert found == BACK_FACE
        elif len(falls):
            at = falls[0] + values[falls[0]] / (values[falls[0]] - values[falls[0] + 1])
            # Linear between 2,001 samples, which is itself right to the square of their distance.
            assert abs(found * (len(values) - 1) - at) < 0.02
        elif found != NO_CROSSING:
            # It dips below zero and back between two samples, or rounding decides at an end.
            assert np.abs(values).min() < 1e-5
        kinds.add((len(falls), len(rises)))
    assert {(0, 0), (1, 0), (0, 1), (1, 1)} <= kinds
