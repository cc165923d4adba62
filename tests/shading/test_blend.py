"""Alpha-blended surfaces: images and gradients against what layers over one another give."""

from __future__ import annotations

import pytest
import torch
from alpha_masks import disc, quad
from finite_differences import gradient as derivative
from finite_differences import rotation
from lit_scenes import from_above, plane, vector
from scenes import cube
from torch import Tensor

import edgegrad as eg
from edgegrad.points.discontinuity_terms import DiscontinuityTerms

F64 = torch.float64
RADIANCES = (0.9, 0.5, 0.2, 0.7)


def sheet(height: float, radiance: Tensor | float, alpha: Tensor | float, size: float = 4.0) -> eg.Mesh:
    """At z = height, that emits and scatters nothing."""
    mesh = plane(size)
    alpha = (
        torch.as_tensor(alpha, dtype=F64).expand(1, 1) if not isinstance(alpha, Tensor) or alpha.dim() == 0 else alpha
    )
    material = eg.Material(base_color=0.0, emission=radiance, alpha_mode="BLEND")
    return mesh.replace(verts=mesh.verts + vector(0, 0, height), alpha=alpha, material=material)


def over(radiances: list[float], alphas: list[float], behind: float) -> float:
    for radiance, alpha in zip(reversed(radiances), reversed(alphas), strict=True):
        behind = alpha * radiance + (1 - alpha) * behind
    return behind


@pytest.mark.parametrize("background", [None, 0.4])
def test_layers_in_any_order_of_meshes(background: float | None) -> None:
    alphas = [0.25, 0.5, 0.75, 0.4]
    sheets = [sheet(-0.5 * k, L, a) for k, (L, a) in enumerate(zip(RADIANCES, alphas, strict=True))]
    behind = None if background is None else torch.full((3,), background, dtype=F64)
    for order in ([0, 1, 2, 3], [2, 0, 3, 1]):
        image = eg.render(eg.Scene([sheets[k] for k in order], behind), from_above(8), spp=4, seed=0)
        assert torch.allclose(
            image, torch.full_like(image, over(list(RADIANCES), alphas, background or 0.0)), atol=1e-9
        )


def test_what_lies_before_something_opaque_and_an_environment() -> None:
    floor = plane().replace(verts=plane().verts - vector(0, 0, 2), material=eg.Material(0.0, emission=0.3))
    image = eg.render(eg.Scene([sheet(0, 0.9, 0.25), floor]), from_above(8), spp=4, seed=0)
    assert torch.allclose(image, torch.full_like(image, over([0.9], [0.25], 0.3)), atol=1e-9)
    sky = eg.lights.Environment(torch.tensor([0.6, 0.6, 0.6], dtype=F64))
    image = eg.render(eg.Scene([sheet(0, 0.9, 0.25)], lights=[sky]), from_above(8), spp=4, seed=0)
    assert torch.allclose(image, torch.full_like(image, over([0.9], [0.25], 0.6)), atol=1e-9)


@pytest.mark.parametrize("image_of_directions", [False, True])
def test_gradient_by_an_environment_that_is_seen_through(image_of_directions: bool) -> None:
    """The image is linear in what shows behind the sheet."""
    radiance = torch.full((3,), 0.6, dtype=F64, requires_grad=True)
    sky = eg.lights.Environment(radiance.expand(2, 4, 3) if image_of_directions else radiance)
    image = eg.render(eg.Scene([sheet(0, 0.9, 0.25, size=0.5)], lights=[sky]), from_above(8), spp=4, seed=0)
    (found,) = torch.autograd.grad(image.sum(), radiance)
    seen_through = 64 * (1 - 0.25 * 0.25)  # a quarter of the image is covered, of which a quarter is the sheet's own
    torch.testing.assert_close(found, torch.full_like(found, seen_through), rtol=1e-9, atol=0)


def test_gradients_by_alpha_radiance_and_background() -> None:
    values = [torch.tensor(v, dtype=F64, requires_grad=True) for v in (0.25, 0.6, 0.9, 0.5)]
    a0, a1, L0, L1 = values
    background = torch.full((3,), 0.4, dtype=F64, requires_grad=True)
    scene = eg.Scene([sheet(0, L0, a0), sheet(-1, L1, a1)], background)
    adjoint = torch.rand(8, 8, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    loss = (eg.render(scene, from_above(8), spp=4, sampling=eg.Sampling(surface=40_000), seed=0) * adjoint).sum()
    found = torch.autograd.grad(loss, [*values, background])
    expected = (a0 * L0 + (1 - a0) * (a1 * L1 + (1 - a1) * background)).expand(8, 8, 3)
    wanted = torch.autograd.grad((expected * adjoint).sum(), [*values, background])
    for a, b in zip(found, wanted, strict=True):
        assert float((a - b).abs().max()) < 0.01 * float(b.abs().max())


def test_a_shader_is_composed_with_what_it_gives_behind() -> None:
    """Values, and gradients by alpha and by what moves, are those of materials."""
    scene = eg.Scene([sheet(0, 0.9, 0.25), sheet(-1, 0.5, 0.6, size=0.6)], torch.full((3,), 0.4, dtype=F64))

    def shader(hits: eg.points.Hits) -> Tensor:
        return torch.where(hits.position[:, 2:] > -0.5, 0.9, 0.5).expand(-1, 3)

    adjoint = torch.rand(8, 8, 3, dtype=F64, generator=torch.Generator().manual_seed(1))

    def found(shader: object) -> tuple[Tensor, list[Tensor]]:
        alphas = [mesh.alpha.clone().requires_grad_() for mesh in scene.meshes]
        x = torch.tensor(0.0, dtype=F64, requires_grad=True)
        meshes = [mesh.replace(alpha=alpha) for mesh, alpha in zip(scene.meshes, alphas, strict=True)]
        meshes[1] = meshes[1].replace(verts=meshes[1].verts + torch.stack([x, 0 * x, 0 * x]))
        image = eg.render(
            scene.replace(meshes=meshes), from_above(8), 16, shader=shader, sampling=eg.Sampling(edges=20_000), seed=0
        )
        return image.detach(), list(torch.autograd.grad((image * adjoint).sum(), [*alphas, x]))

    (image, gradients), (wanted, others) = found(shader), found(None)
    # Of a face in a pixel one point is shaded, and with it what lies behind that one: the border is noisier.
    assert float((image - wanted).mean().abs()) < 0.002 and torch.allclose(image[3:5, 3:5], wanted[3:5, 3:5], atol=1e-9)
    for a, b in zip(gradients, others, strict=True):
        assert float((a - b).abs().max()) < 0.02 * float(b.abs().max())


def test_a_texture_behind_moves_inside_and_the_border_of_the_first_sheet() -> None:
    """Finite differences of a shift of either sheet: the border of the hidden one has no gradient, so it fills the image."""
    draw = torch.Generator().manual_seed(1)
    texture = torch.nn.functional.interpolate(
        torch.rand(1, 3, 4, 4, dtype=F64, generator=draw), size=(32, 32), mode="bicubic", align_corners=True
    )[0].movedim(0, -1)
    adjoint = torch.nn.functional.interpolate(
        torch.randn(1, 3, 3, 3, dtype=F64, generator=draw), size=(24, 24), mode="bicubic", align_corners=True
    )[0].movedim(0, -1)

    def loss(front: Tensor, back: Tensor, spp: int = 4) -> Tensor:
        first, second = sheet(0, 0.9, 0.4, 0.6), sheet(-1, 0.0, 1.0, 1.5)
        material = eg.Material(0.0, emission=eg.Texture(texture), alpha_mode="BLEND")
        second = second.replace(verts=second.verts + back, material=material)
        scene = eg.Scene([first.replace(verts=first.verts + front), second])
        image = eg.render(scene, from_above(24), spp=spp, seed=3, sampling=eg.Sampling(surface=60_000, edges=20_000))
        return (image * adjoint).sum()

    zero, step = torch.zeros(3, dtype=F64), 0.02
    moved = [zero.clone().requires_grad_() for _ in range(2)]
    found = torch.autograd.grad(loss(moved[0], moved[1]), moved)
    for which in range(2):
        for axis in range(2):
            shift = step * torch.eye(3, dtype=F64)[axis]
            with torch.no_grad():
                ahead, back = (
                    loss(s * shift if which == 0 else zero, s * shift if which == 1 else zero, 1024)
                    for s in (1.0, -1.0)
                )
            difference = float(ahead - back) / (2 * step)
            assert abs(float(found[which][axis]) - difference) < 0.03 * (abs(difference) + 1.0), (which, axis)


def test_shadows_of_thin_and_thick_sheets() -> None:
    light = eg.lights.DirectionalLight(vector(0, 0, -1))
    floor = plane().replace(verts=plane().verts - vector(0, 0, 1), material=eg.Material(1.0))
    dark, bright = (
        eg.render(eg.Scene([sheet(0, 0.0, alpha), floor], lights=[light]), from_above(4), spp=1, seed=0).mean()
        for alpha in (0.6, 0.4)
    )
    assert float(dark) == 0 and abs(float(bright) - 0.6 / torch.pi) < 1e-6


def test_forward_mode_and_unlit_meshes() -> None:
    alpha = torch.tensor(0.3, dtype=F64)

    def seen(a: Tensor) -> Tensor:
        sheets = eg.Scene([sheet(0, 0.9, a), sheet(-1, 0.5, 1.0)])
        return eg.render(sheets, from_above(4), spp=1, sampling=eg.Sampling(surface=20_000), seed=0)

    image, moved = torch.func.jvp(seen, (alpha,), (torch.ones((), dtype=F64),))[:2]
    assert torch.allclose(image, torch.full_like(image, 0.3 * 0.9 + 0.7 * 0.5))
    assert abs(float(moved.mean()) - 0.4) < 0.004


# -- what moves behind transparent surfaces --------------------------------------------------------------------


def sheets(heights: dict[float, tuple[float, float]], square: eg.Mesh) -> eg.Scene:
    """Sheets by their height, of a radiance and an alpha each, over and under a square, before 0.4."""
    transparent = [sheet(z, L, a) for z, (L, a) in heights.items()]
    return eg.Scene([*transparent, square], torch.full((3,), 0.4, dtype=F64))


def check_growth(heights: dict[float, tuple[float, float]], opacity: float, behind: float) -> None:
    """A square of radiance 0.9 at z = 0 grows behind transparent sheets; `behind` is what it hides."""
    grown = torch.zeros((), dtype=F64, requires_grad=True)
    square = sheet(0.0, 0.9, opacity, 0.5)
    camera = from_above(16).replace(K=from_above(16).K + vector(0.3, 0.2, 0)[:, None] * vector(0, 0, 1))
    found = []
    for seed in range(4):
        scene = sheets(heights, square.replace(verts=square.verts * (1 + grown)))
        image = eg.render(scene, camera, spp=4, seed=seed, sampling=eg.Sampling(edges=2000))
        found.append(torch.autograd.grad(image.sum(), grown)[0].item())
    through = 1.0
    for z, (_, alpha) in heights.items():
        through *= 1 - alpha if z > 0 else 1.0
    truth = 3 * through * opacity * (0.9 - behind) * 2 * 8.0**2  # px²
    assert abs(sum(found) / len(found) - truth) < 0.01 * abs(truth)


def test_silhouette_of_a_square_behind_transparent_sheets() -> None:
    check_growth({1.0: (0.7, 0.25)}, 1.0, 0.4)
    check_growth({1.0: (0.7, 0.25), 2.0: (0.1, 0.5)}, 1.0, 0.4)
    check_growth({1.0: (0.7, 0.25)}, 0.3, 0.4)  # a transparent sheet itself
    check_growth({1.0: (0.7, 0.25), -1.0: (0.2, 0.5)}, 1.0, 0.5 * 0.2 + 0.5 * 0.4)  # before another


def behind_glass(kind: str, t: Tensor, covered: bool) -> tuple[eg.Scene, eg.Camera]:
    """A black transparent sheet of alpha 0.4, or none, before something that moves."""
    camera = eg.Camera.look_at((0.3, -0.4, 5.0), (0, 0, 0), up=(0.1, 1, 0), fov_y=40, size=(32, 32)).to(F64)
    material, lights = eg.Material(), [eg.lights.PointLight(vector(1.2, 0.9, 2.6) + t * vector(0.5, 0.1, 0), 9.0)]
    floor = plane(1.6, material=material).transformed(t=vector(0, 0, -0.6))
    first = cube(0.6).transformed(R=rotation((0.0, 0.6, 0.8), torch.tensor(0.7, dtype=F64)))
    moved = 0.2 * t * vector(1, 0.4, 0.3)
    if kind == "alpha edge":
        disc_ = quad(alpha=disc() + 0.8 * t, material=eg.Material(0.05))
        meshes = [floor, disc_.replace(verts=0.7 * disc_.verts + vector(0, 0, 0.3) + moved)]
    else:
        radiance = torch.linspace(0.1, 1, len(first.faces), dtype=F64)[:, None].expand(-1, 3)
        first = eg.Mesh(first.verts + moved, first.faces, face_colors=radiance)
        meshes = [floor, first.replace(material=material)] if kind == "shadow" else [first]
        if kind == "intersection":
            meshes += [eg.Mesh(first.verts.roll(1, 1) * 1.1, first.faces, face_colors=radiance.flip(0))]
    lights = [] if kind in ("edges", "intersection") else lights
    glass = sheet(2.0, 0.0, 0.4) if covered else None
    return eg.Scene([*meshes, glass] if glass else meshes, lights=lights), camera


@pytest.mark.parametrize(
    "kind", ["edges", "shadow", "alpha edge", pytest.param("intersection", marks=pytest.mark.slow)]
)
def test_all_that_moves_behind_a_transparent_sheet(kind: str) -> None:
    """It moves as without the transparent sheet, of which six tenths come through."""
    options = {"sampling": eg.Sampling(edges=6000, surface=20_000, discontinuity_spacing=0.125)}
    through, alone = (
        derivative(lambda t, covered=covered: behind_glass(kind, t, covered), 4, **options) for covered in (True, False)
    )
    noise = (through.error**2 + (0.6 * alone.error) ** 2) ** 0.5
    assert noise < 0.007 * abs(through.mean), f"too noisy to decide: {through}, {alone}"
    assert abs(through.mean - 0.6 * alone.mean) < 0.02 * abs(through.mean), (
        f"{through}, without a transparent sheet {alone}"
    )


@pytest.mark.parametrize(("moving", "searched"), [("alpha", False), ("light", False), ("uvs", True), ("verts", True)])
def test_borders_of_nearest_texels_are_searched_where_they_move(
    moving: str, searched: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alpha and lights that require a gradient move none."""
    searches: list[DiscontinuityTerms] = []

    def found(terms: DiscontinuityTerms, watch: object) -> list[object]:
        searches.append(terms)
        return []

    monkeypatch.setattr(DiscontinuityTerms, "found", found)
    start = plane()
    assert start.uvs is not None
    alpha, power = torch.full((2, 2), 0.5, dtype=F64), torch.tensor(3.0, dtype=F64)
    values = {"alpha": alpha, "light": power, "uvs": start.uvs, "verts": start.verts}
    values[moving] = values[moving].clone().requires_grad_()
    image = torch.linspace(0.2, 0.8, 12, dtype=F64).reshape(2, 2, 3)
    material = eg.Material(eg.Texture(image, filter="nearest"), alpha_mode="BLEND")
    mesh = start.replace(verts=values["verts"], uvs=values["uvs"], alpha=values["alpha"], material=material)
    scene = eg.Scene(mesh, lights=[eg.lights.PointLight((0.3, 0.2, 2.0), values["light"])])
    loss = eg.render(scene, from_above(4), spp=1, seed=0).sum()
    torch.autograd.grad(loss, values[moving])
    assert bool(searches) == searched
