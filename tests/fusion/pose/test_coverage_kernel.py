"""The kernel that Warp's tape differentiates, against the formula and its derivative written out."""

import numpy as np
import warp as wp
from scipy.special import erf

from fusion.pose.coverage_kernel import COVERAGE_KERNEL, NearestApproach

COUNT, SOFTNESS = 40, 1.3
PIVOT = np.array([0.02, -0.05, 0.01])


def test_the_tapes_jacobian_is_the_derivative_of_the_coverage(device):
    rng = np.random.default_rng(0)
    point, scale = rng.uniform(-0.2, 0.2, (COUNT, 3)), rng.uniform(50, 200, COUNT)
    normal = rng.normal(size=(COUNT, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    foot = point - 0.01 * rng.normal(size=(COUNT, 3))
    within, shares = rng.normal(size=COUNT), rng.uniform(0, 1, COUNT)
    told_by = rng.permutation(COUNT)
    approaches = np.zeros(COUNT, dtype=NearestApproach.numpy_dtype())
    for name, values in (("point", point), ("foot", foot), ("normal", normal), ("pixels_per_metre", scale)):
        approaches[name] = values
    twists = wp.zeros(COUNT, dtype=wp.spatial_vector, device=device, requires_grad=True)
    coverage = wp.zeros(COUNT, dtype=float, device=device, requires_grad=True)
    edge = wp.zeros(COUNT, dtype=float, device=device)
    inputs = [
        wp.array(approaches, dtype=NearestApproach, device=device),
        *(wp.array(values, dtype=kind, device=device) for values, kind in ((told_by, int), (within, float))),
        *(wp.array(shares, dtype=float, device=device), twists, wp.vec3(*PIVOT), SOFTNESS),
    ]
    with wp.Tape() as tape:
        wp.launch(COVERAGE_KERNEL, dim=COUNT, inputs=inputs, outputs=[coverage, edge], device=device)
    tape.backward(grads={coverage: wp.ones(COUNT, dtype=float, device=device)})

    distance = (normal * (point - foot)).sum(axis=1)
    # A point moves by v + ω × (x − pivot), and the distance by n · v + ((x − pivot) × n) · ω.
    rows = np.hstack([normal, np.cross(point - PIVOT, normal)])
    expected_edge = shares * (scale * distance)[told_by] - within
    slope = -np.exp(-0.5 * (expected_edge / SOFTNESS) ** 2) / (SOFTNESS * np.sqrt(2 * np.pi))
    expected = (slope * shares)[:, None] * (scale[:, None] * rows)[told_by]
    # To the rounding of float32, which distances of 0.01 from coordinates of 0.2 keep five digits of.
    np.testing.assert_allclose(edge.numpy(), expected_edge, atol=1e-3)
    np.testing.assert_allclose(coverage.numpy(), 0.5 - 0.5 * erf(expected_edge / (SOFTNESS * 2**0.5)), atol=1e-4)
    np.testing.assert_allclose(twists.grad.numpy(), expected, atol=1e-4 * np.abs(expected).max())
