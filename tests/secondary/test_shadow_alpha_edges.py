"""Shadows of alpha edges: of a rectangle of which a ramp of alpha leaves a part, in closed form, and of curved alpha edges
against finite differences."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from alpha_masks import disc, quad
from finite_differences import Case, check, estimate
from finite_differences import gradient as derivative
from lit_scenes import by_quadrature, from_above, plane
from test_shadows import LIGHTS, exact, gradient, of_panel, of_sky, panel, sky, vector
from test_shadows import Setting as Whole
from threads import check_threads
from torch import Tensor
from torch.autograd import forward_ad

import edgegrad as eg

pytestmark = pytest.mark.watched


class Setting(Whole):
    """The rectangle is there where alpha, from one texel to the next, is at least ½."""

    filter = "linear"
    wrap = "clamp"

    def __init__(self) -> None:
        super().__init__()
        self.u = vector(0.07, 0.9, 1.0, 0.15)  # of the corners: the alpha edge is parallel to no side
        self.alpha = vector(0.1, 0.8)

    def scene(self, lights: Callable[[Whole], object]) -> eg.Scene:
        scene = super().scene(lights)
        ground, caster, *others = scene.meshes
        uvs = torch.stack([self.u, vector(0.1, 0.1, 0.9, 0.9)], 1)
        masked = {"alpha": self.alpha.expand(1, 2), "filter": self.filter, "wrap": self.wrap}
        return scene.replace(meshes=[ground, caster.replace(uvs=uvs, uv_faces=caster.faces, **masked), *others])

    def outline(self) -> Tensor:
        """The alpha edge runs from the side 01 over the diagonal 02 to the side 32."""
        c, u, (low, high) = self.corners, self.u, self.alpha
        edge = vector(0.5) if self.filter == "nearest" else 0.25 + 0.5 * (0.5 - low) / (high - low)

        def on(i: int, j: int) -> Tensor:
            return c[i] + (edge - u[i]) / (u[j] - u[i]) * (c[j] - c[i])

        return torch.stack([on(0, 1), c[1], c[2], on(3, 2), on(0, 2)])


class Nearest(Setting):
    filter = "nearest"


class Repeated(Nearest):
    """The rectangle ends between texels: there is a border there, too, but nothing beyond."""

    wrap = "repeat"

    def __init__(self) -> None:
        super().__init__()
        self.u = vector(0, 1, 1, 0)


class Seam(Setting):
    """The first triangle of the rectangle is opaque and the second masked, up to the diagonal."""

    def scene(self, lights: Callable[[Whole], object]) -> eg.Scene:
        scene = super().scene(lights)
        ground, caster, *others = scene.meshes
        uvs, uv_faces = vector(0.9, 0.95, 0.05, 0.1)[:, None].expand(-1, 2), torch.tensor([[0, 1, 0], [2, 3, 2]])
        return scene.replace(meshes=[ground, caster.replace(uvs=uvs, uv_faces=uv_faces), *others])

    def outline(self) -> Tensor:
        return self.corners[:3]


Setting.motions = {
    **Whole.motions,
    "alpha rises": lambda s, t: setattr(s, "alpha", s.alpha + t * vector(0.3, 1.0)),
    "u moves": lambda s, t: setattr(s, "u", s.u + t * vector(0.2, -0.7, -0.4, 0.5)),
}
FAST = ("one corner", "light moves", "ground rises", "alpha rises", "u moves")
# All of them by one light, and what each light makes of its own.
MOTIONS = [
    pytest.param(m, light, marks=[] if (m in FAST and light == "point") or m == "light moves" else pytest.mark.slow)
    for m in Setting.motions
    for light in LIGHTS
]


@pytest.mark.unwatched
@pytest.mark.parametrize(("motion", "light"), MOTIONS)
def test_shadow_of_an_alpha_edge(motion: str, light: str) -> None:
    found = estimate(
        [gradient(motion, LIGHTS[light], seed, Setting, sampling=eg.Sampling(edges=6_000)) for seed in range(4)]
    )
    check(f"{light}, {motion}", exact(motion, infinite=light == "sun", kind=Setting), found)


@pytest.mark.parametrize("kind", [Repeated, Seam])
@pytest.mark.parametrize("motion", ["one corner", "light moves"])
def test_shadow_of_alpha_edges_along_edges(motion: str, kind: type[Setting]) -> None:
    found = estimate(
        [gradient(motion, LIGHTS["point"], seed, kind, sampling=eg.Sampling(edges=12_000)) for seed in range(4)]
    )
    check(f"{kind.__name__}, {motion}", exact(motion, kind=kind), found)


@pytest.mark.parametrize("motion", ["one corner", "u moves"])
def test_shadow_of_nearest_texels(motion: str) -> None:
    found = estimate(
        [gradient(motion, LIGHTS["point"], seed, Nearest, sampling=eg.Sampling(edges=12_000)) for seed in range(4)]
    )
    check(f"nearest, {motion}", exact(motion, kind=Nearest), found)


@pytest.mark.parametrize(
    "motion",
    [m if m in ("light moves", "u moves") else pytest.param(m, marks=pytest.mark.slow) for m in Setting.motions],
)
def test_penumbra_of_an_alpha_edge(motion: str) -> None:
    found = estimate([gradient(motion, panel, seed, Setting, sampling=eg.Sampling(edges=8_000)) for seed in range(4)])
    check(f"panel, {motion}", of_panel(motion, Setting), found)


@pytest.mark.parametrize("motion", ["alpha rises", "u moves"])
def test_shadow_of_an_alpha_edge_before_an_even_sky(motion: str) -> None:
    found = estimate([gradient(motion, sky, seed, Setting, sampling=eg.Sampling(edges=60_000)) for seed in range(6)])
    check(f"sky, {motion}", of_sky(motion, Setting), found)


# -- against finite differences ------------------------------------------------------------------------------------------


def noise(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)


ASIDE = eg.Camera.look_at((0.2, -2.6, 0.9), (0.0, 0, 0.0), up=(0, 0, 1), fov_y=40, size=(48, 32)).to(torch.float64)


ABOVE = from_above(32, 4.0)


def case(what: str, light: str, mode: str = "MASK", filter: str = "linear", camera: eg.Camera = ABOVE) -> Case:
    """A curved leaf with a disc of it there, tilted over a floor; one camera sees it, the other its shadow alone."""
    leaf = quad(3, alpha=disc(12) if filter == "nearest" else disc(9), filter=filter)
    x, y, _ = leaf.verts.unbind(1)
    leaf = leaf.replace(
        verts=0.6 * torch.stack([x, y, 0.3 * x * x + 0.4 * x], 1) + vector(0.1, 0, 1),
        material=eg.Material(0.3, alpha_mode=mode),
    )
    moved = {
        "verts": lambda t: leaf.replace(verts=leaf.verts + t * (0.1 * noise(len(leaf.verts), 3) + vector(0.2, 0.1, 0))),
        "uvs": lambda t: leaf.replace(uvs=leaf.uvs + t * (0.05 * noise(len(leaf.uvs), 2) + vector(0.2, 0.1))),
        "alpha": lambda t: leaf.replace(alpha=leaf.alpha + t * torch.linspace(0.3, 1, len(leaf.alpha))),
    }

    def at(t: Tensor) -> tuple[eg.Scene, eg.Camera]:
        place = vector(0.3, -0.2, 2.6) + (t * vector(0.6, 0.2, 0.3) if what == "light" else 0)
        lights = {
            "point": lambda: eg.lights.PointLight(place, 10.0),
            "sun": lambda: eg.lights.DirectionalLight(-place, 2.0),
        }
        floor = plane(2.0, material=eg.Material(0.8))
        return eg.Scene([moved.get(what, lambda t: leaf)(t), floor], lights=[lights[light]()]), camera

    return at


FD_CASES = {
    "alpha, point": case("alpha", "point"),
    "verts, sun": case("verts", "sun"),
    "uvs, point": case("uvs", "point"),
    "light, point": case("light", "point"),
    "verts, nearest, point": case("verts", "point", filter="nearest"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", FD_CASES)
def test_curved_alpha_edges(name: str) -> None:
    """Central differences of images by a regular grid of rays."""
    at = FD_CASES[name]
    truth = by_quadrature(at, 0.02, 24)
    found = derivative(at, 6, sampling=eg.Sampling(discontinuity_spacing=1 / 8, edges=8000, surface=20_000))
    assert found.error < 0.005 * abs(truth), f"too noisy to decide: {found}"
    assert abs(found.mean - truth) < 0.02 * abs(truth), f"difference {truth}, gradient {found}"


def test_a_blended_face_casts_the_shadow_of_a_masked_one() -> None:
    options = {"sampling": eg.Sampling(edges=8000, surface=20_000)}
    blended, masked = (
        derivative(case("alpha", "point", mode, camera=ASIDE), 2, **options) for mode in ("BLEND", "MASK")
    )
    assert abs(masked.mean) > 10
    assert abs(blended.mean - masked.mean) < 0.005 * abs(masked.mean)


def seen(alpha: Tensor) -> Tensor:
    """A leaf's shadow alone."""
    floor, leaf = plane(2.0, material=eg.Material(0.8)), quad(alpha=alpha, material=eg.Material(0.3))
    leaf = leaf.replace(verts=0.6 * leaf.verts + vector(0, 0, 1))
    scene = eg.Scene([floor, leaf], lights=[eg.lights.PointLight(vector(0.3, -0.2, 2.6), 10.0)])
    return eg.render(scene, ASIDE, spp=4, seed=0) * torch.linspace(0, 1, 32, dtype=torch.float64)[:, None]


def gradient_of_alpha() -> Tensor:
    alpha = disc(9).requires_grad_()
    return torch.autograd.grad(seen(alpha).sum(), alpha)[0]


def test_same_bits_at_any_number_of_threads() -> None:
    check_threads(lambda: [gradient_of_alpha()])


@pytest.mark.slow
def test_forward_mode_is_reverse_mode() -> None:
    alpha, moved = disc(9), 0.2 + disc(9)
    with forward_ad.dual_level():
        forward = forward_ad.unpack_dual(seen(forward_ad.make_dual(alpha, moved))).tangent
    assert float(forward.sum()) == pytest.approx(float((gradient_of_alpha() * moved).sum()), rel=1e-6)


def test_plan_says_that_alpha_edges_move() -> None:
    floor, leaf = plane(material=eg.Material()), quad(alpha=disc(9), material=eg.Material())
    scene = eg.Scene([floor, leaf], lights=[eg.lights.PointLight(vector(0, 0, 3))])
    assert not eg.plan(scene, ABOVE)["shadow boundaries"].on
    moving = leaf.replace(alpha=disc(9).requires_grad_())
    assert eg.plan(scene.replace(meshes=[floor, moving]), ABOVE)["shadow boundaries"].on
