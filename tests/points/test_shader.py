"""Shaders written in PyTorch: the same images and gradients as the kernel's own, and what is refused."""

from __future__ import annotations

import pytest
import torch
import torch.utils.checkpoint
from combinations import diagonal
from scenes import front_camera, icosphere, smooth_adjoint, smooth_colors
from shader_scenes import F64, SIZE, bumpy, by_hand, cameras, colored, network, textured
from torch import Tensor

import edgegrad as eg
from edgegrad.points.check_shader import check_shader


def gradients(scene: eg.Scene, camera: eg.Camera, shaded: bool, seed: int, **options: object) -> dict[str, Tensor]:
    """Return the gradient of the loss by every tensor of scene and camera."""
    leaves: dict[str, Tensor] = {}

    def leaf(name: str, tensor: Tensor) -> Tensor:
        leaves[name] = tensor.clone().requires_grad_()
        return leaves[name]

    mesh = scene.meshes[0]
    names = [n for n in ("verts", "colors", "texture", "uvs") if getattr(mesh, n) is not None]
    mesh = mesh.replace(**{n: leaf(n, getattr(mesh, n)) for n in names})
    background = None if scene.background is None else leaf("background", scene.background)
    names = [n for n in ("world_to_camera", "K", "distortion") if getattr(camera, n) is not None]
    camera = camera.replace(**{n: leaf(n, getattr(camera, n)) for n in names})
    scene = eg.Scene([mesh], background)
    more = {"shader": by_hand(scene)} if shaded else {}
    image = eg.render(scene, camera, spp=128, seed=seed, **options, **more)  # type: ignore[arg-type]
    adjoint = smooth_adjoint(*camera.size, 3)
    values = torch.autograd.grad((image * adjoint).sum(), list(leaves.values()))
    return dict(zip(leaves, values, strict=True)) | {"image": image.detach()}


@pytest.mark.parametrize(
    ("kind", "view", "filter"),
    diagonal(["colors", "texture"], ["perspective", "orthographic", "distorted"], ["box", "gaussian"]),
)
def test_the_same_as_the_kernels_own(kind: str, view: str, filter: str):
    scene = colored()[0] if kind == "colors" else textured()
    camera = cameras()[view]
    options = {"filter": filter, "sampling": eg.Sampling(surface=20000, edges=20000)}
    many = 6
    own = [gradients(scene, camera, False, seed, **options) for seed in range(many)]
    twin = [gradients(scene, camera, True, 100 + seed, **options) for seed in range(many)]
    for name in own[0]:
        a, b = (torch.stack([run[name] for run in runs]) for runs in (own, twin))
        difference = (a.mean(0) - b.mean(0)).norm()
        noise = (((a.var(0) + b.var(0)) / many).sum()).sqrt()
        size = a.mean(0).norm()
        assert noise < 0.012 * size, f"{name}: too noisy to decide, {float(noise / size):.2%}"
        # The norm of noise in many numbers is near its expected value; one number may be three times as far off.
        assert difference < (2 if a[0].numel() > 30 else 3.5) * noise + 0.001 * size, (
            f"{name}: {float(difference / size):.2%}"
        )


def test_a_wall_without_curves():
    """All that is seen is one face: there are no curves to sample, and the interior is the kernel's own."""
    verts = torch.tensor([[-40.0, -40.0, 0.0], [40.0, -40.0, 0.5], [0.0, 60.0, -0.5]], dtype=F64, requires_grad=True)
    wall = eg.Mesh(verts, torch.tensor([[0, 1, 2]]), colors=smooth_colors(verts.detach()))
    found = []
    for shader in (None, lambda hits: hits.interpolate(wall.colors, "vertex")):
        image = eg.render(wall, front_camera(SIZE), 16, sampling=eg.Sampling(surface=100_000), shader=shader, seed=0)
        found.append(torch.autograd.grad((image * smooth_adjoint(SIZE, SIZE, 3)).sum(), verts)[0])
    assert found[0].abs().max() > 0
    torch.testing.assert_close(found[1], found[0], rtol=0.02, atol=0.01 * float(found[0].abs().max()))


def test_tensors_that_only_the_shader_uses_get_no_boundary_and_no_kernel_gradient():
    scene, camera = colored()
    gain = torch.ones(3, dtype=F64, requires_grad=True)
    colors = scene.meshes[0].colors
    assert colors is not None
    image = eg.render(scene, camera, shader=lambda hits: gain * hits.interpolate(colors), seed=0)
    assert image.requires_grad
    grad = torch.autograd.grad(image.sum(), gain)[0]
    assert scene.background is not None
    surfaces = image - (1 - coverage(scene, camera))[..., None] * scene.background
    own = surfaces.sum((0, 1))
    assert torch.allclose(grad, own.detach(), rtol=0.02)


def coverage(scene: eg.Scene, camera: eg.Camera) -> Tensor:
    return eg.render(
        scene.replace(background=None), camera, shader=lambda hits: torch.ones_like(hits.position[:, :1]), seed=0
    )[..., 0]


# -- as any PyTorch ---------------------------------------------------------------------------------------------------


def lit(verts: Tensor, colors: Tensor, seed: int = 3, **options: object) -> Tensor:
    ball = icosphere(2)
    return eg.render(
        ball.replace(verts=verts),
        front_camera(SIZE),
        seed=seed,
        shader=lambda hits: hits.interpolate(colors) * (2 + hits.shading_normal),
        **options,  # type: ignore[arg-type]
    )


def inputs() -> tuple[Tensor, Tensor, Tensor, Tensor]:
    ball = icosphere(2)
    generator = torch.Generator().manual_seed(2)
    random = [torch.randn(ball.verts.shape, generator=generator, dtype=F64) for _ in range(2)]
    return 0.9 * ball.verts, smooth_colors(ball.verts), 0.1 * random[0], random[1]


def test_forward_mode_is_the_adjoint_of_reverse_mode():
    verts, colors, verts_dot, colors_dot = inputs()
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    leaves = verts.clone().requires_grad_(), colors.clone().requires_grad_()
    bars = torch.autograd.grad((lit(*leaves) * adjoint).sum(), leaves)
    for leaf, bar, dot in ((0, bars[0], verts_dot), (1, bars[1], colors_dot)):
        expected = (bar * dot).sum()

        def image(x: Tensor, leaf: int = leaf) -> Tensor:
            return lit(x, colors) if leaf == 0 else lit(verts, x)

        image_dot: Tensor = torch.func.jvp(image, ((verts, colors)[leaf],), (dot,))[1]
        assert torch.allclose((image_dot * adjoint).sum(), expected, rtol=1e-9)
        assert torch.allclose(
            torch.func.grad(lambda x: (image(x) * adjoint).sum())((verts, colors)[leaf]), bar, rtol=1e-9
        )
    _, image_dots = eg.jvp(
        (mesh := icosphere(2).replace(verts=verts)),
        front_camera(SIZE),
        {mesh.verts: verts_dot[None]},
        seed=3,
        shader=lambda hits: hits.interpolate(colors) * (2 + hits.shading_normal),
    )
    assert torch.allclose((image_dots[0] * adjoint).sum(), (bars[0] * verts_dot).sum(), rtol=1e-9)


def test_graphs_of_all_kinds():
    verts, colors, *_ = inputs()
    leaf = verts.clone().requires_grad_()
    loss = lit(leaf, colors).square().sum()
    first, again = (torch.autograd.grad(loss, leaf, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, again)
    kept = torch.utils.checkpoint.checkpoint(lambda x: lit(x, colors), leaf, use_reentrant=False)
    assert torch.equal(torch.autograd.grad(kept.square().sum(), leaf)[0], first)
    with torch.no_grad():
        value = lit(leaf, colors)
    assert not value.requires_grad and torch.equal(value, lit(leaf, colors).detach())
    linear = torch.nn.Linear(3, 2)
    with torch.autocast("cpu", torch.bfloat16):
        half = eg.render(
            icosphere(1).to(torch.float32), front_camera(8), shader=lambda hits: linear(hits.position), seed=0
        )
    assert half.dtype == torch.float32
    half.sum().backward()
    assert linear.weight.grad is not None and bool(linear.weight.grad.any())


def test_cameras_of_a_batch():
    verts, colors, *_ = inputs()
    camera = front_camera(SIZE)
    moved = camera.world_to_camera.clone()
    moved[0, 3] += 0.2
    batch = camera.replace(world_to_camera=torch.stack([camera.world_to_camera, moved]))

    def shader(hits: eg.points.Hits) -> Tensor:
        return hits.interpolate(colors)

    mesh = icosphere(2).replace(verts=verts)
    images = eg.render(mesh, batch, seed=4, shader=shader)
    assert torch.equal(images[0], eg.render(mesh, camera, seed=4, shader=shader))
    other = eg.render(mesh, camera.replace(world_to_camera=moved), spp=256, shader=shader, seed=0)
    assert float((images[1] - other).abs().mean()) < 0.02


REFUSED = {
    "rows": (lambda hits: hits.position[:3], ValueError, "a row for each hit"),
    "one axis": (lambda hits: hits.depth, ValueError, r"value\[:, None\]"),
    "integers": (lambda hits: hits.mesh[:, None], TypeError, "floating-point"),
    "nothing": (lambda hits: None, TypeError, "expected a tensor"),
    "not numbers": (lambda hits: hits.position / 0.0, ValueError, "finite"),
    "a mean": (lambda hits: hits.position - hits.position.mean(0), ValueError, "each point by itself"),
    "coordinates that are not there": (lambda hits: hits.uv, ValueError, "no texture coordinates"),
    "an attribute of what": (lambda hits: hits.interpolate(torch.zeros(5, 2)), ValueError, "attribute"),
    "no function": (3, TypeError, "a function of Hits"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(name: str):
    shader, error, text = REFUSED[name]
    with pytest.raises(error, match=text):
        if text == "each point by itself":
            check_shader(icosphere(1), front_camera(8), shader)
        else:
            eg.render(icosphere(1), front_camera(8), shader=shader, seed=0)


def test_more_arguments_that_are_refused():
    hits = eg.points.primary_hits(icosphere(1), front_camera(8), 1, seed=0).hits
    meta = torch.zeros(1, 3, device="meta")
    for error, match, call in (
        (ValueError, "creases: expected", lambda: eg.Sampling(creases="all")),
        (ValueError, "creases: expected", lambda: eg.Sampling(creases=torch.tensor([1, 0]))),
        (TypeError, "n: expected an int", lambda: hits.random("a")),
        (ValueError, "part: expected an int from 0 to 1", lambda: hits.random(2, part=2, parts=2)),
        (TypeError, "light: expected one of", lambda: eg.lights.points_by_material(hits, 3, 1)),
        (TypeError, "hits: expected Hits", lambda: eg.lights.points_by_material(3, 3, 1)),
        (ValueError, "origins: expected numbers", lambda: eg.points.trace(icosphere(1), meta, torch.ones(1, 3))),
    ):
        with pytest.raises(error, match=match):
            call()
    plain = eg.Mesh(icosphere(1).verts, icosphere(1).faces)
    with pytest.raises(ValueError, match="as many channels as the background"):
        eg.render(eg.Scene([plain], torch.zeros(2)), front_camera(8), shader=lambda hits: hits.position, seed=0)
    with pytest.raises(RuntimeError, match=r"torch\.vmap"):
        torch.vmap(
            lambda v: eg.render(icosphere(1).replace(verts=v), front_camera(8), shader=lambda h: h.position, seed=0)
        )(torch.stack([icosphere(1).verts] * 2))


# -- each face in a pixel shaded once -----------------------------------------------------------------------------------


def images(shaded: bool, seeds: int, spp: int) -> Tensor:
    """(seeds, H, W, C) of a texture of noise on a ball."""
    scene, camera = textured(), front_camera(SIZE)
    texture = torch.rand((32, 32, 1), generator=torch.Generator().manual_seed(1), dtype=F64)
    scene = eg.Scene([scene.meshes[0].replace(texture=texture)])
    more = {"shader": by_hand(scene)} if shaded else {}
    with torch.no_grad():
        return torch.stack([eg.render(scene, camera, spp=spp, seed=seed, **more) for seed in range(seeds)])


@pytest.mark.slow
def test_shading_once_is_unbiased():
    once, every = images(True, 256, 16), images(False, 256, 16)
    error = ((once.var(0) + every.var(0)) / 256).sqrt()
    some = error > 1e-4
    z = ((once.mean(0) - every.mean(0)) / error)[some]
    assert int(some.sum()) > 200
    assert abs(float(z.mean())) < 4 / len(z) ** 0.5
    assert 0.8 < float(z.square().mean()) < 1.25
    # It is noisier, as one sample of a face is than the mean of sixteen that share a lattice.
    assert float(once.var(0).mean()) > 2 * float(every.var(0).mean())


@pytest.mark.parametrize("lit", [False, True])
def test_noise_of_shading_falls_with_samples(lit):
    """16 times as many samples, a quarter of the noise."""
    scene = textured()
    texture = torch.rand((32, 32, 1), generator=torch.Generator().manual_seed(1), dtype=F64)
    mesh = scene.meshes[0].replace(texture=texture)
    emitter = eg.lights.PointLight(torch.tensor([2.0, 3.0, 2.5], dtype=F64), 20.0)
    scene = eg.Scene([mesh.replace(material=eg.Material())], lights=[emitter]) if lit else eg.Scene([mesh])
    more = {} if lit else {"shader": by_hand(scene)}

    def images(spp: int) -> Tensor:
        with torch.no_grad():
            return torch.stack([eg.render(scene, front_camera(SIZE), spp=spp, seed=k, **more) for k in range(12)])

    few, many = images(16), images(256)
    noise = (few.var(0).mean() / many.var(0).mean()).sqrt()
    assert 3.2 < float(noise) < 5.5
    assert abs(float(few.mean() / many.mean()) - 1) < 0.01


def test_a_batch_of_attributes_of_faces_under_vmap():
    mesh, camera = icosphere(1), front_camera(SIZE)
    colors = torch.rand((3, len(mesh.faces), 2), generator=torch.Generator().manual_seed(0), dtype=F64)

    def image(colors: Tensor, verts: Tensor) -> Tensor:
        return eg.render(
            mesh.replace(verts=verts),
            camera,
            shader=lambda hits: hits.interpolate(colors),
            sampling=eg.Sampling(edges=20000, surface=20000),
            seed=0,
        )

    def gradient(colors: Tensor) -> tuple[Tensor, ...]:
        adjoint = smooth_adjoint(SIZE, SIZE, 2)
        return torch.func.grad(lambda c, v: (image(c, v) * adjoint).sum(), argnums=(0, 1))(colors, mesh.verts)

    together = torch.func.vmap(gradient)(colors)
    for k in range(3):
        for one, all in zip(gradient(colors[k]), together, strict=True):
            assert (one - all[k]).norm() < 0.03 * one.norm()


def test_in_parts_of_bounded_size(monkeypatch: pytest.MonkeyPatch):
    """The number of points that the shader is given at once changes nothing."""
    mesh, camera = bumpy(), front_camera(SIZE)
    net = network(6)
    sizes = []

    def shader(hits: eg.points.Hits) -> Tensor:
        sizes.append(len(hits))
        return hits.where(hits.position[:, 0] - 0.1, net(torch.cat([hits.position, hits.normal], 1)), 0.3)

    def gradients() -> list[Tensor]:
        verts = mesh.verts.clone().requires_grad_()
        image = eg.render(mesh.replace(verts=verts), camera, seed=2, shader=shader)
        loss = (image * smooth_adjoint(SIZE, SIZE, 3)).sum()
        return [image.detach(), *torch.autograd.grad(loss, [verts, *net.parameters()])]

    whole, most = gradients(), max(sizes)
    sizes.clear()
    monkeypatch.setattr("edgegrad.shader.POINTS_AT_ONCE", 128)
    for a, b in zip(gradients(), whole, strict=True):
        assert torch.allclose(a, b, rtol=1e-6, atol=1e-9 * float(b.abs().max()))
    assert max(sizes) <= 1024 < most  # rows of an image are whole


def test_nothing_in_view_has_gradients_of_zero():
    """A loop goes on where the mesh has left the image, as without a shader."""
    mesh, camera = bumpy(), front_camera(SIZE)
    net = network(6)
    verts = (mesh.verts + 100.0).requires_grad_()
    image = eg.render(
        mesh.replace(verts=verts), camera, shader=lambda h: net(torch.cat([h.position, h.normal], 1)), seed=0
    )  # fmt: skip
    for gradient in torch.autograd.grad(image.sum(), [verts, *net.parameters()]):
        assert float(gradient.abs().max()) == 0
