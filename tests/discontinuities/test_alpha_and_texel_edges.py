"""Discontinuities within faces, which are alpha edges and texel edges: exact areas, finite differences of the image, and
what other parts see of them."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from alpha_masks import F64, checkerboard, disc, quad
from finite_differences import Case, check_ratio, estimate, gradient, loss, right_ratio, rotation
from oracles import reference
from scenes import cube, front_camera, icosphere, smooth_adjoint
from threads import check_threads
from torch import Tensor

import edgegrad as eg
from edgegrad.plan import Term

pytestmark = pytest.mark.watched

SIZE = 32
CAMERA = front_camera(SIZE)
K = CAMERA.K
FLAT = eg.Camera(
    torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=F64)),
    torch.tensor([[8.7, 0.0, 16.2], [0.0, 8.7, 15.9], [0.0, 0.0, 1.0]], dtype=F64), (SIZE, SIZE), "orthographic",
)  # fmt: skip
DISTORTED = CAMERA.replace(distortion=torch.tensor([-0.4, 0.3, 0.02, -0.01], dtype=F64))
BACK = torch.tensor([0.1, 0.3, 0.2], dtype=F64)
TINT = torch.tensor([0.9, 0.4, 0.3], dtype=F64)


def noise(*shape: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(7), dtype=F64)


def tilted(mesh: eg.Mesh, angle: float = 0.5, z: float = 0.0) -> eg.Mesh:
    t = torch.tensor([0.0, 0.0, z], dtype=F64)
    return mesh.transformed(R=rotation((0.6, 0.8, 0.0), torch.tensor(angle, dtype=F64)), t=t)


def masked(side: int = 1, **fields: object) -> eg.Mesh:
    """A tilted square with a disc of it there."""
    return tilted(quad(side, **{"alpha": disc(), "face_colors": TINT.expand(2 * side * side, 3), **fields}))


def board() -> eg.Mesh:
    """A tilted square with a checkerboard of nearest texels, whose borders are not those of the square."""
    mesh = tilted(quad(2, texture=checkerboard(5), filter="nearest"))
    assert mesh.uvs is not None
    return mesh.replace(uvs=0.03 + 0.9 * mesh.uvs)


def grainy(mesh: eg.Mesh, t: Tensor) -> eg.Mesh:
    return mesh.replace(verts=mesh.verts + 0.2 * t * noise(len(mesh.verts), 3))


# What moves, of the first mesh of a scene or of the camera.
Move = Callable[[eg.Mesh, eg.Camera, Tensor], tuple[eg.Mesh, eg.Camera]]
MOVES: dict[str, Move] = {
    "verts": lambda mesh, camera, t: (grainy(mesh, t), camera),
    "uvs": lambda mesh, camera, t: (mesh.replace(uvs=mesh.uvs + 0.1 * t * noise(*mesh.uvs.shape)), camera),
    "alpha": lambda mesh, camera, t: (
        mesh.replace(alpha=mesh.alpha + 0.2 * t * noise(*mesh.alpha.shape).abs()),
        camera,
    ),
    "pose": lambda mesh, camera, t: (
        mesh,
        camera.replace(
            world_to_camera=camera.world_to_camera
            @ torch.block_diag(rotation((0.6, 0.0, 0.8), 0.5 * t), torch.ones(1, 1, dtype=F64))
        ),
    ),
    "K": lambda mesh, camera, t: (mesh, camera.replace(K=camera.K + t * 10.0 * noise(3, 3).abs() * (camera.K > 1))),
    "lens": lambda mesh, camera, t: (mesh, camera.replace(distortion=camera.distortion + 0.3 * t)),
}


def case(meshes: list[eg.Mesh], move: str, camera: eg.Camera = CAMERA) -> Case:
    def at(t: Tensor) -> tuple[eg.Scene, eg.Camera]:
        first, there = MOVES[move](meshes[0], camera, t)
        return eg.Scene([first, *meshes[1:]], BACK), there

    return at


def behind() -> eg.Mesh:
    verts = 2.0 * quad().verts + torch.tensor([0.1, 0.0, -1.5], dtype=F64)
    return eg.Mesh(verts, quad().faces, colors=noise(4, 3).abs())


def through() -> eg.Mesh:
    """A cube that the disc passes through."""
    mesh = cube().transformed(R=rotation((0.0, 0.6, 0.8), torch.tensor(0.7, dtype=F64)), scale=0.35)
    return mesh.replace(face_colors=noise(len(mesh.faces), 3).abs())


def ball() -> eg.Mesh:
    """A sphere with holes in a row, so that its inside is seen; texture coordinates jump at a seam."""
    mesh = icosphere(2)
    x, y, z = mesh.verts[mesh.faces].unbind(-1)
    u = torch.atan2(x, z) / (2.0 * torch.pi)
    u = u + (u < u.amax(1, keepdim=True) - 0.5)
    uvs = torch.stack([3.0 * u, 2.0 * torch.asin(y) / torch.pi], -1).reshape(-1, 2)
    return eg.Mesh(
        0.9 * mesh.verts, mesh.faces, colors=mesh.verts.abs(), alpha=1.0 - disc(16, 0.3), uvs=uvs,
        uv_faces=torch.arange(len(uvs)).reshape(-1, 3), wrap="mirror",
    )  # fmt: skip


CASES = {
    "disc verts": case([masked()], "verts"),
    "disc uvs": case([masked()], "uvs"),
    "disc alpha": case([masked()], "alpha"),
    "disc pose": case([masked(), behind()], "pose"),
    "disc K": case([masked()], "K"),
    "disc before a surface": case([masked(), behind()], "verts"),
    "surface behind a disc": case([behind(), masked()], "verts"),
    "disc of many faces": case([masked(5)], "verts"),
    "disc and a cube through it": case([masked(), through()], "verts"),
    "cube through a disc": case([through(), masked()], "pose"),
    "two layers": case([masked(), tilted(masked(2), -0.6, -0.6)], "verts"),
    "layer behind a layer": case([tilted(masked(2), -0.6, -0.6), masked()], "alpha"),
    "disc clipped by the view": case([masked()], "alpha", CAMERA.crop(9, 11, 14, 13)),
    "orthographic verts": case([masked(), behind()], "verts", FLAT),
    "orthographic pose": case([masked(), behind()], "pose", FLAT),
    "distorted verts": case([masked(), behind()], "verts", DISTORTED),
    "distorted alpha": case([masked(), behind()], "alpha", DISTORTED),
    "distorted lens": case([masked(), behind()], "lens", DISTORTED),
    "ball verts": case([ball()], "verts"),
    "ball pose": case([ball(), behind()], "pose"),
    "board verts": case([board()], "verts"),
    "board uvs": case([board()], "uvs"),
    "board pose": case([board(), behind()], "pose"),
    "board orthographic": case([board()], "pose", FLAT),
    "board distorted": case([board()], "pose", DISTORTED),
    "borders of texels along edges": case(
        [tilted(quad(2, texture=checkerboard(4), filter="nearest", wrap="clamp"))], "pose"
    ),
    "nearest alpha": case([masked(alpha=disc(9), filter="nearest")], "verts"),
    "nearest alpha and texture": case(
        [tilted(quad(1, alpha=disc(9), texture=checkerboard(9), filter="nearest", wrap="clamp"))], "pose"
    ),
}
FAST = ("disc before a surface", "board pose")


@pytest.mark.unwatched
@pytest.mark.parametrize("name", FAST)
def test_finite_differences(name):
    check_ratio(CASES[name], 0.01, spp=1024, seeds=4, sampling=eg.Sampling(discontinuity_spacing=1 / 16))


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_all_finite_differences(name):
    check_ratio(
        CASES[name],
        0.01,
        spp=4096,
        seeds=48,
        sampling=eg.Sampling(discontinuity_spacing=1 / 32, surface=50_000, edges=50_000),
    )


# -- exact ------------------------------------------------------------------------------------------------------------

LINE = torch.tensor([[0.0, 1.0], [0.0, 1.0]], dtype=F64)  # α rises from ¼ to ¾ of the width of a square


def front(**fields: object) -> eg.Mesh:
    return quad(2, **{"face_colors": torch.ones(8, 1, dtype=F64), **fields})


def area() -> float:
    """px² of the square that front() has in FLAT."""
    return float((2.0 * FLAT.K[0, 0]) ** 2)


@pytest.mark.parametrize("cutoff, share", [(0.5, 0.5), (0.25, 0.625), (0.0, 0.75), (-0.1, 1.0), (1.1, 0.0)])
def test_area_of_a_masked_square(cutoff, share):
    mesh = front(alpha=LINE, alpha_cutoff=cutoff, wrap="clamp")
    found = eg.render_aovs(mesh, FLAT, ["image", "alpha"], 256, seed=0)
    if cutoff == 0.0:  # the square is there where α is exactly its cutoff, in a quarter of it
        share = 1.0
    for name in ("image", "alpha"):
        assert found[name].sum().item() == pytest.approx(share * area(), rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("side", [1, 2], ids=["within faces", "along their edge"])
def test_derivatives_of_an_area(side):
    """The alpha edge is parallel to the lines, so every seed meets the derivatives by alpha, uvs and a scale of the square."""
    mesh = quad(side, alpha=LINE, wrap="clamp", face_colors=torch.ones(2 * side * side, 1, dtype=F64))
    assert mesh.alpha is not None and mesh.uvs is not None
    verts, uvs, alpha = (t.clone().requires_grad_() for t in (mesh.verts, mesh.uvs, mesh.alpha))
    moving = mesh.replace(verts=verts, uvs=uvs, alpha=alpha)
    options = {"sampling": eg.Sampling(discontinuity_spacing=1 / 8, edges=20_000)}
    eg.render(moving, FLAT, 4, **{"seed": 0, **options}).sum().backward()
    assert verts.grad is not None and uvs.grad is not None and alpha.grad is not None
    # α = 2u − ½, so the alpha edge is at u = ½ + δ/2 where the cutoff rises by δ, and at ½ − δ where u does.
    assert alpha.grad.sum().item() == pytest.approx(0.5 * area(), rel=0.01)
    assert uvs.grad[:, 0].sum().item() == pytest.approx(area(), rel=0.01)
    assert uvs.grad[:, 1].sum().item() == pytest.approx(0.0, abs=1e-9)
    # Stretched along x, the half that is there grows in proportion.
    assert (verts.grad[:, 0] * verts[:, 0].detach()).sum().item() == pytest.approx(0.5 * area(), rel=0.01)


def test_texel_edge_in_a_known_place():
    """Two texels side by side: the border moves with u."""
    texture = torch.tensor([[[0.25], [1.0]]], dtype=F64)
    mesh = quad(1, texture=texture, filter="nearest", wrap="clamp")
    assert mesh.uvs is not None
    uvs = (0.1 + 0.7 * mesh.uvs).requires_grad_()
    eg.render(
        mesh.replace(uvs=uvs), FLAT, 4, sampling=eg.Sampling(discontinuity_spacing=1 / 8), seed=0
    ).sum().backward()
    assert uvs.grad is not None
    assert uvs.grad[:, 0].sum().item() == pytest.approx(0.75 * area() / 0.7, rel=0.01)


@pytest.mark.parametrize("repeats", [3, 1500])
def test_texels_much_smaller_than_pixels(repeats):
    """Some cells of a texture stand for all where not all are searched. The area that alpha leaves grows with alpha as in a
    single copy of the texture."""
    u = (torch.arange(8, dtype=F64) + 0.5) / 8
    alpha = 1.0 - 2.0 * (u - 0.5).abs().expand(2, 8)  # a tent: there in the middle half
    mesh = front(alpha=alpha)
    assert mesh.uvs is not None
    given = alpha.clone().requires_grad_()
    mesh = mesh.replace(alpha=given, uvs=0.013 + repeats * mesh.uvs * torch.tensor([1.0, 0.01], dtype=F64))
    found = []
    for seed in range(16):
        eg.render(mesh, FLAT, 4, seed=seed, sampling=eg.Sampling(discontinuity_spacing=0.5)).sum().backward()
        assert given.grad is not None
        found.append(given.grad.sum().item())
        given.grad = None
    mean, error = estimate(found)
    assert error < 0.01 * area()
    assert mean == pytest.approx(area(), abs=4 * error + 0.01 * area())


# -- the image --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "camera", [pytest.param(CAMERA, id="perspective"), pytest.param(FLAT, id="orthographic", marks=pytest.mark.slow)]
)
def test_equals_the_twin(camera):
    """The twin is brute force over all faces."""
    scene = eg.Scene([masked(2), ball(), behind()], BACK)
    ours, twin = eg.render(scene, camera, 256, seed=0), reference.render(scene, camera, 8)
    assert (ours - twin).abs().mean().item() < 0.004


def test_parts_that_are_masked_are_seen_by_nobody():
    """Channels, ids, and shaders."""
    mesh = masked()
    scene = eg.Scene([mesh, behind()], BACK)
    found = eg.render_aovs(scene, CAMERA, ["image", "alpha", "mesh_id"], 64, seed=0)
    ids = found["mesh_id"][..., 0]
    points = torch.stack(torch.meshgrid(*[torch.arange(SIZE, dtype=F64) + 0.5] * 2, indexing="xy"), -1).reshape(-1, 2)
    faces = reference.closest_faces(scene, CAMERA, points).reshape(SIZE, SIZE)
    assert torch.equal(ids, torch.where(faces < 0, -1, (faces >= len(mesh.faces)).long()))
    ones = eg.render(
        scene.replace(background=None), CAMERA, 64, shader=lambda hits: torch.ones_like(hits.position), seed=0
    )
    torch.testing.assert_close(ones[..., :1], found["alpha"])


def test_uvs_need_no_texture():
    for scene in (quad(2, alpha=disc()), quad(2)):
        found = eg.render_aovs(scene, FLAT, ["uv", "alpha"], 64, seed=0)
        mean = found["uv"].sum((0, 1)) / found["alpha"].sum()
        torch.testing.assert_close(mean, torch.full((2,), 0.5, dtype=F64), atol=1e-3, rtol=0)


# -- other derivatives ------------------------------------------------------------------------------------------------

SHADER = {
    "shader": lambda hits: torch.stack([hits.position[:, 0] + 1.5, 0.5 * hits.position[:, 1] + 1.0, hits.depth], 1)
}


@pytest.mark.parametrize("move", ["verts", "uvs", "alpha", "K"])
def test_forward_mode_is_reverse_mode(move):
    """Both modes have the same samples, but for controls: they differ by noise."""
    at, found = case([masked(), behind()], move), {}
    options = {"sampling": eg.Sampling(discontinuity_spacing=1 / 8, edges=50_000, surface=50_000), "spp": 16}
    for seed in range(4):
        zero = torch.zeros((), dtype=F64)
        _, forward = torch.func.jvp(lambda t, seed=seed: loss(*at(t), seed=seed, **options), (zero,), (zero + 1,))
        theta = zero.clone().requires_grad_()
        reverse = torch.autograd.grad(loss(*at(theta), seed=seed, **options), theta)[0]
        found.setdefault("forward", []).append(forward.item())
        found.setdefault("reverse", []).append(reverse.item())
    forward, reverse = estimate(found["forward"]), estimate(found["reverse"])
    error = (forward.error**2 + reverse.error**2) ** 0.5
    assert abs(forward.mean - reverse.mean) < 4 * error + 0.01 * abs(reverse.mean)
    assert error < 0.02 * abs(reverse.mean)


@pytest.mark.parametrize("move", ["verts", "uvs", "alpha", "pose", "K"])
def test_shaders_have_the_same_discontinuities(move):
    """The scene's own colours written as a shader."""
    first = tilted(quad(1, alpha=disc(), colors=noise(4, 3).abs()))
    at = case([first], move)

    def own(hits: eg.points.Hits) -> Tensor:
        colors = first.colors
        assert colors is not None
        return hits.interpolate(colors)

    options = {"sampling": eg.Sampling(discontinuity_spacing=1 / 8, edges=20_000, surface=20_000)}
    shaded, fused = gradient(at, 4, shader=own, **options), gradient(at, 4, **options)
    error = (shaded.error**2 + fused.error**2) ** 0.5
    assert abs(shaded.mean - fused.mean) < 4 * error + 0.01 * abs(fused.mean)
    assert error < 0.02 * abs(fused.mean)


@pytest.mark.parametrize("mesh", [masked(), board()], ids=["disc", "board"])
def test_gradient_by_place(mesh):
    """Its sum is the derivative for moving all in the image."""
    scene, A = eg.Scene([mesh]), smooth_adjoint(SIZE, SIZE, 3)
    options = {"sampling": eg.Sampling(discontinuity_spacing=1 / 16, edges=50_000)}
    total = torch.stack([eg.screen_gradient(scene, CAMERA, A, 16, s, **options).sum((0, 1)) for s in range(8)])  # type: ignore[arg-type]
    for axis in range(2):
        shift = torch.zeros(3, 3, dtype=F64)
        shift[axis, 2] = 1.0
        right_ratio(
            estimate(total[:, axis].tolist()),
            gradient(lambda t, shift=shift: (scene, CAMERA.replace(K=K + t * shift)), 4, **options),
        )


def test_same_bits_at_any_number_of_threads():
    mesh = masked(3)
    leaves = {n: getattr(mesh, n).clone().requires_grad_() for n in ("verts", "uvs", "alpha")}

    def compute() -> list[Tensor]:
        image = eg.render(eg.Scene([mesh.replace(**leaves), behind()]), CAMERA, 8, seed=0)
        return [image, *torch.autograd.grad((image * smooth_adjoint(*image.shape)).sum(), [*leaves.values()])]

    check_threads(compute)


# -- the plan ---------------------------------------------------------------------------------------------------------


def test_plan_says_what_is_looked_for():
    def of(mesh: eg.Mesh, what: str, **options: object) -> Term:
        mesh = mesh.replace(**{what: getattr(mesh, what).clone().requires_grad_()})
        return eg.plan(mesh, CAMERA, **options)["discontinuities"]

    for mesh, what in ((masked(), "verts"), (masked(), "uvs"), (masked(), "alpha"), (board(), "uvs")):
        assert of(mesh, what).on
        assert not of(mesh, what, visibility=False).on
    assert not of(masked(), "face_colors").on
    assert not of(masked().replace(alpha=None), "verts").on
    assert not of(board().replace(filter="linear"), "verts").on
    assert eg.plan(masked(), CAMERA)["alpha masks"].on and not eg.plan(board(), CAMERA)["alpha masks"].on


@pytest.mark.parametrize(
    "value, error, message",
    [
        (0.0, ValueError, "sampling.discontinuity_spacing: expected a number from 0.015625 to 64, got 0.0"),
        (float("nan"), ValueError, "sampling.discontinuity_spacing: expected a number from 0.015625 to 64, got nan"),
        ("1", TypeError, "sampling.discontinuity_spacing: expected a number, got str"),
        (True, TypeError, "sampling.discontinuity_spacing: expected a number, got bool"),
    ],
)
def test_spacing_that_is_none(value, error, message):
    with pytest.raises(error, match=message):
        eg.render(masked(), CAMERA, sampling=eg.Sampling(discontinuity_spacing=value), seed=0)
