"""Losses and regularizers against their formulas."""

import math

import pytest
import torch

from edgegrad.fit import losses, regularizers


def test_losses_equal_their_formulas():
    a, b = torch.tensor([[[0.5, 0.0]]]), torch.tensor([[[0.2, 0.4]]])  # 1 pixel, 2 channels: r = 0.3, −0.4
    assert float(losses.l1(a, b)) == pytest.approx(0.35)
    assert float(losses.l2(a, b)) == pytest.approx(0.125)
    assert float(losses.huber(a, b, scale=0.1)) == pytest.approx(0.1 * (0.25 + 0.35) / 2)
    x2 = [9.0, 16.0]  # (r / 0.1)²
    assert float(losses.robust(a, b, scale=0.1, alpha=2.0)) == pytest.approx(sum(x2) / 4)
    assert float(losses.robust(a, b, scale=0.1, alpha=0.0)) == pytest.approx(sum(math.log1p(x / 2) for x in x2) / 2)
    assert float(losses.robust(a, b, scale=0.1)) == pytest.approx(sum(2 * x / (x + 4) for x in x2) / 2)
    welsch = losses.robust(a, b, scale=0.1, alpha=-math.inf)
    assert float(welsch) == pytest.approx(sum(1 - math.exp(-x / 2) for x in x2) / 2)
    assert float(losses.robust(a, b, scale=0.1, alpha=1.0)) == pytest.approx(sum(math.sqrt(x + 1) - 1 for x in x2) / 2)
    masks = torch.tensor([[[1.0], [0.5], [0.0]]]), torch.tensor([[[0.5], [0.5], [1.0]]])
    assert float(losses.iou(*masks)) == pytest.approx(1.0 - 1.0 / 2.5)


@pytest.mark.parametrize("name", losses.LOSSES)
def test_losses_vanish_at_the_target_and_heed_weights(name):
    loss = losses.LOSSES[name]
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 16, 16, 3, generator=g), torch.rand(2, 16, 16, 3, generator=g)
    assert abs(float(loss(target, target, None))) < 1e-6 < 0.01 < float(loss(image, target, None))
    if name == "iou":  # of one channel
        image, target = image[..., :1], target[..., :1]
    weight = torch.ones(2, 16, 16, 1)
    assert float(loss(image, target, weight)) == pytest.approx(float(loss(image, target, None)), rel=1e-5)
    malformed = image.clone()
    malformed[:, :8] = 5.0
    weight[:, :8] = 0.0
    assert float(loss(malformed, target, weight)) == pytest.approx(float(loss(image, target, weight)), rel=1e-5)


def test_a_multiscale_loss_sees_further_than_a_pixel():
    """The two dots do not touch, so only coarse levels see that one of them is nearer."""
    x = torch.arange(32.0)

    def dot(at):
        return torch.exp(-0.5 * ((x - at) / 0.7) ** 2)[None, :, None].expand(32, -1, 1)

    ratios = [float(f(dot(16.0), dot(20.0)) / f(dot(8.0), dot(20.0))) for f in (losses.l2, losses.multiscale())]
    assert ratios[0] > 0.999 and ratios[1] < 0.9
    weight = torch.ones(32, 32, 1)
    assert float(losses.multiscale()(dot(10.0), dot(16.0), weight)) == pytest.approx(
        float(losses.multiscale()(dot(10.0), dot(16.0))), rel=1e-4
    )


def test_regularizers_equal_their_formulas():
    flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    assert float(regularizers.normal_consistency(flat, faces)) == pytest.approx(0.0, abs=1e-12)
    bent = flat.clone()
    bent[3] = torch.tensor([0.5, 0.5, 0.5**0.5])  # by 90°
    assert float(regularizers.normal_consistency(bent, faces)) == pytest.approx(1.0)
    tetrahedron = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double()
    sides = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    assert float(regularizers.edge_length(tetrahedron, sides)) == pytest.approx(0.0, abs=1e-12)
    # v − the mean of the others is 4/3 v, |v|² = 3; edges have length √8.
    assert float(regularizers.laplacian(tetrahedron, sides)) == pytest.approx(16 / 9 * 3 / 8)
    assert regularizers.edges(sides).shape == (6, 2) and regularizers.edge_pairs(sides).shape == (6, 2)
    for function in (regularizers.laplacian, regularizers.edge_length, regularizers.normal_consistency):
        assert float(function(3.0 * bent, faces)) == pytest.approx(float(function(bent, faces)))  # no units
    assert float(regularizers.total_variation(torch.ones(4, 4, 3))) == 0.0
    assert float(regularizers.total_variation(torch.eye(2)[..., None])) == pytest.approx(2.0)
