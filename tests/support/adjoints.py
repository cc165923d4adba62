"""Adjoints of functions of numpy arrays against central differences."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pytest

Arrays = Sequence[np.ndarray]


# Central differences in double with steps of ε^⅓ ≈ 6e-6 are wrong by about 1e-10 of the function: h² from the third
# derivative, ε / h from rounding. 1e-6 leaves room for functions whose third derivative is large.
STEP, TOLERANCE = 6e-6, 1e-6
ROUNDING = 1e-9  # ε / h = 4e-11, and some: what the difference of equal functions of size 1 may be


def check_vjp(forward: Callable[..., np.ndarray], vjp: Callable[..., Arrays], inputs: Arrays, seed: int = 0) -> None:
    """Fails unless vjp(*inputs, bar) are the derivatives of bar · forward(*inputs), for a random cotangent bar."""
    inputs = [np.asarray(x, float) for x in inputs]
    bar = np.random.default_rng(seed).normal(size=np.shape(forward(*inputs)))
    found = vjp(*inputs, bar)
    assert len(found) == len(inputs)
    for which, (x, gradient) in enumerate(zip(inputs, found, strict=True)):
        expected = np.empty(x.shape)
        for index in np.ndindex(x.shape):
            step = np.zeros(x.shape)
            step[index] = STEP * max(1.0, abs(x[index]))
            above, below = ([*inputs[:which], x + s * step, *inputs[which + 1 :]] for s in (1, -1))
            expected[index] = np.sum(bar * (forward(*above) - forward(*below))) / (2 * step[index])
        atol = TOLERANCE * np.abs(expected).max() + ROUNDING
        np.testing.assert_allclose(np.asarray(gradient), expected, rtol=0, atol=atol, err_msg=f"input {which}")


def random(*shape: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=shape)


RADIUS = {"box": 0.5, "tent": 1.0, "gaussian": 1.5}
filters = pytest.mark.parametrize("name", list(RADIUS))
