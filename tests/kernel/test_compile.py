"""torch.compile of whole functions around render()."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
import torch
from scenes import cube, icosphere
from torch import Tensor
from torch_scenes import ADJOINT, BACKGROUND, CAMERA, F32, F64, MESH, SIZE, gradients, leaf

import edgegrad as eg


@pytest.fixture
def compiled() -> Iterator[Callable[..., Callable[..., Tensor]]]:
    """A check that a function, compiled in one graph, gives the image and the gradients that it gives by itself."""
    torch._dynamo.reset()

    def check(
        function: Callable[..., Tensor], *calls: Sequence[object], backend: str = "aot_eager"
    ) -> Callable[..., Tensor]:
        compilations, compiling = 0, 0  # compilations, and calls that compile something

        def counted(graph: torch.fx.GraphModule, inputs: Sequence[Any]) -> Any:
            nonlocal compilations
            compilations += 1
            return torch._dynamo.lookup_backend(backend)(graph, inputs)

        fast = torch.compile(function, fullgraph=True, backend=counted)
        for arguments in calls:
            before = compilations
            leaves = [a for a in arguments if isinstance(a, Tensor) and a.requires_grad]
            (found, *grads), (image, *expected) = (
                [image, *gradients(image, leaves)] for image in (fast(*arguments), function(*arguments))
            )
            compiling += compilations > before
            assert torch.equal(found, image)
            # The same bits but for the order in which those of a tensor that is used several times are summed.
            for a, b in zip(grads, expected, strict=True):
                assert float((a - b).abs().max()) <= 4 * torch.finfo(b.dtype).eps * float(b.abs().max())
        # The first call takes integers and sizes as constants, the second makes symbols of those that differ. A 0 or 1 stays
        # a constant, for which a third call may compile.
        assert compiling <= 3
        return fast

    yield check
    torch._dynamo.reset()


@pytest.mark.slow
def test_compile_mesh_transformed_inside(compiled):
    def function(verts, R, t, scale, world_to_camera):
        scene = eg.Scene(MESH.replace(verts=verts).transformed(R, t, scale), BACKGROUND)
        return eg.render(scene, CAMERA.replace(world_to_camera=world_to_camera), 4, seed=0)

    values = (MESH.verts, torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64), torch.ones((), dtype=F64))
    compiled(function, [leaf(x) for x in (*values, CAMERA.world_to_camera)])


@pytest.mark.slow
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
        return eg.render(
            eg.Scene(meshes, background), camera, 4, filter="tent", sampling=eg.Sampling(surface=100, seed=5), seed=0
        )

    floats = (MESH.verts, MESH.colors, ADJOINT[:4, :3].sigmoid(), MESH.verts[:, :2], ADJOINT, CAMERA.K[2] * 4 + 1)
    arguments = [leaf(x.to(F32)) for x in (*floats, torch.tensor(40.0))]
    compiled(function, [*arguments, MESH.faces.int()])


def test_compile_once_for_many_integers(compiled):
    """They are symbols from the second call on. The seeds that follow from one must come out as they do in Python."""

    def function(verts, seed, spp, samples):
        mesh = MESH.replace(verts=verts)
        return eg.render(mesh, CAMERA, spp, seed, sampling=eg.Sampling(surface=samples, edges=samples + 1))

    calls = [(0, 4, 100), (1, 5, 101), (7, 6, 99), (2**40 + 1, 4, 100), (2**63 - 1, 4, 100)]
    compiled(function, *[(leaf(MESH.verts), *call) for call in calls])


def refuses_what_is_not_finite(function, verts, *arguments):
    """Values are not looked at while tracing; then the kernel's own checks take over."""
    broken = verts.clone()
    broken[1, 2] = torch.nan
    with pytest.raises(ValueError, match=r"verts: expected finite numbers, got nan at \[1, 2\]"):
        function(leaf(broken), *arguments)


def test_compile_other_numbers_of_vertices(compiled):
    def function(verts, faces, colors):
        return eg.render(eg.Mesh(verts, faces, colors=colors), CAMERA, 4, seed=0)

    calls = [(leaf(m.verts), m.faces, leaf(m.colors)) for m in (cube(), icosphere(0), icosphere(1))]
    refuses_what_is_not_finite(compiled(function, *calls), *calls[-1])


QUAD = torch.tensor([[-2.0, -2.0, -1.0], [2.0, -2.0, -1.0], [2.0, 2.0, -1.2], [-2.0, 2.0, -1.0]], dtype=F64)
SQUARE = torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_compile_lit_scene(compiled):
    def function(verts, place, roughness, seed):
        mesh = eg.Mesh(verts, MESH.faces, material=eg.Material(roughness=roughness))
        return eg.render(eg.Scene(mesh, lights=[eg.lights.PointLight(place, 9.0)]), CAMERA, 1, seed)

    values = (MESH.verts, torch.tensor([1.0, 1.5, 4.0], dtype=F64), torch.tensor(0.4, dtype=F64))
    call = [*map(leaf, values), 3]
    refuses_what_is_not_finite(compiled(function, call), *call)


@pytest.mark.slow
def test_compile_all_that_lights_a_scene(compiled):
    """Materials, textures and lights of every kind from their tensors; seeds and numbers of samples become symbols."""

    def function(verts, roughness, image, normals, sky, place, power, eye, seed, samples):
        shiny = eg.Material(verts.sigmoid(), 0.3, roughness)
        uvs = QUAD[:, :2] / 4 + 0.5
        painted = eg.Material(
            eg.Texture(image, wrap=("clamp", "mirror")), normal_map=eg.Texture(normals), normal_scale=0.5
        )
        meshes = [
            eg.Mesh(verts, MESH.faces, material=shiny, name='"\\'),
            eg.Mesh(QUAD, SQUARE, uvs=uvs, uv_faces=SQUARE, material=painted, wrap=["repeat", "clamp"]),
        ]
        lights = [
            eg.lights.PointLight(place, power, color=sky[0, 0]),
            eg.lights.SpotLight(place + 1, -place, power, inner_angle=0.2),
            eg.lights.DirectionalLight(-place, 0.5),
            eg.lights.Environment(sky, torch.eye(3, dtype=F64), visible=False),
            eg.lights.SphericalHarmonics(sky[:1, :1].expand(9, 1, 3)[:, 0] * 0.1),
            eg.shapes.rectangle(
                place, sky[0, 0] / 4, sky[1, 0] / 4, material=eg.Material(base_color=0.0, emission=power)
            ),
        ]
        camera = eg.Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=40.0, size=(10, 8))
        return eg.render(
            eg.Scene(meshes, lights=lights), camera, 2, seed, sampling=eg.Sampling(surface=samples), shadows=seed < 9
        )

    draw = torch.Generator().manual_seed(3)
    sky = 0.2 + torch.rand((3, 4, 3), dtype=F64, generator=draw)
    normals = torch.tensor([0.5, 0.5, 1.0], dtype=F64) + 0.1 * torch.rand((2, 2, 3), dtype=F64, generator=draw)
    place = torch.tensor([1.0, 1.5, 4.0], dtype=F64)
    power = torch.tensor(9.0, dtype=F64)
    values = (MESH.verts, power / 20, sky[:, :, [1]] + 0 * sky, normals, sky, place, power, CAMERA.K[2] * 4 + 0.5)
    compiled(function, *[([*map(leaf, values), *call]) for call in [(0, 100), (7, 101)]])


@pytest.mark.slow
def test_compile_mipmaps_and_batches(compiled):
    def function(verts, texture, K):
        mesh = eg.Mesh(verts, MESH.faces, texture=texture, uvs=verts[:, :2], uv_faces=MESH.faces, filter="mipmap")
        return eg.render(mesh, CAMERA.replace(K=K), 4, seed=0)

    compiled(function, [leaf(MESH.verts), leaf(ADJOINT.to(F32)), leaf(CAMERA.K.expand(2, 3, 3))])


@pytest.mark.slow  # the C++ compiler takes up to a minute the first time
def test_compile_inductor(compiled):
    def function(verts, t):
        return eg.render(MESH.replace(verts=verts).transformed(t=t), CAMERA, 4, seed=0)

    compiled(function, [leaf(MESH.verts), leaf(torch.zeros(3, dtype=F64))], backend="inductor")


TRANSFORMED: dict[str, Callable[[Callable[[Tensor], Tensor], Tensor], Tensor]] = {
    "forward mode": lambda f, v: torch.func.jvp(f, (v,), (torch.ones_like(v),))[1],
    "gradient of vmap": lambda f, v: torch.func.grad(lambda x: torch.vmap(f)(x[None]).sum())(v),
    "vmap of gradients": lambda f, v: torch.vmap(torch.func.grad(lambda x: f(x).square().sum()))(v[None]),
}


@pytest.mark.parametrize(
    "name", ["forward mode", "vmap of gradients", pytest.param("gradient of vmap", marks=pytest.mark.slow)]
)
def test_transforms_that_compile_would_take_for_zero_are_refused_or_run_as_they_are(name: str):
    """torch.compile traces no derivative of an operator within forward mode or nested transforms: it would be zero."""

    def image(verts: Tensor) -> Tensor:
        return eg.render(MESH.replace(verts=verts), CAMERA, 4, seed=0)

    def function(verts: Tensor) -> Tensor:
        return TRANSFORMED[name](image, verts)

    torch._dynamo.reset()
    with pytest.raises(Exception, match=r"torch\.compile: expected no forward mode"):
        torch.compile(function, fullgraph=True, backend="aot_eager")(MESH.verts)
    torch._dynamo.reset()
    expected, found = function(MESH.verts), torch.compile(function, backend="aot_eager")(MESH.verts)
    assert bool(expected.any()) and torch.allclose(found, expected)
    torch._dynamo.reset()
