"""A lens that folds shows nothing beyond its fold, and says so."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from lens_cases import SIZE, camera, check_gradient, colored_sphere, scene
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.operators import kernel_camera
from edgegrad.kernel.request import pack_camera

F64 = torch.float64


FOLD = 1 / math.sqrt(3 * 0.3)  # of r (1 − 0.3 r²)


def folding_camera() -> eg.Camera:
    """Its fold lies at 46°, within the image: m = ⅔ FOLD there, 0.7 of the image's half width."""
    K = torch.tensor([[24.0, 0.0, 23.5], [0.0, 24.0, 19.5], [0.0, 0.0, 1.0]], dtype=F64)
    t = torch.tensor([0.0, 0.0, 3.0], dtype=F64)
    return eg.Camera.from_opencv(torch.eye(3, dtype=F64), t, K, SIZE, torch.tensor([-0.3, 0.0, 0.0, 0.0], dtype=F64))


def test_beyond_a_fold_there_is_background() -> None:
    wall = scene("interior").meshes[0]
    wall = wall.replace(verts=10 * wall.verts, colors=torch.ones((3, 3), dtype=F64))
    with pytest.warns(UserWarning, match=rf"radius {FOLD:.4g} .* {math.degrees(math.atan(FOLD)):.4g}°"):
        image = eg.render(eg.Scene([wall], torch.zeros(3, dtype=F64)), folding_camera(), 256, seed=0)
    area = float(image[..., 0].sum())
    assert area == pytest.approx(math.pi * (24 * FOLD * 2 / 3) ** 2, rel=2e-3)


@pytest.mark.filterwarnings("ignore:distortion")
@pytest.mark.parametrize("what", ["vertices", pytest.param("pose", marks=pytest.mark.slow)])
def test_gradient_before_a_fold(what: str) -> None:
    """The sphere passes the fold: what of it lies beyond is not seen, and has no gradient."""
    view = folding_camera()
    M = view.world_to_camera.clone()
    M[0, 3], M[2, 3] = 1.4, 2.0
    check_gradient("boundary", view.replace(world_to_camera=M), what, spp=4096 if what == "pose" else 640)


def test_a_telephoto_lens_may_fold_near_its_axis() -> None:
    """r (1 + k1 r² + k2 r⁴) is greatest at a thousandth, and rises again soon after."""
    k1, k2 = 1e6, -1e12
    fold = math.sqrt((3 * k1 + math.sqrt(9 * k1**2 - 20 * k2)) / (-10 * k2))
    K = torch.tensor([[24e3, 0, 24], [0, 24e3, 24], [0, 0, 1]], dtype=F64)
    distortion = torch.tensor([k1, k2, 0, 0], dtype=F64)
    view = eg.Camera.from_opencv(torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), K, (48, 48), distortion)
    with pytest.warns(UserWarning, match=rf"radius {fold:.4g} "):
        eg.render(colored_sphere(), view, 1, seed=0)


@pytest.mark.parametrize("gap", [1e-3, 1e-6, -1e-3, -1e-6])
def test_a_rational_lens_may_fold_in_a_narrow_ring(gap: float) -> None:
    """A pole at r = 1.2 and a zero next to it, apart from which the lens is nearly a pinhole: the slope's numerator by NumPy."""
    A, B = np.polynomial.Polynomial([1, -1 / (1.44 * (1 + gap))]), np.polynomial.Polynomial([1, -1 / 1.44])
    s = np.polynomial.Polynomial([0, 1])
    slope = A * B + 2 * s * (A.deriv() * B - A * B.deriv())
    turns = [x.real for p in (A, B, slope) for x in p.roots() if abs(x.imag) < 1e-9 and x.real > 0]
    K = torch.tensor([[12.0, 0, 24], [0, 12, 24], [0, 0, 1]], dtype=F64)
    distortion = torch.tensor([A.coef[1], 0, 0, 0, 0, B.coef[1], 0, 0], dtype=F64)
    view = eg.Camera.from_opencv(torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), K, (48, 48), distortion)
    kernel = kernel_camera(pack_camera(view))
    assert math.tan(kernel.end) == pytest.approx(math.sqrt(min(turns)), rel=1e-9)


def test_the_warning_comes_once_a_line_and_points_there() -> None:
    """The warning passes operators, modules and whatever else lies between. Fits that move the distortion get it once."""
    view, sphere = folding_camera(), colored_sphere()
    d = view.coefficients.clone().requires_grad_()

    class Renders(torch.nn.Module):
        def forward(self, view: eg.Camera) -> Tensor:
            return eg.render(sphere, view, 1, seed=0)  # the first line

    def sample(view: eg.Camera) -> Tensor:
        return eg.render(sphere, view, 1, shader=lambda hits: hits.normal, seed=0)  # the second

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for step in range(3):
            distorted = view.replace(distortion=d * (1 - 0.01 * step))
            Renders()(distorted).sum().backward(retain_graph=True)
            sample(distorted).sum().backward()
    first = Renders.forward.__code__.co_firstlineno
    assert [w.filename for w in told] == [__file__] * 2
    assert [w.lineno for w in told] == [first + 1, sample.__code__.co_firstlineno + 1]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        for part in (1.0, 0.9):
            Renders()(view.replace(distortion=part * view.coefficients))
    assert [f"radius {FOLD / math.sqrt(part):.4g} " in str(w.message) for w, part in zip(told, (1, 0.9), strict=True)]


def test_no_warning_where_the_fold_lies_outside() -> None:
    eg.render(colored_sphere(), camera("four"), 1, seed=0)  # pytest turns warnings into errors
