"""Derivatives of the image in given directions (forward mode), and the gradient by places in the image."""

from __future__ import annotations

import math

import pytest
import torch
from combinations import diagonal
from finite_differences import Estimate, estimate
from oracles.exact import exact_image
from scenes import cube, icosphere, smooth_adjoint, smooth_colors
from threads import check_threads
from torch import Tensor
from torch.autograd import forward_ad
from torch_scenes import ADJOINT, BACKGROUND, CAMERA, F64, MESH, SIZE, TRIANGLE

import edgegrad as eg
from edgegrad.kernel import memory, operators

pytestmark = pytest.mark.watched

ORTHOGRAPHIC = eg.Camera.orthographic((0.4, 0.3, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.6, (SIZE, SIZE)).to(F64)
DISTORTED = CAMERA.replace(distortion=torch.tensor([-0.15, 0.05, 0.01, -0.02, 0.02], dtype=F64))


def panorama() -> eg.Camera:
    """Return a panorama that has what CAMERA sees behind it, across the seam: the middle of its image is turned there."""
    M = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=F64)) @ CAMERA.world_to_camera
    f = 0.8 * float(CAMERA.K[0, 0])
    K = torch.tensor([[f, 0.3, SIZE / 2 - math.pi * f + 1.3], [0.0, f, SIZE / 2 + 0.2], [0.0, 0.0, 1.0]], dtype=F64)
    return eg.Camera.panorama(M, (SIZE, SIZE), K)


PANORAMA = panorama()
SAMPLES = {"sampling": eg.Sampling(surface=4000, edges=4000)}


def mixed_scene() -> eg.Scene:
    """Smooth colours, creases, a texture, and a background image."""
    sphere = icosphere(2).transformed(scale=0.6, t=torch.tensor([-0.5, 0.1, 0.4], dtype=F64))
    box = cube(0.4).transformed(t=torch.tensor([0.6, -0.3, 0.5], dtype=F64))
    box = box.replace(face_colors=smooth_colors(3.0 * box.verts[box.faces].mean(1)))
    quad = torch.tensor([[-1.1, -0.9, -0.6], [0.9, -1.05, -0.4], [1.05, 0.8, -0.5], [-0.8, 1.0, -0.7]], dtype=F64)
    plane = eg.Mesh(
        quad,
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
        texture=ADJOINT[:3, :4].sigmoid(),
        uvs=torch.tensor([[0.1, 0.05], [0.9, 0.1], [0.95, 0.9], [0.0, 0.85]], dtype=F64),
        uv_faces=torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )
    return eg.Scene([sphere, box, plane], ADJOINT.sigmoid())


def smooth_direction(x: Tensor) -> Tensor:
    """Return a direction for an array that does not cancel out in sums."""
    n = torch.arange(x.numel(), dtype=F64).reshape(x.shape)
    return 1 + 0.5 * torch.sin(0.7 * n)


def inputs(scene: eg.Scene, camera: eg.Camera) -> dict[str, list[tuple[Tensor, Tensor]]]:
    """Tensors of a scene and a camera with a direction for each, by kind; tensors of a kind move together."""
    found: dict[str, list[tuple[Tensor, Tensor]]] = {}
    for mesh in scene.meshes:
        for name, value in vars(mesh).items():
            if isinstance(value, Tensor) and value.is_floating_point():
                kind = "verts" if name == "verts" else "uvs" if name == "uvs" else "colours"
                direction = (
                    value + torch.tensor([0.5, 0.2, 0.1], dtype=F64) if name == "verts" else smooth_direction(value)
                )
                found.setdefault(kind, []).append((value, direction.detach()))
    assert scene.background is not None
    found["background"] = [(scene.background, smooth_direction(scene.background))]
    turn = torch.tensor([[0, -0.3, 0.2, 0.1], [0.3, 0, -0.1, 0.2], [-0.2, 0.1, 0, 0.3], [0, 0, 0, 0]], dtype=F64)
    found["world_to_camera"] = [(camera.world_to_camera, turn)]
    found["K"] = [(camera.K, torch.tensor([[2.0, 0.5, 1.0], [0.3, 1.5, -0.7], [0, 0, 0]], dtype=F64))]
    if camera.distortion is not None:
        found["distortion"] = [(camera.distortion, smooth_direction(camera.distortion))]
    return found


def leaves(scene: eg.Scene, camera: eg.Camera) -> tuple[eg.Scene, eg.Camera]:
    def leaf(thing):
        floats = {n: v for n, v in vars(thing).items() if isinstance(v, Tensor) and v.is_floating_point()}
        return thing.replace(**{n: v.detach().clone().requires_grad_() for n, v in floats.items()})

    return leaf(scene).replace(meshes=[leaf(mesh) for mesh in scene.meshes]), leaf(camera)


def agree(name: str, forward: Estimate, reverse: Estimate) -> None:
    """⟨v, J u⟩ = ⟨Jᵀ v, u⟩ up to chance, and well enough known to decide either from 0.95 times itself."""
    error = (forward.error**2 + reverse.error**2) ** 0.5
    said = f"{name}: forward {forward}, reverse {reverse}"
    allowed = 4 * error + 0.005 * abs(reverse.mean)  # as in finite_differences.check()
    assert allowed < 0.045 * abs(reverse.mean), f"{said}; too noisy to decide"
    assert abs(forward.mean - reverse.mean) <= allowed, said


def crossing_scene() -> eg.Scene:
    """Two spheres through each other: between them, the image jumps where neither has an edge."""
    left, right = (
        icosphere(2).transformed(scale=0.8, t=torch.tensor([x, 0.1 * x, 0.0], dtype=F64)) for x in (-0.35, 0.4)
    )
    return eg.Scene([left, right.replace(colors=1 - right.colors)], BACKGROUND)


@pytest.mark.parametrize(
    ("scene", "camera", "filter"),
    [
        pytest.param(mixed_scene, CAMERA, "box", marks=pytest.mark.unwatched),
        (mixed_scene, ORTHOGRAPHIC, "gaussian"),
        (mixed_scene, CAMERA.crop(3, 2, 12, 14), "tent"),
        pytest.param(crossing_scene, DISTORTED, "gaussian", marks=pytest.mark.unwatched),
        (crossing_scene, PANORAMA, "box"),
    ],
    ids=[
        "perspective box",
        "orthographic gaussian",
        "crop tent",
        "crossing distorted",
        "crossing panorama",
    ],
)
def test_forward_is_the_adjoint_of_reverse(scene, camera, filter):
    scene = scene()
    scene, camera = leaves(scene.replace(background=smooth_adjoint(*camera.size, 3).sigmoid()), camera)
    kinds = inputs(scene, camera)
    tensors = [pair for pairs in kinds.values() for pair in pairs]
    # A direction for each kind.
    tangents = {
        x: torch.stack([u * float(any(x is y for y, _ in pairs)) for pairs in kinds.values()]) for x, u in tensors
    }
    samples = {"sampling": eg.Sampling(surface=8000, edges=8000)}
    # Any v will do; about J u itself, so that nothing cancels out.
    adjoints = eg.jvp(scene, camera, tangents, 4, 999, filter=filter, **samples)[1].detach()
    forward: dict[str, list[float]] = {kind: [] for kind in kinds}
    reverse: dict[str, list[float]] = {kind: [] for kind in kinds}
    for seed in range(6):
        dots = eg.jvp(scene, camera, tangents, 64, seed, filter=filter, **samples)[1].detach()
        image = eg.render(scene, camera, 64, 100 + seed, filter=filter, **samples)
        for (kind, pairs), adjoint, dot in zip(kinds.items(), adjoints, dots, strict=True):
            forward[kind].append(float((dot * adjoint).sum()))
            gradients = torch.autograd.grad(image, [x for x, _ in pairs], adjoint, retain_graph=True)
            reverse[kind].append(sum(float((g * u).sum()) for g, (_, u) in zip(gradients, pairs, strict=True)))
    for kind in kinds:
        agree(kind, estimate(forward[kind]), estimate(reverse[kind]))


@pytest.mark.parametrize("camera", [CAMERA, ORTHOGRAPHIC], ids=["perspective", "orthographic"])
def test_derivatives_of_pixels_are_exact(camera):
    """Pixel by pixel, against differences of exact pixel integrals of a scene in which one triangle hides another."""
    front = MESH.transformed(scale=0.8, t=torch.tensor([0.2, 0.1, 0.5], dtype=F64))
    front = front.replace(colors=1 - MESH.colors)
    scene = eg.Scene([MESH, front], BACKGROUND)
    direction = torch.tensor([[0.3, 0.1, -0.2], [-0.1, 0.4, 0.1], [0.2, -0.3, 0.3]], dtype=F64)

    def moved(h: float) -> Tensor:
        meshes = [MESH.replace(verts=MESH.verts - h * direction), front.replace(verts=front.verts + h * direction)]
        return exact_image(scene.replace(meshes=meshes), camera)

    exact = (moved(1e-6) - moved(-1e-6)) / 2e-6
    tangents = {MESH.verts: -direction[None], front.verts: direction[None]}
    found = torch.stack([eg.jvp(scene, camera, tangents, 4, seed, **SAMPLES)[1][0] for seed in range(24)])
    mean, error = found.mean(0), found.std(0) / 24**0.5
    assert ((mean - exact).abs() <= 6 * error + 0.002 * exact.abs().max()).all()
    assert float((mean - exact).norm() / exact.norm()) < 0.02


def test_directions_share_samples_and_each_is_what_it_is_alone():
    scene, camera = mixed_scene(), CAMERA
    kinds = inputs(scene, camera)
    (verts, u), (K, dK) = kinds["verts"][0], kinds["K"][0]
    both = {verts: torch.stack([u, 0 * u]), K: torch.stack([0 * dK, dK])}
    image, dots = eg.jvp(scene, camera, both, 4, 7)
    assert torch.equal(image, eg.render(scene, camera, 4, 7)) and dots.shape == (2, SIZE, SIZE, 3)
    # Samples inside faces depend on whether a direction asks for them, so each is compared with the other next to it.
    for d, (x, v) in enumerate(((verts, u), (K, dK))):
        torch.testing.assert_close(eg.jvp(scene, camera, {x: v[None]}, 4, 7)[1][0], dots[d], rtol=1e-12, atol=1e-12)


def test_all_directions_take_one_pass(monkeypatch):
    calls = []

    def watched(hits, request, tangents, directions):
        calls.append(directions)
        return jvp_kernel(hits, request, tangents, directions)

    jvp_kernel = operators.jvp_kernel
    monkeypatch.setattr(operators, "jvp_kernel", watched)
    eg.jvp(TRIANGLE, CAMERA, {MESH.verts: torch.ones(12, 3, 3, dtype=F64)}, 4, seed=0)
    torch.func.jacfwd(lambda t: eg.render(MESH.transformed(t=t), CAMERA, 4, seed=0))(torch.zeros(3, dtype=F64))
    assert calls == [12, 3]


def test_more_directions_than_memory(monkeypatch):
    monkeypatch.setattr(memory, "CHECKED_FROM", 0)
    monkeypatch.setattr(memory, "available", lambda: 20_000_000)
    with pytest.raises(MemoryError, match=r"jvp: .*\(samples in pixels 3.* GB.*ask for fewer directions"):
        eg.jvp(TRIANGLE, CAMERA, {MESH.verts: torch.ones(2000, 3, 3, dtype=F64)}, 4, seed=0)


def test_derivatives_are_not_in_the_graph():
    verts = MESH.verts.clone().requires_grad_()
    image, dots = eg.jvp(MESH.replace(verts=verts), CAMERA, {verts: torch.ones(1, 3, 3, dtype=F64)}, 4, seed=0)
    assert not image.requires_grad and not dots.requires_grad


def test_through_torch():
    """torch.func.jvp, jacfwd and dual numbers, also of what the vertices are computed from; and a batch of cameras."""
    cameras = eg.Camera.stack([CAMERA, CAMERA.replace(K=CAMERA.K * torch.tensor([[1.1], [1.1], [1.0]], dtype=F64))])

    def image(t: Tensor, camera: eg.Camera = CAMERA) -> Tensor:
        return eg.render(eg.Scene(MESH.transformed(t=t), BACKGROUND), camera, 4, seed=0)

    zero, axes = torch.zeros(3, dtype=F64), torch.eye(3, dtype=F64)
    expected = torch.stack([torch.func.jvp(image, (zero,), (axis,))[1] for axis in axes])
    assert expected.abs().amax((1, 2, 3)).min() > 0.1
    assert torch.equal(torch.func.jacfwd(image)(zero), expected.movedim(0, -1))
    tangents = {MESH.verts: axes[:, None].expand(3, 3, 3)}
    assert torch.equal(eg.jvp(TRIANGLE, CAMERA, tangents, 4, seed=0)[1], expected)
    with forward_ad.dual_level():
        primal, tangent = forward_ad.unpack_dual(image(forward_ad.make_dual(zero, axes[1])))
        assert torch.equal(tangent, expected[1]) and torch.equal(primal, image(zero))
    batch = torch.func.jvp(lambda t: image(t, cameras), (zero,), (axes[0],))[1]
    assert batch.shape == (2, SIZE, SIZE, 3) and torch.equal(batch[0], expected[0]) and batch[1].any()
    moved = torch.stack([zero, 0.3 * axes[0]])
    mapped = torch.vmap(lambda t: torch.func.jvp(image, (t,), (axes[0],))[1])(moved)
    assert torch.equal(mapped, torch.stack([torch.func.jvp(image, (t,), (axes[0],))[1] for t in moved]))


def test_types():
    scene, camera = TRIANGLE.to(torch.float32), CAMERA.to(torch.float32)
    verts = scene.meshes[0].verts
    image, dots = eg.jvp(scene, camera, {verts: torch.ones(2, 3, 3)}, 4, seed=0)
    assert image.dtype == dots.dtype == torch.float32 and torch.equal(dots[0], dots[1])
    assert eg.screen_gradient(scene, camera, ADJOINT.float(), seed=0).dtype == torch.float32


def test_same_bits_at_any_number_of_threads():
    scene = mixed_scene()
    tangents = {x: u[None] for x, u in inputs(scene, CAMERA)["verts"]}
    check_threads(
        lambda: [eg.jvp(scene, CAMERA, tangents, 4, seed=0)[1], eg.screen_gradient(scene, CAMERA, ADJOINT, seed=0)]
    )


@pytest.mark.parametrize(
    ("tangents", "message"),
    [
        ({}, "tangents: expected a mapping"),
        ({MESH.verts.clone(): torch.ones(1, 3, 3)}, "tangents: expected .* that the scene or the camera holds"),
        ({MESH.faces: torch.ones(1, 1, 3)}, "tangents: expected floating-point tensors"),
        ({"verts": torch.ones(1, 3, 3)}, "tangents: expected .* got str"),
        ({MESH.verts: torch.ones(3, 3)}, r"tangents: expected shape .*tangent\[None\]"),
        ({MESH.verts: torch.ones(())}, "tangents: expected shape"),
        ({MESH.verts: None}, "tangents: expected a tensor"),
        ({MESH.verts: torch.ones(0, 3, 3)}, "tangents: expected shape"),
        ({MESH.verts: torch.ones(2, 3, 3), CAMERA.K: torch.ones(1, 3, 3)}, "tangents: expected as many directions"),
        ({MESH.verts: torch.full((1, 3, 3), torch.nan)}, "tangents: expected finite"),
    ],
)
def test_tangents_that_do_not_fit(tangents, message):
    with pytest.raises((TypeError, ValueError), match=message):
        eg.jvp(TRIANGLE, CAMERA, tangents, seed=0)


# -- the gradient by places in the image ------------------------------------------------------------------------------


@pytest.mark.unwatched
@pytest.mark.parametrize(
    ("camera", "scene", "filter"),
    diagonal([CAMERA, ORTHOGRAPHIC, DISTORTED, PANORAMA], [mixed_scene, crossing_scene], ["gaussian", "box"]),
)
def test_screen_gradient_sums_to_that_of_moving_everything(camera, scene, filter):
    """The image moves by (1, 0) and (0, 1) px, as the principal point does."""
    scene = scene()
    K = camera.K.clone().requires_grad_()
    adjoint, samples = ADJOINT + 0.4, {"sampling": eg.Sampling(surface=12_000, edges=12_000)}
    places, sums = [], []
    for seed in range(16):
        image = eg.render(scene, camera.replace(K=K), 16, seed, filter=filter, **samples)
        sums.append(torch.autograd.grad(image, K, adjoint)[0][:2, 2])
        places.append(eg.screen_gradient(scene, camera, adjoint, 16, 50 + seed, filter=filter, **samples).sum((0, 1)))
    for axis in range(2):
        agree("xy"[axis], estimate([float(p[axis]) for p in places]), estimate([float(s[axis]) for s in sums]))


def test_screen_gradient_lies_where_things_are():
    """Each of two objects apart has in its pixels what moving it alone gives. There is none where the adjoint is zero."""
    left, right = (cube(0.5).transformed(t=torch.tensor([x, 0.0, 0.0], dtype=F64)) for x in (-0.7, 0.7))
    scene = eg.Scene([left, right])
    pixels = float(ORTHOGRAPHIC.K[0, 0])
    camera = eg.Camera.orthographic((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.6, (SIZE, SIZE)).to(F64)
    by_place, by_mesh = [[], []], [[], []]
    for seed in range(12):
        found = eg.screen_gradient(scene, camera, ADJOINT, 16, seed, **SAMPLES)
        shift = torch.zeros(2, dtype=F64, requires_grad=True)
        along = torch.tensor([1.0, 0.0, 0.0], dtype=F64)
        meshes = [
            mesh.replace(verts=mesh.verts + s / pixels * along) for mesh, s in zip((left, right), shift, strict=True)
        ]
        image = eg.render(eg.Scene(meshes), camera, 16, 50 + seed, **SAMPLES)
        (gradient,) = torch.autograd.grad(image, shift, ADJOINT)
        for k, columns in enumerate((slice(0, SIZE // 2), slice(SIZE // 2, SIZE))):
            by_place[k].append(float(found[:, columns, 0].sum()))
            by_mesh[k].append(float(gradient[k]))
    for k in range(2):
        agree(f"object {k}", estimate(by_place[k]), estimate(by_mesh[k]))
    half = ADJOINT.clone()
    half[:, : SIZE // 2] = 0
    assert not eg.screen_gradient(scene, camera, half, seed=0)[:, : SIZE // 2].any()


def test_screen_gradient_of_a_batch_and_of_what_does_not_fit():
    cameras = eg.Camera.stack([CAMERA, ORTHOGRAPHIC.replace(projection="perspective", K=CAMERA.K * 1.0)])
    batch = eg.screen_gradient(TRIANGLE, cameras, ADJOINT.expand(2, SIZE, SIZE, 3), seed=0)
    assert batch.shape == (2, SIZE, SIZE, 2)
    assert torch.equal(batch[0], eg.screen_gradient(TRIANGLE, CAMERA, ADJOINT, seed=0))
    with pytest.raises(ValueError, match="adjoint: expected shape"):
        eg.screen_gradient(TRIANGLE, CAMERA, ADJOINT[:5], seed=0)
    with pytest.raises(ValueError, match="adjoint: expected finite"):
        eg.screen_gradient(TRIANGLE, CAMERA, ADJOINT * torch.nan, seed=0)
