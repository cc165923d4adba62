"""How large the filtered adjoint may be in a box."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pytest
from adjoints import filters, random
from kernel_parts import parts

CELL = 1 / 256  # importance is counted in 256ths, so that its sums are exact


def adjoint_image(kind: str, height: int = 11, width: int = 17, channels: int = 2) -> np.ndarray:
    image = random(height, width, channels, seed=6)
    if kind == "sparse":
        image *= (random(height, width, 1, seed=7) > 1.0).astype(float)
    if kind == "wide range":
        image *= np.exp(8 * random(height, width, 1, seed=8))
    return image


def reached(image: np.ndarray, radius: float, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """The pixels that meet the rectangle widened by the radius."""
    x0, x1 = (int(np.floor(v)) for v in (low[0] - radius, high[0] + radius))
    y0, y1 = (int(np.floor(v)) for v in (low[1] - radius, high[1] + radius))
    return image[max(y0, 0) : max(y1 + 1, 0), max(x0, 0) : max(x1 + 1, 0)]


def rectangles(count: int = 60) -> list[tuple[np.ndarray, np.ndarray]]:
    generator = np.random.default_rng(9)
    corners = generator.uniform([-4, -4], [21, 15], size=(count, 2, 2))
    corners[: count // 3, 1] = corners[: count // 3, 0]  # points
    return [(c.min(0), c.max(0)) for c in corners]


@pytest.mark.parametrize("kind", ["dense", "sparse", "wide range"])
@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0])
def test_importance_is_the_mean_of_its_pixels(kind, radius):
    """1 + 8 |A| / mean where there is an adjoint, rounded down to 256ths pixel by pixel; sums of them are exact."""
    image = adjoint_image(kind)
    size = np.abs(image).sum(-1)
    formula = np.where(size > 0, 1 + 8 * size / size[size > 0].mean(), 0)
    pixel = np.array(
        [
            [parts.importance(image, 0.0, [x + 0.5, y + 0.5], [x + 0.5, y + 0.5]) for x in range(image.shape[1])]
            for y in range(image.shape[0])
        ]
    )
    assert (pixel <= formula).all() and (pixel > formula - CELL).all()
    for low, high in rectangles():
        part = reached(pixel, radius, low, high)
        expected = part.sum() / part.size if part.size else 0.0
        assert parts.importance(image, radius, low, high) == expected


@pytest.mark.parametrize("radius", [0.0, 0.5, 1.0])
def test_importance_is_zero_only_where_no_adjoint_is(radius):
    image = adjoint_image("sparse") * 1e-30
    image[3, 4] = [0, 5e-324]
    image[7, 2] = [1e30, 0]
    seen = set()
    for low, high in rectangles(200):
        any_adjoint = bool((reached(image, radius, low, high) != 0).any())
        assert (parts.importance(image, radius, low, high) > 0) == any_adjoint
        seen.add(any_adjoint)
    assert seen == {True, False}


@filters
def test_importance_reaches_as_far_as_the_filter(name):
    """A single pixel with an adjoint: wherever its filter has weight, the importance is not zero."""
    image = np.zeros((11, 17, 1))
    image[5, 8] = -2.0
    radius = parts.filter_radius(name)
    for dx, dy in itertools.product(np.linspace(-2.4, 2.4, 25), repeat=2):
        x = [8.5 + dx, 5.5 + dy]
        weight = parts.filter_weight(name, dx) * parts.filter_weight(name, dy)
        importance = parts.importance(image, radius - 0.5, x, x)
        # On its own border the box belongs to one pixel only; everywhere else weight means importance.
        if weight > 0 and not (name == "box" and max(abs(dx), abs(dy)) == 0.5):
            assert importance > 0
        if max(abs(dx), abs(dy)) > radius + 1:
            assert importance == 0


def test_importance_of_no_adjoint():
    assert parts.importance(np.zeros((3, 4, 3)), 0.5, [0.0, 0.0], [4.0, 3.0]) == 0
