"""Colours on both sides of contours, and near them, against oracles."""

import pytest
import torch

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.contour_colors import CONTOUR_BLURS, mask_noise
from edgegrad.fit.descent.region_loss import RegionLoss
from edgegrad.fit.region import ColorFrequencies, palette, smoothed, smoothed_within
from edgegrad.fit.views import area_mean, region_views, views_of


def test_the_posterior_separates_colours_near_the_contour_alone():
    """The left object is red on green, the right one green on red: one pair of histograms for the picture would show
    nothing."""
    alpha = torch.zeros(60, 60)
    alpha[20:40, 5:25] = alpha[20:40, 35:55] = 1.0
    red, green = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])
    left = (torch.arange(60) < 30).expand(60, 60)
    image = torch.where(((alpha > 0.5) == left)[..., None], red, green)
    display = linear_to_srgb(image)
    colours = palette(display, 0)
    labels, whole = colours.labels(display), torch.ones(60, 60)
    P, wide = (
        ColorFrequencies.from_labels(labels, colours.colors, alpha[None], whole, radius, 1e-3).posterior[0]
        for radius in (6.0, 1000.0)
    )
    edge = smoothed(alpha[None], 1.5)[0]
    near = (edge > 0.02) & (edge < 0.98)
    assert float(P[near & (alpha > 0.5)].min()) > 0.8 and float(P[near & (alpha < 0.5)].max()) < 0.2
    assert float(wide[near & (alpha > 0.5)].min()) < 0.6


@pytest.mark.quick
def test_what_the_border_cuts_has_no_edge_there():
    """A half plane is the same beyond the border, so its blur in a part of the picture is that in the whole."""
    whole = (torch.arange(40) < 17).float().expand(1, 60, 40)
    part = whole[:, 20:35]
    torch.testing.assert_close(smoothed_within(part, 2.0)[..., 8:-8], smoothed(whole, 2.0)[:, 20:35, 8:-8])
    assert float(smoothed_within(torch.ones(1, 9, 9), 2.0).min()) == pytest.approx(1.0)


def test_the_noise_of_a_mask_is_that_of_its_pixels():
    """A mask of a disc holds zeros and ones also where a pixel is mixed; it is taken whole and reduced."""
    n, fine = 96, (torch.arange(960) + 0.5) / 10
    disc = (fine - 47.4).square() + (fine[:, None] - 48.3).square() < 37.3**2
    exact = area_mean(disc[..., None].float(), (n, n))[..., 0]
    hard = (exact > 0.5).float()
    for factor, size in ((1.0, n), (1 / 3, n // 3)):
        right, seen = (area_mean(one[..., None], (size, size))[..., 0] for one in (exact, hard))
        off = (seen - right)[(right > 0.02) & (right < 0.98)].square().mean().sqrt()
        assert mask_noise(hard, factor) == pytest.approx(float(off), rel=0.3), factor
    assert mask_noise(exact, 1.0) == mask_noise(smoothed(hard[None], 0.7)[0], 1.0) == 0.0


@pytest.mark.parametrize("blur", CONTOUR_BLURS)
def test_how_sharp_a_contour_is(blur):
    """A noisy disc lies before something dark. The blur that it was taken with leaves the smallest residual."""
    n = 64
    y, x = torch.meshgrid(torch.arange(n) + 0.5, torch.arange(n) + 0.5, indexing="ij")
    alpha = (17.3 - ((x - 31.6).square() + (y - 32.2).square()).sqrt()).add(0.5).clamp(0.0, 1.0)
    front, behind = (srgb_to_linear(torch.tensor(colour)) for colour in ((0.9, 0.6, 0.1), (0.1, 0.15, 0.2)))
    mixed = smoothed(alpha[None], blur)[0][..., None]
    noise = 0.02 * torch.randn(n, n, 3, generator=torch.Generator().manual_seed(0))
    display = linear_to_srgb(srgb_to_linear(linear_to_srgb(mixed * front + (1 - mixed) * behind) + noise).clamp(0, 1))
    view = eg.Camera(torch.eye(4), torch.eye(3), (n, n))
    regions = RegionLoss(region_views(views_of(view, srgb_to_linear(display))), 0)
    regions.renew(0, alpha[..., None])
    assert regions.blur == blur
