"""edgegrad.raster.texture next to a slow twin, across the edges of cubes, and its derivatives."""

from __future__ import annotations

import math

import numpy as np
import pytest
import raster_twin as twin
import torch
from torch import Tensor

import edgegrad.raster as dr

pytestmark = pytest.mark.watched


def draws(seed: int, *shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
    return torch.rand(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * (high - low) + low


def directions(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("border", ["wrap", "clamp", "zero"])
@pytest.mark.parametrize("filter_mode", ["nearest", "linear"])
def test_planes_equal_the_twin(border: str, filter_mode: str) -> None:
    tex, uv = draws(0, 2, 5, 7, 3), draws(1, 2, 6, 9, 2, low=-1.5, high=2.5)
    found = dr.texture(tex, uv, filter_mode=filter_mode, boundary_mode=border)
    for b in range(2):
        at = twin.Texture(tex[b].numpy(), border)
        look_up = at.linear if filter_mode == "linear" else at.nearest
        expected = np.array([[look_up(uv[b, j, i].numpy()) for i in range(9)] for j in range(6)])
        np.testing.assert_allclose(found[b].numpy(), expected, atol=1e-12)


@pytest.mark.parametrize("filter_mode", ["nearest", "linear"])
@pytest.mark.parametrize("size", [1, 4, 5])
def test_cubes_equal_the_twin(filter_mode: str, size: int) -> None:
    tex, uv = draws(2, 1, 6, size, size, 2), directions(3, 1, 20, 30)
    uv[0, :4] = uv[0, :4].round()  # along edges and to corners of the cube too
    found = dr.texture(tex, uv, filter_mode=filter_mode, boundary_mode="cube")
    at = twin.Texture(tex[0].numpy(), "cube")
    look_up = at.linear if filter_mode == "linear" else at.nearest
    for j in range(20):
        for i in range(30):
            direction = uv[0, j, i].numpy()
            expected = look_up(direction) if direction.any() else np.zeros(2)
            np.testing.assert_allclose(found[0, j, i].numpy(), expected, atol=1e-12)


def test_cubes_have_no_seams() -> None:
    """The value goes on from one side of an edge to the other, and around a corner."""
    tex = draws(4, 1, 6, 4, 4, 1)
    across = torch.randint(0, 2, (2, 300, 3), generator=torch.Generator().manual_seed(5)) * 2.0 - 1
    across[0] = torch.where(
        torch.arange(300)[:, None] % 3 == torch.arange(3), directions(6, 300)[:, :1].clamp(-0.9, 0.9), across[0]
    )
    aside = 1e-7 * directions(7, 2, 300)
    values = [dr.texture(tex, (across + s * aside)[None], boundary_mode="cube") for s in (1, -1)]
    assert (values[0] - values[1]).abs().max() < 1e-5
    assert values[0].std() > 0.1


def test_directions_without_a_side() -> None:
    tex = torch.ones(1, 6, 2, 2, 1, dtype=torch.float64, requires_grad=True)
    uv = torch.tensor([[0.0, 0, 0], [math.nan, 1, 0], [math.inf, 0, 0], [0, 0, 2]], dtype=torch.float64)[
        None, None
    ].requires_grad_()
    found = dr.texture(tex, uv, boundary_mode="cube")
    assert found.flatten().tolist() == [0, 0, 0, 1]
    (found.sum() * 2).backward()
    assert tex.grad is not None and tex.grad.sum() == 2 and uv.grad is not None and not uv.grad[0, 0, :3].any()


def levels_of(uv: Tensor, uv_da: Tensor, size: tuple[int, int]) -> Tensor:
    """log2 of the largest singular value of the derivatives in texels."""
    jacobian = uv_da.unflatten(-1, (2, 2)) * torch.tensor([[size[1]], [size[0]]], dtype=torch.float64)
    return torch.linalg.matrix_norm(jacobian, 2).log2()


@pytest.mark.parametrize("size", [(8, 8), (16, 4), (1, 8)])
def test_pyramids_equal_the_twin(size: tuple[int, int]) -> None:
    tex, uv = draws(8, 1, *size, 2), draws(9, 1, 6, 7, 2, low=-1, high=2)
    uv_da = draws(10, 1, 6, 7, 4, low=-1, high=1) * torch.logspace(-2.5, 1, 7, dtype=torch.float64)[:, None]
    bias = draws(11, 1, 6, 7, low=-1, high=1)
    levels = twin.pyramid(tex[0].numpy(), "wrap")
    expected_levels = levels_of(uv, uv_da, size)
    assert expected_levels.min() < 0 and expected_levels.max() > len(levels) - 1
    for given, level in (
        ({"uv_da": uv_da}, expected_levels),
        ({"uv_da": uv_da, "mip_level_bias": bias}, expected_levels + bias),
        ({"mip_level_bias": 4 * bias}, 4 * bias),
    ):
        between = dr.texture(tex, uv, **given)
        nearest = dr.texture(tex, uv, filter_mode="linear-mipmap-nearest", **given)
        for j in range(6):
            for i in range(7):
                at, place = float(level[0, j, i]), uv[0, j, i].numpy()
                np.testing.assert_allclose(between[0, j, i], twin.at_level(levels, place, at), atol=1e-12)
                whole = math.floor(min(max(at, 0), len(levels) - 1) + 0.5)
                np.testing.assert_allclose(nearest[0, j, i], levels[whole].linear(place), atol=1e-12)


def test_level_of_a_cube() -> None:
    """How many texels of the side that is seen lie within a pixel: next to differences of the place on it."""
    tex, uv = draws(12, 1, 6, 16, 16, 1), directions(13, 1, 5, 6)
    uv_da = draws(14, 1, 5, 6, 6, low=-1, high=1) * 0.2
    found = dr.texture(tex, uv, uv_da, boundary_mode="cube")
    levels = twin.pyramid(tex[0].numpy(), "cube")
    h = 1e-6
    for j in range(5):
        for i in range(6):
            at, step = uv[0, j, i].numpy(), uv_da[0, j, i].numpy().reshape(3, 2)
            side = twin.side_of_cube(at)[0]
            ends = [[np.array(twin.side_of_cube(at + s * h * step[:, k])) for s in (1, -1)] for k in (0, 1)]
            assert all(end[0] == side for pair in ends for end in pair)
            jacobian = np.stack([(a - b)[1:] / (2 * h) * 16 for a, b in ends], 1)
            level = math.log2(np.linalg.norm(jacobian, 2))
            np.testing.assert_allclose(found[0, j, i], twin.at_level(levels, at, level), atol=1e-5)


def test_levels_given() -> None:
    tex, uv = draws(15, 2, 8, 4, 3), draws(16, 2, 5, 5, 2)
    level = draws(17, 2, 5, 5, low=-1, high=4)
    expected = dr.texture(tex, uv, mip_level_bias=level)
    made = dr.texture_construct_mip(tex)
    assert [tuple(m.shape[1:3]) for m in made.levels] == [(4, 2), (2, 1), (1, 1)]
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, mip=made), expected)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, mip=list(made.levels)), expected)
    once = dr.texture(tex, uv, mip_level_bias=level, max_mip_level=1)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level.clamp(max=1)), once)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, mip=made, max_mip_level=1), once)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, mip=list(made.levels[:1])), once)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, mip=dr.texture_construct_mip(tex, 1)), once)
    assert torch.equal(dr.texture(tex, uv, mip_level_bias=level, max_mip_level=0), dr.texture(tex, uv))


@pytest.mark.parametrize(
    ("border", "textures"),
    [
        *(("wrap", 2), ("clamp", 1), ("zero", 2), ("cube", 1)),
        *(
            pytest.param(*rest, marks=pytest.mark.slow)
            for rest in (("wrap", 1), ("clamp", 2), ("zero", 1), ("cube", 2))
        ),
    ],
)
def test_derivatives(border: str, textures: int) -> None:
    cube = border == "cube"
    tex = draws(18, textures, *((6, 4, 4, 2) if cube else (8, 4, 2))).requires_grad_()
    uv = (directions(19, 2, 4, 5) if cube else draws(19, 2, 4, 5, 2, low=-0.3, high=1.3)).requires_grad_()
    uv_da = (draws(20, 2, 4, 5, 6 if cube else 4, low=-1, high=1) * 0.7).requires_grad_()
    bias = draws(21, 2, 4, 5, low=-0.5, high=0.5).requires_grad_()

    def between(tex: Tensor, uv: Tensor, uv_da: Tensor, bias: Tensor) -> Tensor:
        return dr.texture(tex, uv, uv_da, bias, boundary_mode=border)

    assert torch.autograd.gradcheck(between, (tex, uv, uv_da, bias), eps=1e-7, atol=1e-5)

    def linear(tex: Tensor, uv: Tensor) -> Tensor:
        return dr.texture(tex, uv, boundary_mode=border)

    assert torch.autograd.gradcheck(linear, (tex, uv), eps=1e-7, atol=1e-5)
    level = (bias * 4 + 1).detach().requires_grad_()
    assert torch.autograd.gradcheck(
        lambda tex, level: dr.texture(tex, uv.detach(), mip_level_bias=level, boundary_mode=border),
        (tex, level),
        eps=1e-7,
        atol=1e-5,
    )


def test_gradients_of_levels() -> None:
    """Gradients of texture_construct_mip go to the texture, as if made at the call; those of a list stay with its levels."""
    tex, uv = draws(22, 1, 8, 8, 1).requires_grad_(), draws(23, 1, 6, 6, 2)
    level, weight = draws(24, 1, 6, 6, high=3), draws(25, 1, 6, 6, 1)
    (whole,) = torch.autograd.grad((dr.texture(tex, uv, mip_level_bias=level) * weight).sum(), tex)
    mip = dr.texture_construct_mip(tex)
    for _ in range(2):  # no graph of its own that a first call would free
        (again,) = torch.autograd.grad((dr.texture(tex, uv, mip_level_bias=level, mip=mip) * weight).sum(), tex)
        assert torch.equal(whole, again)
    no_levels = dr.texture(tex, uv, mip_level_bias=level, mip=[])
    assert torch.equal(no_levels, dr.texture(tex, uv))
    own = [m.clone().requires_grad_() for m in mip.levels]
    grads = torch.autograd.grad((dr.texture(tex, uv, mip_level_bias=level, mip=own) * weight).sum(), [tex, *own])
    assert all(grad.any() for grad in grads)
    assert torch.isclose(sum(grad.sum() for grad in grads), whole.sum())


def test_nearest_has_texels_gradients_alone() -> None:
    tex, uv = draws(26, 1, 4, 4, 1).requires_grad_(), draws(27, 1, 5, 5, 2).requires_grad_()
    dr.texture(tex, uv, filter_mode="nearest").sum().backward()
    assert tex.grad is not None and tex.grad.sum() == 25 and uv.grad is not None and not uv.grad.any()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"filter_mode": "cubic"}, "filter_mode: expected one of auto, nearest"),
        ({"boundary_mode": "mirror"}, "boundary_mode: expected one of wrap"),
        ({"boundary_mode": "cube"}, "tex: expected shape \\(B, 6, h, h, C\\)"),
        ({"tex": torch.ones(1, 6, 4, 4, 1)}, "tex: expected shape .* boundary_mode='cube'"),
        ({"tex": torch.ones(3, 4, 4, 1)}, "tex: expected 2 textures"),
        ({"uv": torch.ones(2, 3, 3, 3)}, "uv: expected shape"),
        ({"uv": torch.full((2, 3, 3, 2), math.nan)}, "uv: expected finite"),
        ({"uv_da": torch.ones(2, 3, 3, 2)}, "uv_da: expected shape"),
        ({"mip_level_bias": torch.ones(2, 3)}, "mip_level_bias: expected shape"),
        ({"filter_mode": "linear-mipmap-linear"}, "uv_da: expected it, or mip_level_bias"),
        (
            {"tex": torch.ones(1, 12, 8, 1), "mip_level_bias": torch.ones(2, 3, 3)},
            "tex: expected sides .* max_mip_level=2",
        ),
        ({"mip_level_bias": torch.ones(2, 3, 3), "mip": [torch.ones(1, 2, 1, 1)]}, "mip\\[0\\]: expected shape"),
        ({"mip_level_bias": torch.ones(2, 3, 3), "max_mip_level": -1}, "max_mip_level: expected"),
        (
            {"mip_level_bias": torch.ones(2, 3, 3), "max_mip_level": -1, "mip": [torch.ones(1, 2, 2, 1)]},
            "max_mip_level: expected",
        ),
        (
            {"mip_level_bias": torch.ones(2, 3, 3), "mip": dr.texture_construct_mip(torch.ones(1, 8, 8, 1))},
            "mip: expected that of a texture",
        ),
    ],
)
def test_wrong_arguments(change: dict[str, object], words: str) -> None:
    given = {"tex": torch.ones(1, 4, 4, 1), "uv": torch.ones(2, 3, 3, 2)}
    with pytest.raises(ValueError, match=words):
        dr.texture(**(given | change))  # pyright: ignore[reportArgumentType]
