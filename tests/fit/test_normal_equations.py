"""Normal equations of a pose search, and its Gauss-Newton steps, on linear problems."""

import math

import torch

from edgegrad.fit.pose.gauss_newton import GaussNewton, NormalEquations


def test_the_curvature_from_probes():
    """Their mean is JᵀJ: for 24 probes the relative error is about √(2/24) = 0.29 an entry on the diagonal."""
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(4000, 3, generator=generator).double()
    p = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    found = [NormalEquations.from_probes(p, [J @ p + 1.0], 24, generator) for _ in range(50)]
    mean = torch.stack([one.curvature for one in found]).mean(0)
    # 1200 probes: √(2/1200) = 0.04; four of it.
    assert float((mean - J.T @ J).norm() / (J.T @ J).norm()) < 0.16
    torch.testing.assert_close(found[0].gradient, J.sum(0))


def test_the_normal_equations_of_several_images():
    generator = torch.Generator().manual_seed(0)
    tangents = [torch.randn(3, *shape, generator=generator) for shape in ((4, 5, 2), (6, 3, 2))]
    residuals = [torch.randn(J.shape[1:], generator=generator) for J in tangents]
    curvature, gradient = NormalEquations.from_tangents(residuals, tangents)
    J = torch.cat([one.flatten(1) for one in tangents], 1).double()
    torch.testing.assert_close(curvature, J @ J.T)
    torch.testing.assert_close(gradient, J @ torch.cat([r.flatten() for r in residuals]).double())


def test_gauss_newton_goes_to_the_minimum_and_back_from_a_rise():
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(500, 3, generator=generator).double() * torch.tensor([1.0, 0.2, 3.0]).double()
    truth, at = torch.tensor([0.2, -0.3, 0.1]).double(), torch.zeros(3).double()
    search = GaussNewton()

    def refused():
        raise AssertionError

    for _ in range(40):
        r = J @ (at - truth)
        assert search.observe(float(r.square().mean()), lambda r=r: NormalEquations.from_tangents([r], [J.T]))
        at = at + search.step()
    assert float((at - truth).norm()) < 1e-3
    damping = search.damping
    assert not search.observe(1e6, refused) and search.damping > damping
    assert not search.observe(math.nan, refused)
