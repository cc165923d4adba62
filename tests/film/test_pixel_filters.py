"""The pixel filters: weights, samples, splats."""

from __future__ import annotations

import numpy as np
import pytest
from adjoints import RADIUS, filters, random
from kernel_parts import parts
from scipy.special import erf

from edgegrad.library import core

GAUSSIAN_INSIDE = erf(3 / np.sqrt(2))  # of a Gaussian within 3 σ = 1.5 px


# The cumulative weight from the left end, written out.
CUMULATIVE = {
    "box": lambda x: x + 0.5,
    "tent": lambda x: np.where(x < 0, 0.5 * (1 + x) ** 2, 1 - 0.5 * (1 - x) ** 2),
    "gaussian": lambda x: 0.5 + 0.5 * erf(np.sqrt(2) * x) / GAUSSIAN_INSIDE,
}


@filters
def test_filter_weight(name):
    """It is the density of the cumulative weight, one in all, and zero beyond the radius."""
    radius = parts.filter_radius(name)
    assert radius == RADIUS[name]
    assert parts.filter_weight(name, radius + 1e-9) == parts.filter_weight(name, -radius - 1e-9) == 0
    # Gauss-Legendre with 20 points on either side of the kink in the middle: exact to rounding.
    x, w = np.polynomial.legendre.leggauss(20)
    for end in np.linspace(-radius, radius, 7)[1:]:
        mass = 0.0
        for low, high in [(-radius, min(end, 0.0)), (0.0, end)]:
            if high > low:
                points = low + 0.5 * (x + 1) * (high - low)
                mass += (
                    0.5 * (high - low) * sum(wi * parts.filter_weight(name, p) for p, wi in zip(points, w, strict=True))
                )
        assert mass == pytest.approx(CUMULATIVE[name](end), abs=1e-13)


@filters
def test_filter_sample_agrees_with_its_weight(name):
    """The sample at u leaves the share u of the weight on its left, so samples are distributed as the weight."""
    u = np.concatenate([[2.0**-54, 1e-12, 1e-6], (np.arange(999) + 0.5) / 999, [1 - 1e-6, 1 - 1e-12, 1 - 2.0**-53]])
    x = np.array([parts.filter_sample(name, ui) for ui in u])
    assert np.all(np.abs(x) <= RADIUS[name]) and np.all(np.diff(x) >= 0)
    np.testing.assert_allclose(CUMULATIVE[name](x), u, atol=1e-13)  # what Newton's steps on erf promise
    np.testing.assert_allclose(x, -x[::-1], atol=1e-6)  # symmetric; at 1 - 1e-12 u itself is rounded to 1e-16


@pytest.mark.parametrize("filter", ["box", "tent", "gaussian"])
def test_splats_and_their_adjoint(filter: str) -> None:
    """⟨bar, splat(values)⟩ = ⟨splat_vjp(bar), values⟩, and what is spread sums to the filter's weights in the image."""
    x, values, bar = 12 * random(200, 2) + 6, random(200, 3, seed=2), random(12 * 9, 3, seed=3)
    found = core.splat(x, values, filter, 12, 9)
    back = core.splat_vjp(x, bar, filter, 12, 9, 2)
    assert np.sum(bar * found) == pytest.approx(np.sum(back * values), rel=1e-12)
    inside = (np.abs(x - [6, 4.5]) < [4, 2.5]).all(1)
    weights = core.splat(x[inside], values[inside], filter, 12, 9).sum(0)
    spread = {"box": 0, "tent": 1e-12, "gaussian": 0.05}[filter]  # pixel centres do not sum a Gaussian exactly
    np.testing.assert_allclose(weights, values[inside].sum(0), atol=spread * np.abs(values[inside]).sum() + 1e-12)
    single = core.splat_vjp(x, bar.astype(np.float32), filter, 12, 9, 1)
    np.testing.assert_allclose(single, back, atol=1e-6)
