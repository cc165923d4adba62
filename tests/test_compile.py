"""torch.compile of whole functions around render()."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import pytest
import torch
from scenes import cube, icosphere
from torch import Tensor
from torch_scenes import ADJOINT, BACKGROUND, CAMERA, F32, F64, MESH, SIZE, gradients, leaf, same_bits

import edgegrad as eg


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
