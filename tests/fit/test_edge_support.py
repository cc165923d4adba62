"""The share of a render's edges that a picture shows distinguishes a right fit from a wrong one."""

import pytest
import torch
from brackets import BACKGROUND, bracket, camera

import edgegrad as eg
from edgegrad.fit.edge_support import _gradient, edge_support, picture_noise


def test_picture_noise_is_that_of_the_picture():
    g = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    picture = torch.stack([x, y, (x > 0.5).float()], -1) + 0.03 * torch.randn(64, 64, 3, generator=g)
    torch.testing.assert_close(picture_noise(picture), torch.full((3,), 0.03), rtol=0.1, atol=0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_edge_support_decreases_with_misplacement(noise):
    view, g = camera(96), torch.Generator().manual_seed(0)
    scene = eg.Scene([bracket()], BACKGROUND)
    a, b = (eg.render(scene, view, spp=64, seed=s) for s in (1, 2))

    def share(pixels):
        K = view.K.clone()
        K[:2, 2] += pixels
        picture = eg.render(scene, view.replace(K=K), spp=64, seed=3)
        return edge_support([(a, b, picture + noise * torch.randn(picture.shape, generator=g), None)])

    shares = [share(pixels) for pixels in (0.0, 0.5, 2.0, 8.0)]
    assert shares[0] > 0.95 and shares == sorted(shares, reverse=True) and shares[1] > 0.6 and shares[2] < 0.5, shares


def test_a_channel_missing_in_the_picture_counts_by_the_edges_of_the_render():
    """If the only blue object is covered, its edge is missing and the others are not."""
    render = torch.zeros(32, 32, 3)
    render[8:24, 8:24, :2] = 1.0
    render[12:14, 12:14, 2] = 1.0
    picture = render.clone()
    picture[10:16, 10:16] = torch.tensor([1.0, 1.0, 0.0])
    picture[0, 0, 2] = 1e-3  # that nothing else of the channel is there does not make it larger
    share = edge_support([(render, render, picture, None)])
    edges = [float(_gradient(render[..., k : k + 1]).norm(dim=0).sum()) for k in range(3)]
    assert share == pytest.approx((edges[0] + edges[1]) / sum(edges), abs=1e-3) and share > 0.8
