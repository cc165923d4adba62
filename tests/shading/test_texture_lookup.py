"""The kernel's texture look-up against its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from adjoints import check_vjp, random
from kernel_parts import parts

from edgegrad.points.pyramid import Pyramid
from edgegrad.scene.textures import bilinear

pytestmark = [pytest.mark.quick, pytest.mark.watched]


def texels(height: int = 4, width: int = 5, channels: int = 3) -> np.ndarray:
    return random(height, width, channels, seed=3)


def texel_centre(row: int, column: int, height: int, width: int) -> tuple[float, float]:
    return (column + 0.5) / width, 1 - (row + 0.5) / height


def test_texture_has_its_texels_at_their_centres():
    """Row 0 on top, where v is largest; repeated on all sides."""
    texture = texels()
    for row, column in np.ndindex(texture.shape[:2]):
        u, v = texel_centre(row, column, 4, 5)
        for i, j in [(0, 0), (1, -2), (-3, 5)]:
            np.testing.assert_allclose(parts.texture_eval(texture, [u + i, v + j]), texture[row, column], atol=1e-13)


def test_texture_is_linear_between_texels():
    texture = texels()
    u, v = texel_centre(1, 2, 4, 5)
    value = parts.texture_eval(texture, [u + 0.25 / 5, v - 0.6 / 4])  # a quarter to the right, 0.6 down
    upper = 0.75 * texture[1, 2] + 0.25 * texture[1, 3]
    lower = 0.75 * texture[2, 2] + 0.25 * texture[2, 3]
    np.testing.assert_allclose(value, 0.4 * upper + 0.6 * lower, rtol=1e-13)


@pytest.mark.parametrize("uv", [(0.33, 0.71), (0.02, 0.97), (-1.37, 2.11), (0.995, 0.005)])
@pytest.mark.parametrize("shape", [(4, 5, 3), (1, 1, 2), (1, 7, 1), (3, 1, 20)])
def test_texture_eval_vjp(uv, shape):
    def forward(texture, uv):
        return np.array(parts.texture_eval(texture, uv))

    def vjp(texture, uv, bar):
        uv_bar, rows, weights = parts.texture_eval_vjp(texture, uv, bar)
        texture_bar = np.zeros((texture.shape[0] * texture.shape[1], texture.shape[2]))
        np.add.at(texture_bar, rows, np.outer(weights, bar))
        return texture_bar.reshape(texture.shape), uv_bar

    check_vjp(forward, vjp, [texels(*shape), np.array(uv)])


def test_texture_far_out():
    """A coordinate beyond what an integer holds has no fraction left, and must still find a texel."""
    for uv in ([1e30, 0.5], [-1e30, 1e25], [2.0**62, -(2.0**63)]):
        assert np.isfinite(parts.texture_eval(texels(), uv)).all()


@pytest.mark.parametrize("wraps", [("repeat", "mirror"), ("clamp", "repeat"), ("mirror", "clamp")])
def test_pyramids(wraps: tuple[str, str]) -> None:
    """Each point lies between two levels, as lookups in images of their own say; beyond the last level it is one texel."""
    draw = torch.Generator().manual_seed(2)
    image = torch.rand((5, 12, 2), dtype=torch.float64, generator=draw).requires_grad_()
    uv = (5 * torch.rand((40, 2), dtype=torch.float64, generator=draw) - 2).requires_grad_()
    level = (4.5 * torch.rand(40, dtype=torch.float64, generator=draw) - 0.5).requires_grad_()
    levels = [image]
    for size in ((2, 6), (1, 3), (1, 1)):
        pooled = torch.nn.functional.adaptive_avg_pool2d(levels[-1].movedim(-1, 0), size)
        levels.append(pooled.movedim(0, -1))
    tents = [(1 - (level.clamp(0, 3) - k).abs()).clamp(min=0)[:, None] for k in range(4)]
    expected = sum(tent * bilinear(one, uv, wraps) for tent, one in zip(tents, levels, strict=True))
    found = Pyramid.from_texture(image).look_up(level, uv, wraps)
    assert isinstance(expected, torch.Tensor)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-14)
    weights = torch.rand(found.shape, dtype=torch.float64, generator=draw)
    of_found, of_expected = (torch.autograd.grad((v * weights).sum(), (image, uv, level)) for v in (found, expected))
    for own, other in zip(of_found, of_expected, strict=True):
        torch.testing.assert_close(own, other, rtol=0, atol=1e-12)
        assert other.any()


@pytest.mark.parametrize(("size", "channels"), [((8, 4), 1), ((13, 7), 3), ((1, 6), 4), ((5, 1), 5), ((1, 1), 2)])
def test_means_of_pyramids(size: tuple[int, int], channels: int) -> None:
    """Level after level as PyTorch's adaptive pooling has them, with its derivatives; floats as doubles."""
    image = torch.rand((*size, channels), dtype=torch.float64, generator=torch.Generator().manual_seed(4))
    image.requires_grad_()
    levels = [image]
    while max(levels[-1].shape[:2]) > 1:
        half = max(1, levels[-1].shape[0] // 2), max(1, levels[-1].shape[1] // 2)
        levels.append(torch.nn.functional.adaptive_avg_pool2d(levels[-1].movedim(-1, 0), half).movedim(0, -1))
    expected = torch.cat([level.reshape(-1, channels) for level in levels])
    pyramid = Pyramid.from_texture(image)
    assert pyramid.first.tolist() == [sum(a.shape[0] * a.shape[1] for a in levels[:k]) for k in range(len(levels))]
    torch.testing.assert_close(pyramid.texels, expected, rtol=0, atol=1e-15)
    torch.testing.assert_close(Pyramid.from_texture(image.float()).texels, expected.float(), rtol=0, atol=1e-6)
    weights = torch.rand(expected.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(5))
    grads = [torch.autograd.grad((weights * texels).sum(), image)[0] for texels in (pyramid.texels, expected)]
    torch.testing.assert_close(*grads, rtol=0, atol=1e-14)
    along = torch.randn(image.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(6))
    moved = torch.func.jvp(lambda x: Pyramid.from_texture(x).texels, (image.detach(),), (along,))[1]
    assert abs(float((moved * weights).sum() - (grads[0] * along).sum())) < 1e-12
