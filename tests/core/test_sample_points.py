"""Sample points of pixels and systematic samples of measures."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from adjoints import random
from kernel_parts import parts


@pytest.mark.parametrize("points", [parts.lattice, parts.sequence, parts.sobol], ids=["lattice", "sequence", "sobol"])
class TestPoints:
    def test_lie_in_the_unit_square(self, points):
        for n, seed in itertools.product([1, 2, 7, 64, 1000], [0, 1, 2**63 - 1]):
            x = np.array(points(seed, n))
            assert x.shape == (n, 2) and (x >= 0).all() and (x < 1).all()

    def test_means_are_unbiased(self, points):
        """Over 4,000 random shifts, within 4 standard errors, for each point alone and for both axes together."""
        x = np.array([points(seed, 5) for seed in range(1, 4001)])  # (shift, point, axis)
        for f in (
            lambda x, y: x,
            lambda x, y: y,
            lambda x, y: x * y,
            lambda x, y: x > 0.9,
            lambda x, y: np.abs(x - y) < 0.1,
        ):
            value = f(x[..., 0], x[..., 1]).astype(float)
            grid = (np.arange(2000) + 0.5) / 2000
            expected = np.mean(f(grid[:, None], grid[None, :]))
            assert (
                np.abs(value.mean(0) - expected) < 4 * value.std(0) / np.sqrt(len(x)) + 1e-3 * (expected == 0)
            ).all()

    def test_are_spread_evenly(self, points):
        """The error of a mean over 256 points is a small part of that of independent ones."""

        def f(x):
            return np.sin(2 * np.pi * (x[..., 0] + 0.1)) * np.cos(2 * np.pi * x[..., 1]) + (x[..., 0] * x[..., 1] < 0.2)

        x = np.array([points(seed, 256) for seed in range(1, 101)])
        independent = f(x).std() / 16
        assert f(x).mean(1).std() < 0.3 * independent


def test_lattice_is_regular_along_x():
    x = np.sort(np.array(parts.lattice(5, 16))[:, 0])
    np.testing.assert_allclose(np.diff(x), 1 / 16, atol=1e-12)


@pytest.mark.parametrize("first", [0, 64, 3 * 2**20, 2**32 - 64])
@pytest.mark.parametrize("m", [1, 2, 4, 6])
def test_runs_of_sobol_fill_boxes(m, first):
    """2^m points from a multiple of 2^m on: one in each of the boxes of any shape 2^−a × 2^(a−m)."""
    for seed in (1, 2, 77):
        x = np.array(parts.sobol(seed, 2**m, first))
        for a in range(m + 1):
            box = np.floor(x * [2**a, 2 ** (m - a)]).astype(int)
            assert len({tuple(b) for b in box}) == 2**m


def test_scrambles_are_independent():
    """Two points in different halves of the square, over 4,000 scrambles: any two places within their halves are as likely."""
    x = np.array([parts.sobol(seed, 2) for seed in range(4000)])
    assert ((x[:, 0] < 0.5) != (x[:, 1] < 0.5)).all()
    folded = 2 * x % 1 < 0.5  # in which quarter of its half
    for i, j in itertools.combinations(range(4), 2):
        both = np.mean(folded.reshape(-1, 4)[:, i] == folded.reshape(-1, 4)[:, j])
        assert abs(both - 0.5) < 4 * 0.5 / np.sqrt(4000)


def test_z_order_counts_blocks():
    """Squares of 2^k pixels have consecutive numbers; far pixels do not overflow."""
    found = np.array([[parts.z_order(x, y) for x in range(16)] for y in range(16)])
    for k in range(5):
        blocks = found.reshape(16 >> k, 1 << k, 16 >> k, 1 << k).transpose(0, 2, 1, 3).reshape(-1, 4**k)
        assert (np.sort(blocks, 1) == blocks.min(1, keepdims=True) + np.arange(4**k)).all()
        assert (blocks.min(1) % 4**k == 0).all()
    assert parts.z_order(2**31 - 1, 0) == int("01" * 31, 2)
    assert parts.z_order(0, 2**31 - 1) == 2 * int("01" * 31, 2)


def test_shifts_differ():
    for points in (parts.lattice, parts.sequence, parts.sobol):
        assert len({x for seed in range(1, 101) for x in points(seed, 1)[0]}) == 200


MEASURES = {
    "few": np.array([0.0, 3.0, 0.0, 0.0, 1.0, 0.5, 0.0]),
    "wide range": 10.0 ** np.arange(-9, 6),
    "more than a block": np.abs(random(10_000, seed=4)) * (random(10_000, seed=5) > 0),  # sums run in blocks of 4096
    "one": np.array([2.5]),
}
measures = pytest.mark.parametrize("measure", MEASURES.values(), ids=MEASURES)
SHIFTS = [2.0**-54, 0.1, 0.5, 0.77, 1 - 2.0**-53]


@pytest.mark.unwatched
@measures
@pytest.mark.parametrize("n", [1, 100, 30_000])
def test_systematic_counts_are_proportional(measure, n):
    """A run of primitives gets its share to within one point, and each point weighs 1 / density."""
    total = measure.sum()
    for shift in SHIFTS:
        which, weight = map(np.array, zip(*parts.systematic(measure, n, shift), strict=True))
        assert (np.diff(which) >= 0).all()
        count = np.bincount(which, minlength=len(measure))
        assert (count[measure == 0] == 0).all()
        share = n * measure / total
        assert (np.abs(count - share) < 1 + 1e-9 * share).all()
        assert (np.abs(np.cumsum(count) - np.cumsum(share)) < 1 + 1e-9 * n).all()
        # The running sum rounds a measure by ε · total, which is what 1e-15 · total / measure allows for.
        np.testing.assert_array_less(
            np.abs(weight * measure[which] * n / total - 1), 1e-12 + 1e-15 * total / measure[which]
        )
        assert np.sum(weight * measure[which]) == pytest.approx(total, rel=1e-6)


@measures
def test_systematic_is_unbiased(measure):
    """Over all shifts the expected weight of each primitive is one."""
    n, shifts = 3, 2000
    expected = np.zeros(len(measure))
    for i in range(shifts):
        for k, weight in parts.systematic(measure, n, (i + 0.5) / shifts):
            expected[k] += weight / shifts
    # 6,000 equally spaced points count a share s to within one: 1 / (6,000 s). Where that is no test, it is left out.
    share = measure / measure.sum()
    seen = share * n * shifts > 2
    np.testing.assert_array_less(np.abs(expected - 1)[seen], 1.01 / (share * n * shifts)[seen] + 1e-9)
    assert (expected[measure == 0] == 0).all()
