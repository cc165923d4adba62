"""The boundary of what a lens shows, where it folds the image over or ends: its motion with K and the coefficients, against areas
in closed form, outlines in double, and finite differences of the image."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from around import BACKGROUND, ball, moved, pose, room
from finite_differences import Case, check_ratio
from scenes import cube, smooth_adjoint
from threads import check_threads
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
SIZE = (40, 48)
pytestmark = [pytest.mark.watched, pytest.mark.filterwarnings("ignore:distortion")]

# Where det ∂m/∂n = 0 within the image; K takes the lens boundary there to some 16 px.
COEFFICIENTS = {
    "fold": ("perspective", [-0.3, -0.02, 0.0, 0.0, 0.001, 0.0, 0.0, 0.0]),
    "rational": ("perspective", [-0.2, 0.01, 0.0, 0.0, 0.0, 0.15, 0.05, 0.01]),
    "decentred": ("perspective", [-0.3, -0.02, 0.03, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "fisheye": ("fisheye", [-0.3, 0.02, 0.01, -0.01]),
    "wide fisheye": ("fisheye", [-0.09, 0.0, 0.001, 0.0]),  # folds at 112°
    "all around": ("fisheye", [-0.02, 0.001, 0.0, 0.0]),  # ends at 180°
}
LENSES = list(COEFFICIENTS)
RADIAL = [name for name in LENSES if name != "decentred"]


def distorted(lens: str, d: Tensor, n: Tensor) -> Tensor:
    """m (N, 2) of directions (N, 2) with their angle to the axis, or its tangent, as length: OpenCV's formulas."""
    if COEFFICIENTS[lens][0] == "fisheye":
        s = (n * n).sum(-1, keepdim=True)
        return n * (1 + s * (d[0] + s * (d[1] + s * (d[2] + s * d[3]))))
    x, y = n.unbind(-1)
    s, xy = x * x + y * y, 2 * x * y
    g = (1 + s * (d[0] + s * (d[1] + s * d[4]))) / (1 + s * (d[5] + s * (d[6] + s * d[7])))
    shift = torch.stack([d[2] * xy + d[3] * (s + 2 * x * x), d[2] * (s + 2 * y * y) + d[3] * xy], -1)
    return g[..., None] * n + shift


def circle(r: float, count: int) -> Tensor:
    a = torch.arange(count, dtype=F64) * (2 * math.pi / count)
    return r * torch.stack([a.cos(), a.sin()], -1)


def area_scale(lens: str, d: Tensor, n: Tensor) -> Tensor:
    n = n.clone().requires_grad_()
    m = distorted(lens, d, n)
    x, y = (torch.autograd.grad(m[:, i].sum(), n, retain_graph=True)[0] for i in (0, 1))
    return x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]


def boundary_radius(lens: str, d: Tensor) -> float:
    """The least at which the area scale is zero, at one of 16 angles; or 180°."""
    last = math.pi if COEFFICIENTS[lens][0] == "fisheye" else 2.0
    low, high = 0.0, last
    for _ in range(8):
        radii = torch.linspace(low, high, 65, dtype=F64)
        flat = area_scale(lens, d, torch.cat([circle(float(r), 16) for r in radii])).reshape(-1, 16)
        folds = (flat <= 0).any(1)
        if not folds.any():
            return last
        first = int(folds.nonzero()[0])
        low, high = float(radii[first - 1]), float(radii[first])
    return low


def outline(lens: str, K: Tensor, d: Tensor, count: int = 1000) -> Tensor:
    return distorted(lens, d, circle(boundary_radius(lens, d), count)) @ K[:2, :2].mT + K[:2, 2]


def area(points: Tensor) -> Tensor:
    x, y = points.unbind(-1)
    return 0.5 * (x * y.roll(-1) - y * x.roll(-1)).sum().abs()


def camera(lens: str, mirror: int = 1) -> eg.Camera:
    """The lens boundary lies within the image, as an ellipse of 16 px."""
    kind, c = COEFFICIENTS[lens]
    d = torch.tensor(c, dtype=F64)
    K = torch.eye(3, dtype=F64)
    size = float((area(outline(lens, K, d)) / math.pi).sqrt())
    K[:2] = torch.tensor([[16.0 / size, 1.0 / size, 23.1], [-0.5 / size, 17.0 * mirror / size, 19.7]], dtype=F64)
    if kind == "fisheye":
        return eg.Camera.fisheye(pose()[:3, :3], pose()[:3, 3], K, SIZE, d)
    return eg.Camera.from_opencv(pose()[:3, :3], pose()[:3, 3], K, SIZE, d)


def white_room() -> eg.Mesh:
    return eg.Mesh(cube(40.0).verts, cube(40.0).faces, colors=torch.ones((8, 1), dtype=F64))


def derivative(value: Callable[[Tensor, Tensor], Tensor], view: eg.Camera) -> tuple[Tensor, Tensor]:
    """Return central differences, without noise, by K (2, 3) and by the coefficients."""
    step, out = 1e-6, []
    for which, origin in enumerate((view.K, view.coefficients)):
        rows = torch.zeros_like(origin)
        for i in range(origin.numel() if which else 6):
            values = []
            for h in (step, -step):
                leaves = [view.K.clone(), view.coefficients.clone()]
                leaves[which].view(-1)[i] += h
                values.append(value(*leaves))
            rows.view(-1)[i] = (values[0] - values[1]) / (2 * step)
        out.append(rows)
    return out[0][:2], out[1]


def found(view: eg.Camera, loss: Callable[[Tensor], Tensor], scene: eg.Scene, **options: object) -> list[Tensor]:
    K, d = view.K.clone().requires_grad_(), view.coefficients.clone().requires_grad_()
    image = eg.render(scene, view.replace(K=K, distortion=d), 4, **{"seed": 0, **options})  # type: ignore[arg-type]
    K_bar, d_bar = torch.autograd.grad(loss(image), [K, d])
    return [K_bar[:2], d_bar]


def check(gradient: Tensor, truth: Tensor, relative: float = 2e-3) -> None:
    torch.testing.assert_close(gradient, truth, rtol=relative, atol=relative * float(truth.abs().max()))


@pytest.mark.parametrize(
    ("lens", "mirror"),
    [
        *(("fold", 1), ("decentred", 1), ("wide fisheye", -1)),
        *(pytest.param(lens, 1, marks=pytest.mark.slow) for lens in LENSES if lens not in ("fold", "decentred")),
        pytest.param("decentred", -1, marks=pytest.mark.slow),
    ],
)
def test_area(lens: str, mirror: int) -> None:
    """A white room before grey is an ellipse, for what is radial π |det K| ρ²: its area, and the derivative of that."""
    view = camera(lens, mirror)
    scene = eg.Scene([white_room()], torch.full((1,), 0.25, dtype=F64))
    image = eg.render(scene, view, 256, seed=0)
    inside = area(outline(lens, view.K, view.coefficients))
    assert float(image.sum()) == pytest.approx(float(0.75 * inside + 0.25 * image.numel()), rel=1e-3)
    truth = derivative(lambda K, d: 0.75 * area(outline(lens, K, d)), view)
    for gradient, expected in zip(found(view, torch.sum, scene), truth, strict=True):
        check(gradient, expected)


@pytest.mark.parametrize("lens", RADIAL)
def test_area_in_closed_form(lens: str) -> None:
    """∂(π |det K| ρ²)/∂c = 2 π |det K| ρ ∂ρ/∂c, with ∂ρ/∂c at the fixed radius r of the fold."""
    view = camera(lens)
    d = view.coefficients
    r = boundary_radius(lens, d)
    c = d.clone().requires_grad_()
    rho = distorted(lens, c, torch.tensor([[r, 0.0]], dtype=F64))[0, 0]
    truth = torch.autograd.grad(math.pi * torch.linalg.det(view.K) * rho**2, c)[0]
    gradient = found(view, torch.sum, eg.Scene([white_room()], torch.zeros(1, dtype=F64)))[1]
    truth[2:4] = gradient[2:4] if COEFFICIENTS[lens][0] == "perspective" else truth[2:4]  # zero by symmetry
    check(gradient, truth)


@pytest.mark.slow
@pytest.mark.unwatched
@pytest.mark.parametrize(
    ("lens", "filter"), [*((lens, "box") for lens in LENSES), ("fold", "gaussian"), ("all around", "gaussian")]
)
def test_line_integral_in_a_crop(lens: str, filter: str) -> None:
    """∮ Ã δx · N dθ over that part of the outline that a crop shows, with Ã from the filter's own formula."""
    part = (3, 15, 18, 21)  # y, x, height, width: all of an arc's border lies inside
    view = camera(lens).crop(*part)
    K, d = view.K, view.coefficients
    adjoint = smooth_adjoint(*view.size, 1)
    points = outline(lens, K, d, 5_000)
    tangent = 0.5 * (points.roll(-1, 0) - points.roll(1, 0))
    normal = torch.stack([tangent[:, 1], -tangent[:, 0]], -1) * torch.linalg.det(K[:2, :2]).sign()
    weight = filtered(adjoint, points.numpy(), filter)[:, None] * normal
    truth = derivative(lambda K, d: (weight * outline(lens, K, d, 5_000)).sum(), view)
    scene = eg.Scene([white_room()], torch.zeros(1, dtype=F64))
    for gradient, expected in zip(
        found(view, lambda image: (image * adjoint).sum(), scene, filter=filter, sampling=eg.Sampling(edges=20_000)),
        truth,
        strict=True,
    ):
        check(gradient, expected, 5e-3)


def filtered(adjoint: Tensor, x: np.ndarray, filter: str) -> Tensor:
    """Ã at places (N, 2): each pixel's adjoint times the filter around its centre."""
    H, W = adjoint.shape[:2]

    def weight(offset: np.ndarray) -> np.ndarray:
        if filter == "box":
            return (np.abs(offset) <= 0.5).astype(float)
        inside = math.erf(3 / math.sqrt(2))  # σ = ½, cut at 3 σ
        return np.where(np.abs(offset) <= 1.5, np.exp(-2 * offset**2) / (math.sqrt(2 * math.pi) * 0.5 * inside), 0.0)

    across, down = (weight(x[:, i, None] - (np.arange(n) + 0.5)) for i, n in ((0, W), (1, H)))
    return torch.from_numpy(np.einsum("nj,ni,ji->n", down, across, adjoint[..., 0].numpy()))


# -- a scene that is not of one colour ----------------------------------------------------------------------------------


def balls(dx: Tensor | float = 0.0) -> eg.Scene:
    """A coloured room, and balls before the lens boundary of any lens: right, left and behind."""
    places = [(1.5, 0.2, 1.1), (-2.2, 0.3, 0.4), (0.4, 2.0, -1.0), (0.1, 0.2, -2.5)]
    return eg.Scene([*(ball(place) for place in places), room(dx)], BACKGROUND)


def case(lens: str, what: str) -> Case:
    """One number moves, a coefficient so that the lens boundary moves by some pixels."""
    view = camera(lens).crop(5, -3, 38, 40)
    if what[0] != "d":
        return moved(balls, view, what)
    change = torch.zeros_like(view.coefficients)
    change[int(what[1])] = 1e-4
    before, after = (outline(lens, view.K, d) for d in (view.coefficients, view.coefficients + change))
    change *= 8.0 / float((after - before).norm(dim=1).max())

    def distortion(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        return balls(), view.replace(distortion=view.coefficients + theta * change)

    return distortion


@pytest.mark.slow
@pytest.mark.unwatched
@pytest.mark.parametrize(("lens", "what"), [("fold", "d0"), ("decentred", "K02"), ("all around", "d0")])
def test_finite_differences(lens: str, what: str) -> None:
    check_ratio(case(lens, what), 0.01, spp=512, seeds=3, sampling=eg.Sampling(surface=100_000))


@pytest.mark.slow
@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("what", ["d0", "d1", "d2", "K00", "K02", "vertices"])
def test_every_finite_difference(lens: str, what: str) -> None:
    check_ratio(case(lens, what), 0.01, spp=4096, seeds=6, sampling=eg.Sampling(surface=200_000))


# -- all modes of differentiation ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", ["decentred", "wide fisheye"])
def test_forward_mode_and_gradient_by_place(lens: str) -> None:
    """The room is white, so that nothing but the lens boundary moves."""
    view, scene = camera(lens), eg.Scene([white_room()], torch.zeros(1, dtype=F64))
    adjoint = smooth_adjoint(*SIZE, 1)
    reverse = found(view, lambda image: (image * adjoint).sum(), scene, sampling=eg.Sampling(edges=20_000))
    K_dot = torch.tensor([[0.3, 0.1, -0.5], [0.0, 0.2, 0.4], [0.0, 0.0, 0.0]], dtype=F64)
    d_dot = 0.01 * torch.linspace(1, 2, len(view.coefficients), dtype=F64)

    def image(K: Tensor, d: Tensor) -> Tensor:
        return eg.render(scene, view.replace(K=K, distortion=d), 4, sampling=eg.Sampling(edges=20_000), seed=0)

    forward = torch.func.jvp(image, (view.K, view.coefficients), (K_dot, d_dot))[1]
    expected = float((reverse[0] * K_dot[:2]).sum() + (reverse[1] * d_dot).sum())
    assert float((forward * adjoint).sum()) == pytest.approx(expected, rel=5e-3)
    place = eg.screen_gradient(scene, view, adjoint, sampling=eg.Sampling(edges=20_000), seed=0).sum((0, 1))
    check(place, reverse[0][:, 2], 5e-3)


@pytest.mark.parametrize("lens", ["fold", "all around"])
def test_channels(lens: str) -> None:
    """Alpha is the area, and position jumps from the room to zero."""
    view = camera(lens)
    K, d = view.K.clone().requires_grad_(), view.coefficients.clone().requires_grad_()
    layers = eg.render_aovs(white_room(), view.replace(K=K, distortion=d), ["alpha", "position"], spp=4, seed=0)
    truth = derivative(lambda K, d: area(outline(lens, K, d)), view)
    for gradient, expected in zip(
        torch.autograd.grad(layers["alpha"].sum(), [K, d], retain_graph=True), truth, strict=True
    ):
        check(gradient[: len(expected)], expected)


@pytest.mark.parametrize("lens", ["fold", "all around"])
def test_shader(lens: str) -> None:
    """The gradient is that without a shader. The places of samples show something: a ray goes there."""
    scene = eg.Scene([white_room()], torch.full((1,), 0.25, dtype=F64))
    view, adjoint = camera(lens), smooth_adjoint(*SIZE, 1)
    expected = found(view, lambda image: (image * adjoint).sum(), scene, sampling=eg.Sampling(edges=20_000))

    def plain(hits: eg.points.Hits) -> Tensor:
        return torch.ones((len(hits), 1), dtype=F64)

    for gradient, truth in zip(
        found(view, lambda image: (image * adjoint).sum(), scene, sampling=eg.Sampling(edges=20_000), shader=plain),
        expected,
        strict=True,
    ):
        check(gradient, truth, 5e-3)
    primary = eg.points.primary_hits(scene, view.replace(K=view.K.clone().requires_grad_()), seed=0)
    samples = eg.points.edge_samples(primary, creases=False)
    assert len(samples) > 500 and len(samples.hits) == len(samples)
    assert bool(primary.context.sampler.rays_at(samples.x).along.isfinite().all())


# -- where it costs nothing ---------------------------------------------------------------------------------------------


def test_plan() -> None:
    view, scene = camera("fold"), eg.Scene([white_room()], torch.zeros(1, dtype=F64))
    verts = scene.meshes[0].verts.clone().requires_grad_()
    wanted = view.replace(K=view.K.clone().requires_grad_())
    term = eg.plan(scene, wanted)["lens boundary"]
    perimeter = 2 * math.pi * 16
    assert term.on and int(term.why.split()[-4]) == pytest.approx(perimeter, rel=0.1)
    row = eg.plan(eg.Scene([scene.meshes[0].replace(verts=verts)]), view)["lens boundary"]
    assert not row.on and row.why == "neither K nor distortion requires a gradient"
    assert eg.plan(scene, view)["lens boundary"].why == "neither verts nor the camera require a gradient"
    assert eg.plan(scene, wanted.crop(15, 18, 8, 9))["lens boundary"].why == "no lens ends in view"
    assert eg.plan(scene, wanted, visibility=False)["lens boundary"].why == "visibility=False"
    assert (
        eg.plan(scene, wanted.replace(distortion=torch.zeros(8, dtype=F64)))["lens boundary"].why
        == "no lens ends in view"
    )


def test_same_bits_at_any_number_of_threads() -> None:
    check_threads(lambda: found(camera("wide fisheye"), torch.sum, balls()))
