"""Shaders written in PyTorch: the same images and gradients as the kernel's own, finite differences of others, and what is
refused."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
import torch.utils.checkpoint
from combinations import diagonal
from finite_differences import Estimate, estimate, right_ratio
from scenes import front_camera, icosphere, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
SIZE = 24
Case = Callable[[Tensor], tuple[eg.Scene, eg.Camera, Callable[[eg.Hits], Tensor]]]

# -- the same as the kernel's own shading -----------------------------------------------------------------------------


def colored(filter: str = "box") -> tuple[eg.Scene, eg.Camera]:
    ball = icosphere(2)
    ball = ball.replace(verts=0.9 * ball.verts, colors=smooth_colors(ball.verts))
    return eg.Scene([ball], torch.tensor([0.2, 0.5, 0.3], dtype=F64)), front_camera(SIZE)


def cameras() -> dict[str, eg.Camera]:
    straight = front_camera(SIZE)
    w, K = straight.world_to_camera, straight.K
    flat = K.clone()
    flat[:2, :2] /= 3.0
    return {
        "perspective": straight,
        "orthographic": eg.Camera(w, flat, (SIZE, SIZE), "orthographic"),
        "distorted": straight.replace(distortion=torch.tensor([-0.4, 0.3, 0.02, -0.01], dtype=F64)),
    }


def by_hand(scene: eg.Scene) -> Callable[[eg.Hits], Tensor]:
    mesh = scene.meshes[0]
    if mesh.texture is not None:
        texture = mesh.texture
        return lambda hits: hits.sample(texture)
    colors = mesh.colors
    assert colors is not None
    return lambda hits: hits.interpolate(colors)


def textured() -> eg.Scene:
    ball = icosphere(2)
    uvs = 0.25 * ball.verts[:, :2] + 0.5
    texture = torch.rand((4, 4, 3), generator=torch.Generator().manual_seed(1), dtype=F64)
    return eg.Scene([eg.Mesh(0.9 * ball.verts, ball.faces, texture=texture, uvs=uvs, uv_faces=ball.faces)])


def gradients(scene: eg.Scene, camera: eg.Camera, shaded: bool, seed: int, **options: object) -> dict[str, Tensor]:
    """Of the loss by every tensor of scene and camera."""
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
    options = {"filter": filter, "surface_samples": 20000, "edge_samples": 20000}
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
        image = eg.render(wall, front_camera(SIZE), 16, surface_samples=100_000, shader=shader)
        found.append(torch.autograd.grad((image * smooth_adjoint(SIZE, SIZE, 3)).sum(), verts)[0])
    assert found[0].abs().max() > 0
    torch.testing.assert_close(found[1], found[0], rtol=0.02, atol=0.01 * float(found[0].abs().max()))


def test_tensors_that_only_the_shader_uses_get_no_boundary_and_no_kernel_gradient():
    scene, camera = colored()
    gain = torch.ones(3, dtype=F64, requires_grad=True)
    colors = scene.meshes[0].colors
    assert colors is not None
    image = eg.render(scene, camera, shader=lambda hits: gain * hits.interpolate(colors))
    assert image.requires_grad
    grad = torch.autograd.grad(image.sum(), gain)[0]
    assert scene.background is not None
    surfaces = image - (1 - coverage(scene, camera))[..., None] * scene.background
    own = surfaces.sum((0, 1))
    assert torch.allclose(grad, own.detach(), rtol=0.02)


def coverage(scene: eg.Scene, camera: eg.Camera) -> Tensor:
    return eg.render(scene.replace(background=None), camera, shader=lambda hits: torch.ones_like(hits.position[:, :1]))[
        ..., 0
    ]


# -- against finite differences ---------------------------------------------------------------------------------------


def turned(scene: eg.Scene, theta: Tensor) -> eg.Scene:
    c, s, zero, one = torch.cos(theta), torch.sin(theta), torch.zeros_like(theta), torch.ones_like(theta)
    R = torch.stack([torch.stack([c, zero, s]), torch.stack([zero, one, zero]), torch.stack([-s, zero, c])])
    return scene.transformed(R, 0.3 * theta * torch.tensor([1.0, -0.5, 0.2], dtype=F64))


def bumpy() -> eg.Mesh:
    ball = icosphere(3)
    return ball.replace(
        verts=ball.verts * (0.8 + 0.12 * torch.sin(5 * ball.verts[:, :1]) * torch.cos(4 * ball.verts[:, 1:2]))
    )


def network(width: int) -> torch.nn.Module:
    torch.manual_seed(3)
    layers = [torch.nn.Linear(width, 16), torch.nn.Tanh(), torch.nn.Linear(16, 3), torch.nn.Sigmoid()]
    return torch.nn.Sequential(*layers).double()


NET, FEATURES = network(6), network(4)
TEXTURE = torch.rand((8, 8, 4), generator=torch.Generator().manual_seed(5), dtype=F64)
HARMONICS = torch.rand((4, 3), generator=torch.Generator().manual_seed(6), dtype=F64)


def of_position_and_view(hits: eg.Hits, theta: Tensor) -> Tensor:
    return NET(torch.cat([2 * hits.position, hits.view], 1))


def harmonics(hits: eg.Hits, theta: Tensor) -> Tensor:
    n = hits.shading_normal
    return torch.cat([torch.ones_like(n[:, :1]), n], 1) @ HARMONICS


def neural_texture(hits: eg.Hits, theta: Tensor) -> Tensor:
    return FEATURES(hits.sample(TEXTURE, uv=0.4 * hits.position[:, :2] + 0.5))


def flat_normals(hits: eg.Hits, theta: Tensor) -> Tensor:
    return 0.5 + 0.5 * hits.normal


def by_mesh(hits: eg.Hits, theta: Tensor) -> Tensor:
    red = torch.stack([0.9 + 0 * hits.depth, 0.2 * hits.depth, 0.1 + 0 * hits.depth], 1)
    return torch.where((hits.mesh == 0)[:, None], red, 0.5 + 0.4 * hits.shading_normal)


def checkerboard(hits: eg.Hits, theta: Tensor) -> Tensor:
    """In world space."""
    cells = hits.floor(1.7 * hits.position[:, :2] + 0.6 * hits.position[:, 2:] + 0.4).sum(1, keepdim=True)
    return 0.2 + 0.6 * (cells % 2) * torch.tensor([1.0, 0.7, 0.4], dtype=F64) + 0.1 * hits.position


def disc(hits: eg.Hits, theta: Tensor) -> Tensor:
    """Painted on, along the view, and a ring of the same border that must not count twice."""
    s = 0.4 - (hits.position[:, :2] - 0.1).norm(dim=1)
    inside = hits.where(s, torch.tensor([0.9, 0.8, 0.7], dtype=F64), 0.3 + 0.2 * hits.position)
    return inside + hits.where(-3 * s, 0.0, 0.2)


def nearest(hits: eg.Hits, theta: Tensor) -> Tensor:
    return hits.sample(TEXTURE[..., :3], uv=0.4 * hits.position[:, :2] + 0.5, filter="nearest")


def step_of_itself(hits: eg.Hits, theta: Tensor) -> Tensor:
    return hits.where(hits.position[:, 1] - 0.4 * hits.position[:, 0] - theta, 0.8 * torch.ones(3, dtype=F64), 0.2)


def of_itself(hits: eg.Hits, theta: Tensor) -> Tensor:
    return torch.sigmoid((2 + theta) * hits.position + theta)


SHADERS = {
    "network": of_position_and_view,
    "harmonics": harmonics,
    "neural texture": neural_texture,
    "flat normals": flat_normals,
    "by mesh": by_mesh,
    "its own parameter": of_itself,
    "checkerboard": checkerboard,
    "disc": disc,
    "nearest texture": nearest,
    "its own step": step_of_itself,
}
STEPS = {"pose": 0.01, "focal": 0.3, "shape": 0.02}


def case(name: str, of: str) -> Case:
    other = icosphere(2)
    meshes = [bumpy(), other.replace(verts=0.6 * other.verts + 0.45)] if name == "by mesh" else [bumpy()]
    # Nothing straight on: there a few edges would come and go together.
    R = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, -0.2], [-0.3, 0, 0.4], [0.2, -0.4, 0]], dtype=F64))
    scene = eg.Scene(
        [eg.Mesh(mesh.verts @ R.T, mesh.faces) for mesh in meshes], torch.tensor([0.1, 0.3, 0.6], dtype=F64)
    )
    camera = front_camera(SIZE)

    def at(theta: Tensor) -> tuple[eg.Scene, eg.Camera, Callable[[eg.Hits], Tensor]]:
        def shader(hits: eg.Hits) -> Tensor:
            return SHADERS[name](hits, theta)

        if name.startswith("its own"):
            return scene, camera, shader
        if of == "pose":
            return turned(scene, theta), camera, shader
        if of == "focal":
            K = camera.K.clone() * torch.stack([1 + theta / camera.K[0, 0]] * 2 + [torch.ones_like(theta)])[:, None]
            K = torch.cat(
                [
                    torch.stack([K[0, 0], K[0, 1], camera.K[0, 2]])[None],
                    torch.stack([K[1, 0], K[1, 1], camera.K[1, 2]])[None],
                    camera.K[2:],
                ]
            )
            return scene, camera.replace(K=K), shader
        return (
            eg.Scene(
                [m.replace(verts=m.verts * (1 + theta * torch.sin(3 * m.verts))) for m in scene.meshes],
                scene.background,
            ),
            camera,
            shader,
        )

    return at


def loss(case: Case, theta: Tensor, seed: int, spp: int, **options: object) -> Tensor:
    scene, camera, shader = case(theta)
    image = eg.render(scene, camera, spp=spp, seed=seed, shader=shader, **options)  # type: ignore[arg-type]
    return (image * smooth_adjoint(*camera.size, 3)).sum()


FINER = 24


def differences(case: Case, step: float, seeds: int) -> Estimate:
    """Of images whose samples are the pixels of a finer one: there a shader is asked for each, not once for all on a face."""

    def fine_loss(theta: float, seed: int) -> float:
        scene, camera, shader = case(torch.tensor(theta, dtype=F64))
        K = torch.cat([FINER * camera.K[:2], camera.K[2:]])
        fine = camera.replace(K=K, size=(FINER * SIZE, FINER * SIZE))
        image = eg.render(scene, fine, spp=1, seed=seed, shader=shader).movedim(-1, 0)
        image = torch.nn.functional.avg_pool2d(image, FINER).movedim(0, -1)
        return float((image * smooth_adjoint(SIZE, SIZE, 3)).sum())

    with torch.no_grad():
        return estimate([(fine_loss(step, seed) - fine_loss(-step, seed)) / (2 * step) for seed in range(seeds)])


def derivative(case: Case, seeds: int) -> Estimate:
    values = []
    for seed in range(seeds):
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        value = loss(case, theta, 1000 + seed, 16, surface_samples=60000, edge_samples=60000, step_spacing=1 / 16)
        values.append(torch.autograd.grad(value, theta)[0].item())
    return estimate(values)


def check(name: str, of: str, seeds: int) -> None:
    own, stepped = name.startswith("its own"), name in ("checkerboard", "disc", "nearest texture", "its own step")
    step = STEPS["pose" if own else of]
    if stepped and of == "shape":  # borders move much: the second-order error is larger still
        # Of nearest texels less so, and noise is more.
        step, seeds = step / (2 if name == "nearest texture" else 4), 4 * seeds
    at = case(name, of)
    right_ratio(differences(at, step, seeds), derivative(at, 24 if stepped else 6))


@pytest.mark.parametrize("name", ["network", "flat normals", pytest.param("disc", marks=pytest.mark.slow)])
def test_against_finite_differences(name: str):
    check(name, "pose", 8)


@pytest.mark.slow
@pytest.mark.parametrize("of", STEPS)
@pytest.mark.parametrize("name", SHADERS)
def test_all_against_finite_differences(name: str, of: str):
    check(name, of, 60 if of == "shape" else 40)  # whose step is short, for its second-order error is large


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
        half = eg.render(icosphere(1).to(torch.float32), front_camera(8), shader=lambda hits: linear(hits.position))
    assert half.dtype == torch.float32
    half.sum().backward()
    assert linear.weight.grad is not None and bool(linear.weight.grad.any())


@pytest.mark.parametrize("power", [1, 2])
def test_second_derivatives_are_refused(power: int):
    verts, colors, *_ = inputs()
    leaf = verts.clone().requires_grad_()
    grad = torch.autograd.grad(lit(leaf, colors).pow(power).sum(), leaf, create_graph=True)[0]
    with pytest.raises(RuntimeError, match="second derivatives"):
        grad.sum().backward()


def test_cameras_of_a_batch():
    verts, colors, *_ = inputs()
    camera = front_camera(SIZE)
    moved = camera.world_to_camera.clone()
    moved[0, 3] += 0.2
    batch = camera.replace(world_to_camera=torch.stack([camera.world_to_camera, moved]))

    def shader(hits: eg.Hits) -> Tensor:
        return hits.interpolate(colors)

    mesh = icosphere(2).replace(verts=verts)
    images = eg.render(mesh, batch, seed=4, shader=shader)
    assert torch.equal(images[0], eg.render(mesh, camera, seed=4, shader=shader))
    other = eg.render(mesh, camera.replace(world_to_camera=moved), spp=256, shader=shader)
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
        eg.render(icosphere(1), front_camera(8), shader=shader, check_shader=True)


def test_more_arguments_that_are_refused():
    with pytest.raises(ValueError, match="creases: expected"):
        eg.render(icosphere(1), front_camera(8), shader=lambda hits: hits.position, creases="all")  # type: ignore[arg-type]
    plain = eg.Mesh(icosphere(1).verts, icosphere(1).faces)
    with pytest.raises(ValueError, match="as many channels as the background"):
        eg.render(eg.Scene([plain], torch.zeros(2)), front_camera(8), shader=lambda hits: hits.position)
    with pytest.raises(RuntimeError, match=r"torch\.vmap"):
        torch.vmap(lambda v: eg.render(icosphere(1).replace(verts=v), front_camera(8), shader=lambda h: h.position))(
            torch.stack([icosphere(1).verts] * 2)
        )


def test_creases_are_found_where_the_shader_jumps():
    """Of flat normals, most of the gradient is at creases; a shader that makes its own of positions says so by True."""
    at = case("flat normals", "pose")
    full = derivative(at, 2)

    def own(theta: Tensor) -> tuple[eg.Scene, eg.Camera, Callable[[eg.Hits], Tensor]]:
        scene, camera, _ = at(theta)
        faces = scene.meshes[0].faces

        def shader(hits: eg.Hits) -> Tensor:
            corner = scene.meshes[0].verts[faces][hits._face]
            normal = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
            return 0.5 + 0.5 * torch.nn.functional.normalize(normal, dim=-1)

        return scene, camera, shader

    def found(creases: bool | str) -> float:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        options = {"surface_samples": 60000, "edge_samples": 60000, "creases": creases}
        return torch.autograd.grad(loss(own, theta, 7, 16, **options), theta)[0].item()

    assert abs(found(True) - full.mean) < 0.03 * abs(full.mean)
    assert abs(found("auto") - full.mean) > 0.05 * abs(full.mean)


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
    emitter = eg.PointLight(torch.tensor([2.0, 3.0, 2.5], dtype=F64), 20.0)
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
            edge_samples=20000,
            surface_samples=20000,
        )

    def gradient(colors: Tensor) -> tuple[Tensor, ...]:
        adjoint = smooth_adjoint(SIZE, SIZE, 2)
        return torch.func.grad(lambda c, v: (image(c, v) * adjoint).sum(), argnums=(0, 1))(colors, mesh.verts)

    together = torch.func.vmap(gradient)(colors)
    for k in range(3):
        for one, all in zip(gradient(colors[k]), together, strict=True):
            assert (one - all[k]).norm() < 0.03 * one.norm()


def test_in_parts_of_bounded_size(monkeypatch: pytest.MonkeyPatch):
    """What is given to the shader at once changes nothing."""
    mesh, camera = bumpy(), front_camera(SIZE)
    net = network(6)
    sizes = []

    def shader(hits: eg.Hits) -> Tensor:
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
    """As without a shader: a loop goes on where the mesh has left the image."""
    mesh, camera = bumpy(), front_camera(SIZE)
    net = network(6)
    verts = (mesh.verts + 100.0).requires_grad_()
    image = eg.render(
        mesh.replace(verts=verts), camera, shader=lambda h: net(torch.cat([h.position, h.normal], 1))
    )  # fmt: skip
    for gradient in torch.autograd.grad(image.sum(), [verts, *net.parameters()]):
        assert float(gradient.abs().max()) == 0
