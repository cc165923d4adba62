"""render() of lit scenes under the transforms of torch.func, and of tensors made in torch.inference_mode()."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from lit_scenes import F64, ball, from_above, plane, vector
from scenes import smooth_adjoint
from torch import Tensor
from torch_scenes import leaf

import edgegrad as eg

SIZE = 6
CAMERA = from_above(SIZE)
ADJOINT = smooth_adjoint(SIZE, SIZE, 3)
BALL = ball(0, smooth=False)
FLOOR = plane(3.0, material=eg.Material()).transformed(t=vector(0, 0, -1))
PLACE, RADIANCE = vector(1, 2, 4), vector(0.2, 0.3, 0.4)
IMAGE = torch.rand((3, 2, 3), dtype=F64, generator=torch.Generator().manual_seed(4))
UVS = BALL.verts[:, :2] / 2


def lit(
    verts: Tensor = BALL.verts,
    place: Tensor = PLACE,
    image: Tensor = IMAGE,
    camera: eg.Camera = CAMERA,
) -> Tensor:
    shiny = eg.Material(eg.Texture(image, UVS, BALL.faces, filter="linear"), roughness=0.4)
    lights = [eg.lights.PointLight(place, 20.0), eg.lights.Environment(RADIANCE)]
    return eg.render(eg.Scene([eg.Mesh(verts, BALL.faces, material=shiny), FLOOR], lights=lights), camera, 1, seed=0)


def mipmapped(image: Tensor) -> Tensor:
    """Not lit, but shaded by PyTorch."""
    return eg.render(
        eg.Mesh(BALL.verts, BALL.faces, texture=image, uvs=UVS, uv_faces=BALL.faces, filter="mipmap"), CAMERA, seed=0
    )


def emitter(radiance: Tensor) -> Tensor:
    meshes = [
        FLOOR,
        eg.shapes.rectangle(
            PLACE, vector(0.5, 0, 0), vector(0, 0.5, 0), material=eg.Material(base_color=0.0, emission=radiance)
        ),
    ]
    return eg.render(eg.Scene(meshes), CAMERA, 1, seed=0)


TWO = torch.tensor([1.0, 1.2], dtype=F64)
BATCHES: dict[str, tuple[Callable[[Tensor], Tensor], Tensor]] = {
    "verts": (lambda v: lit(v), BALL.verts * TWO[:, None, None]),
    "light": (lambda p: lit(place=p), PLACE * TWO[:, None]),
    "texture": (lambda i: lit(image=i), IMAGE * TWO[:, None, None, None]),
    "emitter": (emitter, RADIANCE * TWO[:, None]),
    "K": (lambda k: lit(camera=CAMERA.replace(K=k)), CAMERA.K * torch.stack([torch.ones(3, 1), TWO[[0, 1, 0], None]]).to(F64)),
    "mipmaps": (mipmapped, IMAGE * TWO[:, None, None, None]),
}  # fmt: skip


@pytest.mark.parametrize("name", BATCHES)
def test_vmap(name: str) -> None:
    """Images and gradients are those of a loop; also of the other transforms within it, and around it."""
    function, batch = BATCHES[name]

    def loss(x: Tensor) -> Tensor:
        return (function(x) * ADJOINT).sum()

    assert torch.equal(torch.vmap(function)(batch), torch.stack([function(x) for x in batch]))
    leaves = leaf(batch)
    expected = torch.autograd.grad(torch.stack([loss(x) for x in leaves]).sum(), leaves)[0]
    assert expected.any()
    torch.testing.assert_close(torch.vmap(torch.func.grad(loss))(batch), expected, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(
        torch.func.grad(lambda x: torch.vmap(loss)(x).sum())(batch), expected, rtol=1e-12, atol=1e-12
    )
    torch.testing.assert_close(
        torch.autograd.grad(torch.vmap(loss)(leaves).sum(), leaves)[0], expected, rtol=1e-12, atol=1e-12
    )


def test_forward_mode_of_a_batch() -> None:
    """Within and around torch.vmap: the derivative that reverse mode has."""
    batch = BALL.verts * TWO[:, None, None]
    tangent = torch.stack([BALL.verts.roll(1, 1), BALL.verts.roll(1, 0)])

    def loss(v: Tensor) -> Tensor:
        return (lit(v) * ADJOINT).sum()

    expected = torch.stack([(torch.func.grad(loss)(v) * t).sum() for v, t in zip(batch, tangent, strict=True)])
    within = torch.vmap(lambda v, t: torch.func.jvp(loss, (v,), (t,))[1])(batch, tangent)
    around = torch.func.jvp(torch.vmap(loss), (batch,), (tangent,))[1]
    for found in (within, around):
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)


def test_a_batch_of_scenes_and_cameras() -> None:
    """torch.vmap over scenes, each seen by two cameras, with channels besides the image."""
    cameras = CAMERA.replace(K=torch.stack([CAMERA.K, CAMERA.K * torch.tensor([[1.2], [1.2], [1]], dtype=F64)]))

    def image(place: Tensor) -> Tensor:
        scene = eg.Scene([BALL.replace(material=eg.Material())], lights=[eg.lights.PointLight(place, 20.0)])
        return eg.render_aovs(scene, cameras, ["image", "alpha"], 1, seed=0)["image"]

    batch = PLACE * TWO[:, None]
    assert torch.equal(torch.vmap(image)(batch), torch.stack([image(p) for p in batch]))


def test_second_derivatives_of_a_batch_are_refused() -> None:
    def loss(v: Tensor) -> Tensor:
        return lit(v).square().sum()

    with pytest.raises(RuntimeError, match="second derivatives of a rendered image are not available"):
        torch.vmap(torch.func.grad(lambda v: torch.func.grad(loss)(v).sum()))(BALL.verts[None])


@pytest.mark.parametrize("shader", [None, lambda hits: hits.position])
def test_what_was_made_in_inference_mode(shader) -> None:
    """Autograd saves no such tensor, but a copy of it."""
    t = leaf(vector(0, 0, 0))

    def gradient(scene: eg.Scene, camera: eg.Camera) -> Tensor:
        moved = scene.replace(meshes=[mesh.transformed(t=t) for mesh in scene.meshes])
        return torch.autograd.grad((eg.render(moved, camera, 1, shader=shader, seed=0) * ADJOINT).sum(), t)[0]

    shiny = BALL.replace(material=eg.Material(0.5, roughness=0.4))
    scene = eg.Scene([shiny, FLOOR], lights=[eg.lights.PointLight(PLACE, 20.0), eg.lights.Environment(RADIANCE)])
    with torch.inference_mode():
        copy, camera = scene.to(F64, copy=True), CAMERA.to(F64, copy=True)
        image = eg.render(copy, camera, 1, seed=0)
    assert copy.meshes[0].verts.is_inference() and torch.equal(image, eg.render(scene, CAMERA, 1, seed=0))
    assert torch.equal(gradient(copy, camera), gradient(scene, CAMERA)) and gradient(scene, CAMERA).any()
