"""Borders of what surfaces of a path see of one another, in render(bounces=n)."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from both_modes import check_both_modes
from bounce_scenes import BOX, GAUSS, QUAD, SCENES, case_of, indirect_change, indirect_gradient, mesh, plates, seen_from
from finite_differences import Case, estimate, right_ratio
from strip_oracle import Strip, border
from torch import Tensor

import edgegrad as eg
from edgegrad import shader
from edgegrad.light import in_kernel, secondary_edges
from edgegrad.light.at_points import LitOptions
from edgegrad.points.image_context import ImageContext
from edgegrad.points.splat import SplatTerm

F64 = torch.float64
MATERIALS: dict[str, dict[str, Any]] = {
    "lambert": {"base_color": torch.tensor([0.8, 0.6, 0.4], dtype=F64)},
    "glossy": {"base_color": torch.tensor([0.8, 0.6, 0.4], dtype=F64), "metallic": 0.3, "roughness": 0.5},
    "mirror-like": {"base_color": torch.tensor([0.8, 0.7, 0.6], dtype=F64), "metallic": 1.0, "roughness": 0.2},
}


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Gradients are those of these borders alone."""
    for term in ("_interior", "_boundary", "_shadows"):
        monkeypatch.setattr(shader._Image, term, lambda *_: [])


def leaves_of(strip: Strip) -> Strip:
    """Return the strip with tensors that require gradients."""
    receiver, reflector, own = (x.clone().requires_grad_() for x in (strip.receiver, strip.reflector, strip.strip))
    pose, K = (x.clone().requires_grad_() for x in (strip.camera.world_to_camera, strip.camera.K))
    return Strip(receiver, reflector, own, strip.camera.replace(world_to_camera=pose, K=K), strip.light)


# How far off gradients may be, along the exact ones; those of the receiver, and of what moves with it, come from few samples.
MOST = {"strip": 0.02, "reflector": 0.02, "pose": 0.03, "K": 0.03, "receiver": 0.03}


def gradients(
    strip: Strip, materials: tuple[str, str], weights: Tensor, samples: int, **options: Any
) -> dict[str, Tensor]:
    own = leaves_of(strip)
    scene = own.scene(*(MATERIALS[name] for name in materials))
    counts = {"sampling": eg.Sampling(edges=samples, surface=1)}
    given: dict[str, Any] = {"bounces": 2, **counts, **options}
    image = eg.render(scene, own.camera, 1, 0, shadows=False, **given)
    found = torch.autograd.grad((weights.to(image) * image).sum(), list(own.tensors.values()))
    return dict(zip(own.tensors, found, strict=True))


def weights_of(strip: Strip) -> Tensor:
    generator = torch.Generator().manual_seed(0)
    return 0.5 + torch.rand(*strip.camera.size, 3, dtype=F64, generator=generator)


def check_strip(strip: Strip, materials: tuple[str, str], samples: int, finer: tuple[int, int] = (1, 1)) -> None:
    """Gradients of all that moves the border, against the oracle."""
    exact, weights = leaves_of(strip), weights_of(strip)
    value = border(exact, MATERIALS[materials[0]], MATERIALS[materials[1]], weights, finer)
    expected = torch.autograd.grad(value, list(exact.tensors.values()))
    found = gradients(strip, materials, weights, samples)
    for name, b in zip(exact.tensors, expected, strict=True):
        a = found[name]
        if name == "K":  # of which the upper rows count
            a, b = a[:2], b[:2]
        ratio, error = float((a * b).sum() / (b * b).sum()), float((a - b).norm() / b.norm())
        assert abs(ratio - 1) < MOST[name] and error < 2 * MOST[name], (name, ratio, error)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    "materials",
    [
        pytest.param(("glossy", "lambert"), id="glossy-lambert"),
        pytest.param(("lambert", "lambert"), id="lambert-lambert", marks=pytest.mark.slow),
        pytest.param(("lambert", "glossy"), id="lambert-glossy", marks=pytest.mark.slow),
    ],
)
def test_strip_between_two_faces(materials: tuple[str, str]) -> None:
    check_strip(Strip.standard(), materials, 1_600_000)


@pytest.mark.slow
@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    "materials",
    [("mirror-like", "lambert"), ("lambert", "mirror-like"), ("glossy", "mirror-like"), ("mirror-like", "glossy")],
    ids="-".join,
)
def test_strip_between_mirrors(materials: tuple[str, str]) -> None:
    check_strip(Strip.standard(), materials, 4_000_000, finer=(4, 3))


@pytest.mark.usefixtures("alone")
def test_light_that_is_followed_to_the_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Light goes on to the camera from ends of lines that could be out of sight. Without any step in between, it finds the
    border that the camera sees."""
    follow = in_kernel.towards_camera
    monkeypatch.setattr(in_kernel, "towards_camera", lambda frame, arrivals, _: follow(frame, arrivals, (0, 0)))

    def passed_on(frame: ImageContext, options: LitOptions) -> list[SplatTerm]:
        found = in_kernel.secondary_edge_samples(frame, options._replace(bounces=3), 1)
        return secondary_edges._passed_on(frame, found, "secondary edges", 1)

    monkeypatch.setattr(secondary_edges, "_seen", passed_on)
    exact, weights = leaves_of(Strip.standard()), weights_of(Strip.standard())
    value = border(exact, MATERIALS["glossy"], MATERIALS["lambert"], weights)
    found = gradients(Strip.standard(), ("glossy", "lambert"), weights, 400_000)
    for name, tensor in {"strip": exact.strip, "reflector": exact.reflector}.items():
        (b,) = torch.autograd.grad(value, tensor, retain_graph=True)
        ratio = float((found[name] * b).sum() / (b * b).sum())
        assert abs(ratio - 1) < MOST[name], (name, ratio)


@pytest.mark.watched
@pytest.mark.usefixtures("alone")
def test_lines_of_floats() -> None:
    """Lines are the same in float32, but for rounding."""
    weights = weights_of(Strip.standard())
    fine, coarse = (gradients(Strip.standard(t), ("lambert", "lambert"), weights, 40_000) for t in (F64, torch.float32))
    for name, exact in fine.items():
        assert float((coarse[name] - exact).norm() / exact.norm()) < 1e-3


@pytest.mark.watched
@pytest.mark.usefixtures("alone")
def test_forward_mode_is_the_adjoint_of_reverse_mode() -> None:
    strip, weights = Strip.standard(), weights_of(Strip.standard())
    values = list(strip.tensors.values())
    tangents = [torch.rand(x.shape, dtype=F64, generator=torch.Generator().manual_seed(3)) for x in values]

    def image(receiver: Tensor, reflector: Tensor, own: Tensor, pose: Tensor, K: Tensor) -> Tensor:
        moved = Strip(receiver, reflector, own, strip.camera.replace(world_to_camera=pose, K=K), strip.light)
        scene = moved.scene(MATERIALS["lambert"], MATERIALS["glossy"])
        return eg.render(
            scene, moved.camera, 1, bounces=2, shadows=False, sampling=eg.Sampling(edges=5_000, surface=1), seed=0
        )

    check_both_modes(image, values, tangents, weights)


def test_plan() -> None:
    row, strip = "secondary edges", leaves_of(Strip.standard())
    scene = strip.scene(MATERIALS["lambert"], MATERIALS["lambert"])
    off, two, four = (eg.plan(scene, strip.camera, 64, bounces=n)[row] for n in (1, 2, 4))
    least = 256 * 64 // 16  # more than an eighth of the image's rays
    assert not off.on and two.samples == least > 6 * 8 * 64 // 8 and four.samples == 3 * two.samples
    assert eg.plan(scene, strip.camera, 64, bounces=4, sampling=eg.Sampling(edges=50))[row].samples == 150
    assert not eg.plan(scene, strip.camera, 64, bounces=2, visibility=False)[row].on
    still = Strip.standard().scene(MATERIALS["lambert"], MATERIALS["lambert"])
    assert eg.plan(still, strip.camera, 64, bounces=4)[row].samples == two.samples  # the camera moves alone
    assert not eg.plan(still, Strip.standard().camera, 64, bounces=2)[row].on


# -- with all other terms, against finite differences of images ----------------------------------------------------------


def check(case: Case, spp: int, seeds: int, bounces: int, surface_samples: int, edge_samples: int) -> None:
    change = indirect_change(case, 0.1, spp, seeds, bounces)
    options = {"sampling": eg.Sampling(surface=surface_samples, edges=edge_samples)}
    print(right_ratio(change, indirect_gradient(case, 0.1, seeds, bounces, **options)))


def screen_beside_plates(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
    """The strip moves up between the plates, of which the camera sees neither: it sees a screen that they light."""
    found = plates()
    strip = found.meshes["strip"]
    moved = strip.replace(verts=strip.verts + theta * torch.tensor([0.0, 1.0, 0.0], dtype=F64))
    screen = mesh([[-0.2, -0.8, -1.3], [1, -0.8, -1.3], [1, 0.8, -1.3], [-0.2, 0.8, -1.3]], QUAD, 0.8)
    camera = seen_from((0.6, 0.0, -0.5), (0.55, 0.0, -1.3), 0.5)
    return eg.Scene([*(found.meshes | {"strip": moved, "screen": screen}).values()]), camera


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 3, 4])
def test_light_that_goes_on_to_the_camera(bounces: int) -> None:
    check(screen_beside_plates, 8192, 16, bounces, 4_000, 400_000)


MOTIONS = [(scene, motion) for scene, (_, motions) in SCENES.items() for motion in motions]


@pytest.mark.slow
@pytest.mark.parametrize(("scene", "motion"), MOTIONS)
def test_motions(scene: str, motion: str) -> None:
    check(case_of(scene, motion), 8192, 16, 2, 4_000_000, 1_000_000)


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [3, 4])
@pytest.mark.parametrize("scene", ["cornell", "plates", "light upwards", "ball"])
def test_more_bounces(scene: str, bounces: int) -> None:
    check(case_of(scene, next(iter(SCENES[scene][1]))), 8192, 16, bounces, 4_000_000, 1_000_000)


def block_on_reflector(theta: Tensor, dtype: torch.dtype) -> tuple[eg.Scene, eg.Camera]:
    """A black block stands on the face that reflects light, and slides on it; the camera sees the receiver alone."""
    strip, gray = Strip.standard(), torch.full((3,), 0.7, dtype=F64)
    reflector = torch.tensor([[-1.0, -5.0, -5.2], [-1.0, -5.4, 6.6], [-1.0, 5.8, 0.6]], dtype=dtype)
    turn = torch.tensor([[1, 0, 0], [0, 0.92, -0.39], [0, 0.39, 0.92]], dtype=F64)
    ends = [(x, y, z) for z in (-0.3, 0.3) for y in (-0.25, 0.25) for x in (-1.0, -0.4)]
    block = torch.tensor(ends, dtype=F64) @ turn.T + theta * torch.tensor([0.0, 1.0, 0.3], dtype=F64)
    materials = (strip.receiver, QUAD[:1], gray), (reflector, QUAD[:1], gray), (block, BOX, torch.zeros(3, dtype=F64))
    meshes = [eg.Mesh(v.to(dtype), torch.tensor(f), material=eg.Material(color)) for v, f, color in materials]
    lights = [eg.lights.PointLight(torch.tensor([0.0, 0.5, 0.2], dtype=F64), 4.0)]
    return eg.Scene(meshes, lights=lights), strip.camera


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [F64, torch.float32])
def test_what_stands_on_the_reflector(dtype: torch.dtype) -> None:
    weights, h = weights_of(Strip.standard()), 0.1

    def loss(theta: Tensor, spp: int, seed: int, **counts: Any) -> Tensor:
        image = eg.render(*block_on_reflector(theta, dtype), spp, seed, bounces=2, shadows=False, **counts)
        return (weights * image).sum()

    changes, slopes = [], []
    for seed in range(8):
        with torch.no_grad():
            high, low = (float(loss(torch.tensor(x, dtype=F64), 1 << 15, seed)) for x in (h, -h))
        changes.append((high - low) / (2 * h))
        slopes.append(0.0)
        for at, share in GAUSS:
            theta = torch.tensor(at * h, dtype=F64, requires_grad=True)
            value = loss(theta, 1, 50 + seed, sampling=eg.Sampling(edges=1_500_000, surface=1))
            slopes[-1] += share * float(torch.autograd.grad(value, theta)[0])
    print(right_ratio(estimate(changes), estimate(slopes)))
