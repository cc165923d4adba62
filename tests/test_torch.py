"""render() among other torch operations: graphs, compilation, dtypes, devices, threads, seeds."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch
from scenes import cube, front_camera, icosphere, one_triangle, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg
from edgegrad import reference
from edgegrad.aovs import _with_channels
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import Hits, kernel_camera, kernel_channels, kernel_hits, kernel_scene
from edgegrad.kernel.request import SLOTS, make_request, pack_camera
from edgegrad.library import core

F32, F64 = torch.float32, torch.float64
SIZE = 20
TRIANGLE = one_triangle()
MESH, BACKGROUND = TRIANGLE.meshes[0], TRIANGLE.background
CAMERA = front_camera(SIZE)
OTHER = eg.Camera.look_at((-1.2, 0.6, 3.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(SIZE, SIZE)).to(F64)
BATCH = eg.Camera.stack([CAMERA, OTHER])
ADJOINT = smooth_adjoint(SIZE, SIZE, 3)


def mixed_scene() -> eg.Scene:
    """Smooth colours, creases, a texture, and a background image; the meshes hide one another in part."""
    sphere = icosphere(2).transformed(scale=0.7)
    box = cube(0.5).transformed(t=torch.tensor([0.7, -0.4, 0.3], dtype=F64))
    box = box.replace(face_colors=smooth_colors(3.0 * box.verts[box.faces].mean(1)))
    quad = torch.tensor([[-1.1, -0.9, -0.6], [0.9, -1.05, -0.4], [1.05, 0.8, -0.5], [-0.8, 1.0, -0.7]], dtype=F64)
    plane = eg.Mesh(
        quad,
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
        texture=ADJOINT[:7, :5].sigmoid(),
        uvs=torch.tensor([[0.1, 0.05], [0.9, 0.1], [0.95, 0.9], [0.0, 0.85], [0.3, 0.3]], dtype=F64),
        uv_faces=torch.tensor([[0, 1, 2], [4, 2, 3]]),
    )
    return eg.Scene([sphere, box, plane], ADJOINT.sigmoid())


def with_leaves(scene: eg.Scene, camera: eg.Camera) -> tuple[eg.Scene, eg.Camera, list[Tensor]]:
    """The same, with leaves of their own that require gradients."""
    leaves = []

    def leaf(tensor: Tensor) -> Tensor:
        leaves.append(tensor.detach().clone().requires_grad_())
        return leaves[-1]

    meshes = []
    for mesh in scene.meshes:
        floats = {
            name: value for name, value in vars(mesh).items() if isinstance(value, Tensor) and value.is_floating_point()
        }
        meshes.append(mesh.replace(**{name: leaf(value) for name, value in floats.items()}))
    background = None if scene.background is None else leaf(scene.background)
    camera = camera.replace(world_to_camera=leaf(camera.world_to_camera), K=leaf(camera.K))
    return eg.Scene(meshes, background), camera, leaves


def image_and_gradients(scene: eg.Scene, camera: eg.Camera, **options) -> list[Tensor]:
    """The image, and the gradient of one loss of it in every floating-point tensor of scene and camera."""
    scene, camera, leaves = with_leaves(scene, camera)
    image = eg.render(scene, camera, **{"spp": 4, **options})
    return [image.detach(), *gradients(image, leaves)]


def gradients(image: Tensor, leaves: Sequence[Tensor], adjoint: Tensor | None = None) -> list[Tensor]:
    if adjoint is None:
        adjoint = smooth_adjoint(*image.shape[-3:]).to(image).expand_as(image)
    return list(torch.autograd.grad(image, leaves, adjoint))


def same_bits(a: Sequence[Tensor], b: Sequence[Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a, b, strict=True))


def relative_error(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


def leaf(tensor: Tensor) -> Tensor:
    return tensor.detach().clone().requires_grad_()


# -- operators --------------------------------------------------------------------------------------------------------


def operator_inputs(scene: eg.Scene) -> tuple:
    return make_request(scene, CAMERA, 4, surface_samples=200, edge_samples=200, grad_seed=3).pack()


SCENES = {"colors": lambda: TRIANGLE, "mixed": mixed_scene, "float32": lambda: TRIANGLE.to(F32)}


@pytest.mark.parametrize("wanted", ["11111111111", "10000110000"])
def test_opcheck_of_channels_beside_the_image(wanted):
    names = ["image", "alpha", "position", "depth", "shading_normal", "normal", "barycentrics"]
    inputs = _with_channels(make_request(TRIANGLE, CAMERA, 4, surface_samples=200, edge_samples=200), names).pack()
    image, *forward = torch.ops.edgegrad.render(*inputs)
    assert image.shape == (1, SIZE, SIZE, 17)
    torch.library.opcheck(torch.ops.edgegrad.render.default, inputs)
    torch.library.opcheck(torch.ops.edgegrad.faces_at_centers.default, inputs)
    adjoint = torch.ones_like(image)
    arguments = (adjoint, *forward, *inputs, [w == "1" for w in wanted])
    torch.library.opcheck(torch.ops.edgegrad.render_backward.default, arguments)


@pytest.mark.parametrize("scene", SCENES)
def test_opcheck_render(scene):
    """Schema, fake tensors, registration, and tracing with dynamic shapes."""
    torch.library.opcheck(torch.ops.edgegrad.render.default, operator_inputs(SCENES[scene]()))


@pytest.mark.parametrize("wanted", ["11111111111", "10000000000", "01000001101", "00000000000"])
@pytest.mark.parametrize("scene", SCENES)
def test_opcheck_render_backward(scene, wanted):
    inputs = operator_inputs(SCENES[scene]())
    image, *forward = torch.ops.edgegrad.render(*inputs)
    inputs = (ADJOINT[None].to(image.dtype), *forward, *inputs, [w == "1" for w in wanted])
    torch.library.opcheck(torch.ops.edgegrad.render_backward.default, inputs)


@pytest.mark.parametrize("moving", ["11111111111", "10000000000", "01000001101"])
def test_opcheck_render_jvp(moving):
    request = make_request(mixed_scene(), CAMERA, 4, surface_samples=200, edge_samples=200)
    _, *hits = torch.ops.edgegrad.render(*request.pack())
    slots = [request.slot(name) for name in SLOTS]
    tangents = [torch.ones(2, *x.shape, dtype=F64) if m == "1" else None for m, x in zip(moving, slots, strict=True)]
    torch.library.opcheck(torch.ops.edgegrad.render_jvp.default, (*hits, *request.pack(), tangents, 2))


# -- torch.compile ----------------------------------------------------------------------------------------------------


@pytest.fixture
def compiled() -> Iterator[Callable[..., None]]:
    """A check that a function, compiled in one graph, gives the image and the gradients that it gives by itself."""
    torch._dynamo.reset()

    def check(function: Callable[..., Tensor], *calls: Sequence[object], backend: str = "aot_eager") -> None:
        fast = torch.compile(function, fullgraph=True, backend=backend)
        for arguments in calls:
            leaves = [a for a in arguments if isinstance(a, Tensor) and a.requires_grad]
            results = [[image, *gradients(image, leaves)] for image in (fast(*arguments), function(*arguments))]
            assert same_bits(*results)

    yield check
    torch._dynamo.reset()


@pytest.mark.slow
def test_compile_mesh_transformed_inside(compiled):
    def function(verts, R, t, scale, world_to_camera):
        scene = eg.Scene(MESH.replace(verts=verts).transformed(R, t, scale), BACKGROUND)
        return eg.render(scene, CAMERA.replace(world_to_camera=world_to_camera), 4)

    values = (MESH.verts, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), torch.ones((), dtype=F64))
    compiled(function, [leaf(x) for x in (*values, CAMERA.world_to_camera)])


def test_compile_everything_inside(compiled):
    """Meshes of every kind from their tensors, one index tensor for two purposes, the camera from its parameters."""

    def function(verts, colors, texture, uvs, background, eye, fov, faces):
        meshes = [
            eg.Mesh(verts, faces, colors=colors),
            eg.Mesh(verts + 0.3, faces, texture=texture, uvs=uvs, uv_faces=faces),
            eg.Mesh(verts - 0.3, faces, face_colors=colors[:1]),
            eg.Mesh(verts - 0.5, faces, corner_colors=colors[None]),
            eg.Mesh(verts * 0.5, faces),
        ]
        camera = eg.Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=fov, size=(SIZE, SIZE))
        return eg.render(eg.Scene(meshes, background), camera, 4, filter="tent", surface_samples=100, grad_seed=5)

    floats = (MESH.verts, MESH.colors, ADJOINT[:4, :3].sigmoid(), MESH.verts[:, :2], ADJOINT, CAMERA.K[2] * 4 + 1)
    arguments = [leaf(x.to(F32)) for x in (*floats, torch.tensor(40.0))]
    compiled(function, [*arguments, MESH.faces.int()])


def test_compile_once_for_many_seeds(compiled):
    """From the second seed on it is a symbol; the seeds that follow from it must come out as they do in Python."""

    def function(verts, seed, spp, samples):
        return eg.render(MESH.replace(verts=verts), CAMERA, spp, seed, surface_samples=samples)

    calls = [(0, 4, 100), (1, 5, 101), (7, 6, 99), (2**40 + 1, 4, 100), (2**63 - 1, 4, 100)]
    compiled(function, *[(leaf(MESH.verts), *call) for call in calls])


def test_compile_other_numbers_of_vertices(compiled):
    def function(verts, faces, colors):
        return eg.render(eg.Mesh(verts, faces, colors=colors), CAMERA, 4)

    meshes = [cube(), icosphere(0), icosphere(1)]
    compiled(function, *[(leaf(m.verts), m.faces, leaf(m.colors)) for m in meshes])


def test_compile_still_refuses_what_is_not_finite():
    """Values are not looked at while tracing; then the kernel's own checks take over."""
    torch._dynamo.reset()
    function = torch.compile(lambda v: eg.render(MESH.replace(verts=v), CAMERA, 4), fullgraph=True, backend="aot_eager")
    function(MESH.verts)
    broken = MESH.verts.clone()
    broken[1, 2] = torch.nan
    with pytest.raises(ValueError, match=r"verts: expected finite numbers, got nan at \[1, 2\]"):
        function(broken)


@pytest.mark.slow  # the C++ compiler takes up to a minute the first time
def test_compile_inductor(compiled):
    def function(verts, t):
        return eg.render(MESH.replace(verts=verts).transformed(t=t), CAMERA, 4)

    compiled(function, [leaf(MESH.verts), leaf(torch.zeros(3, dtype=F64))], backend="inductor")


# -- autograd ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_without_gradients(mode):
    expected = eg.render(TRIANGLE, CAMERA, 4)
    with mode():
        mesh = MESH.replace(verts=leaf(MESH.verts) * 1.0)
        image = eg.render(eg.Scene(mesh, BACKGROUND), CAMERA, 4)
    assert torch.equal(image, expected) and not image.requires_grad


def test_with_what_was_made_in_inference_mode():
    """Autograd keeps no such tensor, but a copy of it."""
    with torch.inference_mode():
        scene, camera = TRIANGLE.transformed(scale=1.0), CAMERA.to(F64, copy=True)
        scene = scene.replace(meshes=[scene.meshes[0].replace(colors=1.0 * MESH.colors, faces=MESH.faces.int())])
    assert scene.meshes[0].colors.is_inference() and camera.K.is_inference()
    t = leaf(torch.zeros(3, dtype=F64))
    mesh = scene.meshes[0].replace(verts=MESH.verts + t)
    image = eg.render(eg.Scene(mesh, BACKGROUND), camera, 4)
    assert torch.equal(gradients(image, [t])[0], gradients(triangle(MESH.verts + t), [t])[0])


def test_image_requires_gradients_if_anything_does():
    assert not eg.render(TRIANGLE, CAMERA, 4).requires_grad
    assert eg.render(TRIANGLE, CAMERA.replace(K=leaf(CAMERA.K)), 4).requires_grad


def test_only_what_requires_a_gradient_gets_one():
    everything = image_and_gradients(mixed_scene(), CAMERA)[1:]
    for chosen in range(len(everything)):
        scene, camera, leaves = with_leaves(mixed_scene(), CAMERA)
        for i, tensor in enumerate(leaves):
            tensor.requires_grad_(i == chosen)
        image = eg.render(scene, camera, 4)
        image.backward(smooth_adjoint(*image.shape))
        assert [tensor.grad is not None for tensor in leaves] == [i == chosen for i in range(len(leaves))]
        assert torch.equal(leaves[chosen].grad, everything[chosen])


class Model(torch.nn.Module):
    """A mesh whose vertices and background are learnt."""

    def __init__(self) -> None:
        super().__init__()
        self.verts = torch.nn.Parameter(MESH.verts.to(F32))
        self.background = torch.nn.Parameter(torch.zeros(3))
        self.register_buffer("faces", MESH.faces)
        self.register_buffer("colors", MESH.colors.to(F32))

    def forward(self, seed: int) -> Tensor:
        mesh = eg.Mesh(self.verts, self.faces, colors=self.colors)
        return eg.render(eg.Scene(mesh, self.background), CAMERA, 16, seed)


def test_in_a_module_with_an_optimiser():
    model = Model()
    with torch.no_grad():
        target = eg.render(eg.Scene(MESH.to(F32).transformed(t=[0.1, -0.05, 0.0]), BACKGROUND.to(F32)), CAMERA, 64)
    optimiser = torch.optim.Adam(model.parameters(), lr=0.02)
    losses = []
    for step in range(15):
        optimiser.zero_grad()
        loss = (model(step) - target).square().mean()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert not torch.equal(model.verts, MESH.verts.to(F32))
    assert losses[-1] < 0.3 * losses[0]


def test_the_loop_in_the_readme(monkeypatch):
    """Each step draws samples of its own: with one seed for all, their error would not average out."""
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (loop,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "optimizer.step()" in block)
    target = eg.render(MESH.transformed(t=[0.05, -0.03, 0.0]), CAMERA, 64, seed=1 << 40)
    seeds, render = [], eg.render

    def watched(*args, seed: int, **options) -> Tensor:
        seeds.append(seed)
        return render(*args, seed=seed, **options)

    monkeypatch.setattr(eg, "render", watched)
    names = {"torch": torch, "eg": eg, "mesh": MESH, "camera": CAMERA, "target": target}
    exec(loop.replace("range(200)", "range(40)"), names)
    assert len(set(seeds)) == len(seeds) == 40
    fitted, start = (render(MESH.replace(verts=v), CAMERA, 64) for v in (names["verts"], MESH.verts))
    assert (fitted - target).norm() < 0.6 * (start - target).norm()


def test_the_light_in_the_readme():
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    (lit,) = (
        block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "eg.DirectionalLight(sun" in block
    )
    corners = torch.tensor([[-3.0, -3.0, -0.8], [3.0, -3.0, -0.8], [3.0, 3.0, -0.8], [-3.0, 3.0, -0.8]])
    ground = eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), colors=torch.ones((4, 3)))
    names = {"torch": torch, "eg": eg, "mesh": MESH, "ground": ground, "camera": CAMERA, "target": 0.2, "step": 3}
    exec(lit, names)
    assert names["image"].shape == (SIZE, SIZE, 3)
    assert names["sun"].grad.abs().max() > 0


def test_twice_in_one_graph():
    verts = leaf(MESH.verts)
    mesh = MESH.replace(verts=verts)
    other = CAMERA.crop(2, 3, SIZE, SIZE)
    alone = [gradients(eg.render(mesh, camera, 4, seed), [verts])[0] for camera, seed in ((CAMERA, 0), (other, 1))]
    both = eg.render(mesh, CAMERA, 4, 0) + eg.render(mesh, other, 4, 1)
    assert torch.equal(gradients(both, [verts])[0], alone[0] + alone[1])


def test_backward_twice():
    verts = leaf(MESH.verts)
    image = eg.render(MESH.replace(verts=verts), CAMERA, 4)
    first, second = (torch.autograd.grad(image, verts, ADJOINT, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
    torch.autograd.grad(image, verts, ADJOINT)
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(image, verts, ADJOINT)


def test_gradient_is_linear_in_the_adjoint():
    """The samples do not depend on the adjoint's size, nor on its sign."""
    verts = leaf(MESH.verts)
    image = eg.render(MESH.replace(verts=verts), CAMERA, 4)
    one, other = (torch.autograd.grad(image, verts, s * ADJOINT, retain_graph=True)[0] for s in (1, -4))
    torch.testing.assert_close(other, -4 * one, rtol=1e-12, atol=0)
    assert not torch.autograd.grad(image, verts, torch.zeros_like(ADJOINT))[0].any()


def triangle(verts: Tensor, camera: eg.Camera = CAMERA) -> Tensor:
    return eg.render(eg.Scene(MESH.replace(verts=verts), BACKGROUND), camera, 4)


@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
def test_an_adjoint_that_is_not_finite_is_named_at_its_place(value):
    """That of the image as the user has it, with an axis for cameras where there is a batch of them."""
    for camera, place in ((CAMERA, (7, 4, 1)), (eg.Camera.stack([CAMERA]), (0, 7, 4, 1)), (BATCH, (1, 7, 4, 2))):
        image = triangle(leaf(MESH.verts), camera)
        adjoint = torch.ones_like(image)
        adjoint[place] = value
        where = ", ".join(map(str, place))
        with pytest.raises(ValueError, match=rf"the gradient of the image: .* got {value} at \[{where}\] \(1 such"):
            image.backward(adjoint)


def test_verts_changed_in_place_before_backward():
    """float32 is copied into the kernel's double: the gradient is that of the image. float64 is kept itself: that is noticed."""
    for dtype in (F32, F64):
        mesh = MESH.to(dtype)
        verts = leaf(mesh.verts)
        expected = gradients(eg.render(mesh.replace(verts=verts), CAMERA, 4), [verts])
        image = eg.render(mesh.replace(verts=verts), CAMERA, 4)
        with torch.no_grad():
            verts += 0.3
        if dtype == F32:
            assert same_bits(gradients(image, [verts]), expected)
        else:
            with pytest.raises(RuntimeError, match="modified by an inplace operation"):
                gradients(image, [verts])


# -- layouts and dtypes -----------------------------------------------------------------------------------------------


def strided(tensor: Tensor) -> Tensor:
    """The same values, one in three of a larger tensor."""
    larger = torch.zeros((*tensor.shape, 3), dtype=tensor.dtype)
    larger[..., 1] = tensor
    return larger[..., 1]


def transposed(tensor: Tensor) -> Tensor:
    """The same values, stored the other way round."""
    return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor


@pytest.mark.parametrize("layout", [strided, transposed])
def test_layouts(layout):
    """Of inputs and of the adjoint image."""
    plain, camera, leaves = with_leaves(mixed_scene(), CAMERA)
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    image = eg.render(plain, camera, 4)
    expected = [image, *gradients(image, leaves, adjoint)]

    def changed(mesh: eg.Mesh) -> eg.Mesh:
        return mesh.replace(**{name: layout(value) for name, value in vars(mesh).items() if isinstance(value, Tensor)})

    scene = eg.Scene([changed(mesh) for mesh in plain.meshes], layout(plain.background))
    camera = camera.replace(world_to_camera=layout(camera.world_to_camera), K=layout(camera.K))
    assert not scene.meshes[0].verts.is_contiguous()
    image = eg.render(scene, camera, 4)
    assert same_bits([image, *gradients(image, leaves, layout(adjoint))], expected)


def test_expanded_inputs():
    """One colour for all vertices; its gradient is the sum over them. And an adjoint that is one number."""
    color = leaf(MESH.colors[0])
    image = eg.render(MESH.replace(colors=color.expand(3, 3)), CAMERA, 4)
    colors = leaf(color.expand(3, 3))
    other = eg.render(MESH.replace(colors=colors), CAMERA, 4)
    assert torch.equal(image, other)
    torch.testing.assert_close(
        torch.autograd.grad(image.sum(), color)[0], torch.autograd.grad(other.sum(), colors)[0].sum(0)
    )


@pytest.mark.parametrize("verts", [F32, F64])
@pytest.mark.parametrize("colors", [F32, F64])
@pytest.mark.parametrize("camera", [F32, F64])
def test_dtypes(verts, colors, camera):
    """The image has the dtype of the colours, each gradient that of its tensor."""
    scene, moved, leaves = with_leaves(TRIANGLE.to(colors).replace(background=None), CAMERA.to(camera))
    position = leaf(MESH.verts.to(verts))
    scene = scene.replace(meshes=[scene.meshes[0].replace(verts=position)])
    image = eg.render(scene, moved, 4)
    assert image.dtype == colors
    color, pose, K = leaves[1:]
    for tensor, gradient in zip((position, color, pose, K), gradients(image, (position, color, pose, K)), strict=True):
        assert gradient.dtype == tensor.dtype and gradient.shape == tensor.shape and gradient.any()
    # Geometry is computed in double, so that float32 only rounds what comes in and goes out; but the input's rounding,
    # 1e-7 of 10 px, moves an edge past one of the 1,600 samples with a probability of some 1e-3.
    expected = eg.render(TRIANGLE.replace(background=None), CAMERA, 4)
    torch.testing.assert_close(image.double(), expected, rtol=0, atol=1e-5)


def test_dtype_is_the_widest_among_colours():
    both = eg.Scene([MESH.to(F32), MESH.transformed(t=[0.0, 0.0, 1.0])])
    assert eg.render(both, CAMERA, 4).dtype == F64
    assert eg.render(eg.Scene(MESH.to(F32), BACKGROUND), CAMERA, 4).dtype == F64
    assert eg.render(MESH.to(F32).replace(verts=MESH.verts), CAMERA, 4).dtype == F32
    assert eg.render(eg.Mesh(MESH.verts, MESH.faces), CAMERA, 4).dtype == F64  # plain: that of its vertices
    assert eg.render(eg.Mesh(MESH.verts.to(F32), MESH.faces), CAMERA, 4).dtype == F32


@pytest.mark.parametrize("dtype", [torch.int32, torch.int16, torch.uint8])
def test_integer_dtypes(dtype):
    expected = image_and_gradients(mixed_scene(), CAMERA)
    meshes = [
        m.replace(faces=m.faces.to(dtype), uv_faces=None if m.uv_faces is None else m.uv_faces.to(dtype))
        for m in mixed_scene().meshes
    ]
    assert same_bits(image_and_gradients(mixed_scene().replace(meshes=meshes), CAMERA), expected)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 17])
def test_any_number_of_channels(channels):
    """The kernel has code of its own for some numbers; all give the same channel by channel."""
    palette = smooth_colors(torch.arange(3 * channels, dtype=F64).reshape(-1, 3)).reshape(3, channels)
    scene = eg.Scene(MESH.replace(colors=palette), palette[0])
    image = eg.render(scene, CAMERA, 4)
    for c in range(channels):
        single = eg.Scene(MESH.replace(colors=palette[:, c : c + 1]), palette[0, c : c + 1])
        torch.testing.assert_close(image[..., c : c + 1], eg.render(single, CAMERA, 4), rtol=1e-14, atol=1e-14)
    # A loss that looks at one channel only draws the samples that it draws when there is no other.
    verts = leaf(MESH.verts)
    adjoint = torch.zeros(SIZE, SIZE, channels, dtype=F64)
    adjoint[..., -1] = ADJOINT[..., 0]
    found = gradients(
        eg.render(eg.Scene(scene.meshes[0].replace(verts=verts), scene.background), CAMERA, 4), [verts], adjoint
    )
    alone = eg.render(eg.Scene(single.meshes[0].replace(verts=verts), single.background), CAMERA, 4)
    torch.testing.assert_close(found, gradients(alone, [verts], ADJOINT[..., :1]), rtol=1e-12, atol=1e-12)


# -- devices ----------------------------------------------------------------------------------------------------------


def test_to_moves_everything():
    scene, camera, leaves = with_leaves(mixed_scene(), CAMERA)
    moved = scene.to("cpu", F32), camera.to("cpu", F32)
    assert all(m.verts.dtype == F32 and m.faces.dtype == torch.int64 for m in moved[0].meshes)
    assert moved[0].meshes[2].texture.dtype == F32 and moved[0].background.dtype == F32
    assert moved[1].K.dtype == moved[1].world_to_camera.dtype == F32
    image = eg.render(*moved, 4)
    assert image.dtype == F32
    for tensor, gradient in zip(leaves, gradients(image, leaves), strict=True):
        assert gradient.dtype == F64 and gradient.shape == tensor.shape
    assert scene.to("cpu").meshes[0].verts is scene.meshes[0].verts


def test_default_device_does_not_matter():
    """The kernel's tensors live on the CPU, wherever new tensors are made by default; "meta" stands for any other."""
    for scene in (mixed_scene(), eg.Scene(eg.Mesh(MESH.verts, MESH.faces))):
        expected = image_and_gradients(scene, CAMERA)
        scene, camera, leaves = with_leaves(scene, CAMERA)
        with torch.device("meta"):
            image = eg.render(scene, camera, 4)
            found = [image, *torch.autograd.grad(image, leaves, smooth_adjoint_on_cpu(image))]
        assert same_bits(found, expected)


def smooth_adjoint_on_cpu(image: Tensor) -> Tensor:
    with torch.device("cpu"):
        return smooth_adjoint(*image.shape)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_come_back():
    expected = image_and_gradients(mixed_scene(), CAMERA)
    scene, camera, leaves = with_leaves(mixed_scene().to("cuda"), CAMERA.to("cuda"))
    image = eg.render(scene, camera, 4)
    found = [image, *gradients(image, leaves, ADJOINT.cuda())]
    assert all(tensor.device.type == "cuda" for tensor in found)
    assert same_bits([tensor.cpu() for tensor in found], expected)
    # A camera on the CPU looks at it all the same, and the image is where the scene is.
    assert eg.render(scene, CAMERA, 4).device.type == "cuda"


# -- batches of cameras -----------------------------------------------------------------------------------------------


def test_batch_of_one_is_that_camera():
    single = image_and_gradients(TRIANGLE, CAMERA)
    batch = image_and_gradients(TRIANGLE, eg.Camera.stack([CAMERA]))
    assert batch[0].shape == (1, SIZE, SIZE, 3)
    assert same_bits([x.reshape(y.shape) for x, y in zip(batch, single, strict=True)], single)


def test_batch_first_camera_is_that_camera():
    """The samples of the first camera are those it has alone, and a camera that the loss ignores gives nothing."""
    single = image_and_gradients(TRIANGLE, CAMERA)
    scene, camera, leaves = with_leaves(TRIANGLE, eg.Camera.stack([CAMERA, OTHER]))
    images = eg.render(scene, camera, 4)
    *of_scene, pose, K = gradients(images, leaves, torch.stack([ADJOINT, torch.zeros_like(ADJOINT)]))
    assert same_bits([images[0], *of_scene, pose[0], K[0]], single)
    assert not pose[1].any() and not K[1].any()


def test_batch_other_cameras():
    """They have samples of their own, so they differ from what the camera gives alone as two seeds differ."""
    options = {"spp": 64, "surface_samples": 5000, "edge_samples": 5000}
    single, again = (image_and_gradients(TRIANGLE, OTHER, seed=seed, **options) for seed in (0, 1))
    scene, camera, leaves = with_leaves(TRIANGLE, eg.Camera.stack([CAMERA, OTHER]))
    images = eg.render(scene, camera, **options)
    *of_scene, pose, K = gradients(images, leaves, torch.stack([torch.zeros_like(ADJOINT), ADJOINT]))
    for found, one, other in zip([images[1], *of_scene, pose[1], K[1]], single, again, strict=True):
        # Measured: 0.3 to 1.5 times that, which is at most 0.7 % of the whole.
        assert not torch.equal(found, one)
        assert (found - one).norm() < 4 * (other - one).norm() < 0.04 * one.norm()


@pytest.mark.parametrize("shared", ["K", "world_to_camera"])
def test_batch_gradients_sum(shared):
    """Over the cameras, for the scene and for what the cameras share."""
    batched = eg.Camera.stack([CAMERA, OTHER])
    one = {"K": CAMERA.K, "world_to_camera": CAMERA.world_to_camera}[shared]
    leaves = [leaf(MESH.verts), leaf(one)]
    scene, camera = eg.Scene(MESH.replace(verts=leaves[0]), BACKGROUND), batched.replace(**{shared: leaves[1]})
    images = eg.render(scene, camera, 4)
    assert images.shape == (2, SIZE, SIZE, 3)
    adjoint = torch.stack([ADJOINT, ADJOINT.flip(0)])
    found = torch.autograd.grad(images, leaves, adjoint, retain_graph=True)
    parts = []
    for b in range(2):
        only = torch.zeros_like(adjoint)
        only[b] = adjoint[b]
        parts.append(torch.autograd.grad(images, leaves, only, retain_graph=True))
        assert all(part.any() for part in parts[-1])
    torch.testing.assert_close(found, tuple(a + b for a, b in zip(*parts, strict=True)), rtol=1e-12, atol=1e-12)


# -- the same bits ----------------------------------------------------------------------------------------------------


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


REPEATABLE = {
    "mixed": lambda: (mixed_scene(), CAMERA),
    "mixed, float32": lambda: (mixed_scene().to(F32), CAMERA),
    "20,480 faces": lambda: (eg.Scene(icosphere(5)), front_camera(64)),
    "soup": lambda: (eg.Scene(soup(icosphere(4))), front_camera(64)),
}


def soup(mesh: eg.Mesh) -> eg.Mesh:
    """Each face with vertices of its own."""
    corners = mesh.faces.reshape(-1)
    return eg.Mesh(mesh.verts[corners], torch.arange(len(corners)).reshape(-1, 3), colors=mesh.colors[corners])


@pytest.mark.parametrize("case", REPEATABLE)
def test_same_bits_at_any_number_of_threads(case, threads):
    scene, camera = REPEATABLE[case]()
    results = []
    for n in (1, 2, 3):
        threads(n)
        core.clear_geometry()
        results.append(image_and_gradients(scene, camera, seed=11))
    assert same_bits(results[0], results[1]) and same_bits(results[0], results[2])


@pytest.mark.parametrize("case", REPEATABLE)
def test_same_bits_whatever_was_rendered_before(case):
    """Geometry is kept between calls, and moved: none of that may show."""
    scene, camera = REPEATABLE[case]()
    core.clear_geometry()
    expected = image_and_gradients(scene, camera)
    assert same_bits(image_and_gradients(scene, camera), expected)
    for i in range(3):
        image_and_gradients(
            scene.transformed(t=torch.tensor([0.1 * i, 0.2, 0.0], dtype=F64), scale=1.0 + 0.3 * i), camera
        )
    for i in range(9):  # more than are kept
        eg.render(cube(0.1 + 0.1 * i).replace(faces=cube().faces[: 12 - i]), camera, 1)
    eg.render(scene, camera, 1, visibility=False)
    assert same_bits(image_and_gradients(scene, camera), expected)


def test_same_bits_after_the_same_positions_in_another_precision():
    """Copies of a vertex that differ by a rounding of float32 are one vertex there, and two in float64."""
    mesh = soup(cube())
    noise = 2.0**-24 * torch.randn(mesh.verts.shape, generator=torch.Generator().manual_seed(0))
    coarse = mesh.replace(verts=(mesh.verts + noise).float())
    fine = coarse.replace(verts=coarse.verts.double())
    for first, second in ((coarse, fine), (fine, coarse)):
        core.clear_geometry()
        expected = image_and_gradients(eg.Scene(second), CAMERA)
        core.clear_geometry()
        image_and_gradients(eg.Scene(first), CAMERA)
        assert same_bits(image_and_gradients(eg.Scene(second), CAMERA), expected)


def test_same_bits_from_several_python_threads():
    """The interpreter's lock is released meanwhile, and they share what is kept."""
    scene, camera = REPEATABLE["mixed"]()
    moves = [torch.tensor([0.05 * i, 0.0, 0.0], dtype=F64) for i in range(4)]
    expected = [image_and_gradients(scene.transformed(t=t), camera) for t in moves]
    with ThreadPoolExecutor(4) as pool:
        futures = [pool.submit(image_and_gradients, scene.transformed(t=t), camera) for t in moves * 5]
    assert all(same_bits(future.result(), expected[i % 4]) for i, future in enumerate(futures))


def test_seeds():
    scene = mixed_scene()
    first = image_and_gradients(scene, CAMERA, seed=0)
    for options in ({"seed": 1}, {"seed": 2**63 - 1}):
        assert not any(map(torch.equal, first, image_and_gradients(scene, CAMERA, **options)))
    image, *grads = image_and_gradients(scene, CAMERA, seed=0, grad_seed=5)
    assert torch.equal(image, first[0])
    # The gradient of the background follows from the image's own samples, the others have their own.
    background = len(grads) - 3
    for i, (a, b) in enumerate(zip(grads, first[1:], strict=True)):
        assert torch.equal(a, b) == (i == background)
    # The samples of the gradient depend on those of the image only by which faces these hit: here the one there is.
    (image, *grads), (other_image, *others) = (
        image_and_gradients(TRIANGLE, CAMERA, seed=seed, grad_seed=5) for seed in (0, 1)
    )
    assert not torch.equal(image, other_image)
    for i, (a, b) in enumerate(zip(grads, others, strict=True)):
        assert torch.equal(a, b) == (i != len(grads) - 3)


# -- samples ----------------------------------------------------------------------------------------------------------


def sample_counts(surface: int, edge: int, adjoint: Tensor, boundary: bool = True) -> tuple[int, int]:
    """What the kernel says it drew for the triangle's vertices."""
    # All pixels covered by many samples, so that no budget binds; nothing is occluded.
    hits = Hits(
        torch.ones(1, SIZE, SIZE, dtype=F64),
        torch.full((1, SIZE, SIZE), torch.inf),
        torch.zeros((1, SIZE, SIZE, 2), dtype=torch.int32),
        torch.ones((1, 1), dtype=torch.uint8),
    )
    profile = kernel_scene(flatten(TRIANGLE)).backward(
        kernel_camera(pack_camera(CAMERA)),
        kernel_channels(make_request(TRIANGLE, CAMERA)),
        core.ImageOptions(spp=1 << 20, filter="box", seed=0),
        core.GradientOptions(seed=0, surface_samples=surface, edge_samples=edge, boundary=boundary),
        threads=2,
        adjoint=adjoint.contiguous().numpy(),
        hits=kernel_hits(hits),
        gradients={"verts": np.zeros((3, 3))},
    )
    return profile["surface_samples"], profile["edge_samples"]


def test_sample_counts():
    """Half of the surface measure, area + longest side, and 24 a pixel of curve; or as many as one says."""
    x = CAMERA.project(MESH.verts)
    sides = (x - x.roll(1, 0)).norm(dim=1)
    area = 0.5 * torch.linalg.det(torch.cat([x, torch.ones(3, 1)], 1)).abs()
    expected = int((0.5 * (area + sides.max())).ceil()), int((24 * sides.sum()).ceil())
    smooth = torch.ones_like(ADJOINT)  # fewer inside, where a control leaves little to chance
    surface, edge = sample_counts(-1, -1, smooth)
    assert expected[0] / 16 <= surface < expected[0] and edge == expected[1]
    assert sample_counts(123, 45, ADJOINT) == (123, 45)
    assert sample_counts(-1, -1, smooth, boundary=False) == (surface, 0)
    assert sample_counts(123, 45, torch.zeros_like(ADJOINT)) == (0, 0)  # where the loss does not look
    # A loss as rough as noise has up to five times as many inside a face that is several pixels wide, and no more at edges.
    noise = torch.randn(ADJOINT.shape, generator=torch.Generator().manual_seed(0), dtype=F64)
    surface, edge = sample_counts(-1, -1, noise)
    assert 2 * expected[0] < surface <= 5 * expected[0] + 5 and edge == expected[1]


def test_more_samples_are_better():
    """Gradients from one sample of each kind and from many: finite, and the many closer to those of very many."""
    truth = image_and_gradients(TRIANGLE, CAMERA, surface_samples=200_000, edge_samples=200_000)
    errors = []
    for n in (1, 100, 10_000):
        options = {"surface_samples": n, "edge_samples": n}
        runs = [image_and_gradients(TRIANGLE, CAMERA, grad_seed=seed, **options) for seed in range(8)]
        assert all(torch.equal(run[0], truth[0]) for run in runs)  # the image has samples of its own
        errors.append(max(relative_error(run[1], truth[1]) for run in runs))
    # The largest of 8, measured 5, 0.08 and 0.002. Independent samples would gain a factor of 10 in each step.
    assert errors[1] < errors[0] / 10 and errors[2] < errors[1] / 10 and errors[2] < 0.01


@pytest.mark.parametrize("scene", [one_triangle, mixed_scene], ids=["triangle", "mixed"])
def test_visibility_false_leaves_the_interior(scene):
    """Against the twin, which knows the interior term only. With it, the silhouettes come in as well."""
    scene, camera, leaves = with_leaves(scene(), CAMERA)
    twin = gradients(reference.render(scene, camera, grid=12), leaves, ADJOINT)
    twin[-1][-1] = 0  # of K: fixed, but not to the twin
    alone, both = (
        gradients(eg.render(scene, camera, 144, visibility=on, surface_samples=100_000), leaves, ADJOINT)
        for on in (False, True)
    )
    for i, (ours, theirs) in enumerate(zip(alone, twin, strict=True)):
        # Along the silhouettes the twin's grid is wrong by part of a cell. Measured: 5 % with 6 × 6 points a pixel,
        # 2.3 % with these 12 × 12, 0.8 % with 24 × 24. Faces of one colour leave it rounding only, and the kernel nothing.
        if theirs.norm() > 1e-12:
            assert relative_error(ours, theirs) < 0.04, f"leaf {i}"
        else:
            assert not ours.any(), f"leaf {i}"
    assert relative_error(both[0], twin[0]) > 1  # 1.66, measured


# -- changes in place -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", ["verts", "faces", "colors", "background", "texture", "uvs", "K"])
def test_change_in_place_is_noticed(which):
    """The second render sees the tensor as it is, although it is the same tensor and geometry is kept."""
    scene, camera = mixed_scene(), CAMERA.to("cpu")
    camera = camera.replace(K=camera.K.clone())
    before = image_and_gradients(scene, camera)
    mesh = scene.meshes[0] if which in ("verts", "faces", "colors") else scene.meshes[2]
    tensor = {**vars(mesh), "background": scene.background, "K": camera.K}[which]
    with torch.no_grad():
        if which == "faces":
            tensor[:40] = tensor[40:80].clone()
        elif which == "K":
            tensor[0, 2] += 0.7
        else:
            tensor += 0.3
    after = image_and_gradients(scene, camera)
    assert not torch.equal(after[0], before[0])
    core.clear_geometry()
    assert same_bits(image_and_gradients(scene, camera), after)
