"""render() under the transforms of torch.func, and derivatives of derivatives."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch_scenes import ADJOINT, BACKGROUND, CAMERA, F64, MESH, SIZE, leaf

import edgegrad as eg

SECOND = "second derivatives of a rendered image are not available.*Gauss-Newton"


def triangle(verts: Tensor, camera: eg.Camera = CAMERA) -> Tensor:
    return eg.render(eg.Scene(MESH.replace(verts=verts), BACKGROUND), camera, 4, seed=0)


def linear(verts: Tensor) -> Tensor:
    return (triangle(verts) * ADJOINT).sum()


def quadratic(verts: Tensor) -> Tensor:
    return triangle(verts).square().sum()


def shaded(verts: Tensor) -> Tensor:
    scene = eg.Scene(MESH.replace(verts=verts), BACKGROUND)
    return (eg.render(scene, CAMERA, 4, shader=lambda hits: hits.position.square(), seed=0) * ADJOINT).sum()


def lit(verts: Tensor) -> Tensor:
    mesh = MESH.replace(verts=verts, material=eg.Material())
    scene = eg.Scene(mesh, BACKGROUND, lights=[eg.lights.PointLight(torch.tensor([1.0, 2.0, 3.0]), 20.0)])
    return (eg.render(scene, CAMERA, 4, seed=0) * ADJOINT).sum()


def first_order(loss: Callable[[Tensor], Tensor], verts: Tensor) -> Tensor:
    """The gradient as a function of the vertices, in the graph."""
    return torch.autograd.grad(loss(verts), verts, create_graph=True)[0]


def gradient_penalty(loss: Callable[[Tensor], Tensor]) -> None:
    verts = leaf(MESH.verts)
    (loss(verts) + first_order(loss, verts).square().sum()).backward()


def learnt_step(loss: Callable[[Tensor], Tensor]) -> None:
    """Differentiate the loss after a step by where the step began, as meta-learning does."""
    verts = leaf(MESH.verts)
    loss(verts - 0.1 * first_order(loss, verts)).backward()


def by_the_adjoint(loss: Callable[[Tensor], Tensor]) -> None:
    """The gradient is linear in the adjoint; that derivative is the one of forward mode."""
    verts, weight = leaf(MESH.verts), leaf(torch.ones((), dtype=F64))
    first_order(lambda v: weight * loss(v), verts).sum().backward()


TWICE = {
    "gradient penalty": gradient_penalty,
    "learnt step": learnt_step,
    "by the adjoint": by_the_adjoint,
    "functional.hessian": lambda loss: torch.autograd.functional.hessian(loss, MESH.verts),
    "functional.hessian, vectorized": lambda loss: torch.autograd.functional.hessian(loss, MESH.verts, vectorize=True),
    "functional.hvp": lambda loss: torch.autograd.functional.hvp(loss, MESH.verts, MESH.verts),
    "functional.vhp": lambda loss: torch.autograd.functional.vhp(loss, MESH.verts, MESH.verts),
    "functional.jvp": lambda loss: torch.autograd.functional.jvp(
        loss, MESH.verts, MESH.verts
    ),  # by two backward passes
    "grad(grad)": lambda loss: torch.func.grad(lambda v: torch.func.grad(loss)(v).sum())(MESH.verts),
    "jacrev(grad)": lambda loss: torch.func.jacrev(torch.func.grad(loss))(MESH.verts),
    "func.hessian": lambda loss: torch.func.hessian(loss)(MESH.verts),
    "jvp(grad)": lambda loss: torch.func.jvp(torch.func.grad(loss), (MESH.verts,), (MESH.verts,)),
    "jacrev(jacrev)": lambda loss: torch.func.jacrev(torch.func.jacrev(loss))(MESH.verts),
}


@pytest.mark.parametrize(
    ("method", "loss"),
    [
        *((method, loss) for method in TWICE for loss in (linear, quadratic)),
        *((method, loss) for method in ("gradient penalty", "func.hessian", "jvp(grad)") for loss in (shaded, lit)),
    ],
)
def test_second_derivatives_are_refused(method, loss):
    """Zeros came, without a word, where the loss is linear in the image, and from some of these for any loss."""
    with pytest.raises(RuntimeError, match=SECOND):
        TWICE[method](loss)


def test_a_gradient_in_the_graph_is_no_second_derivative():
    for loss in (linear, quadratic):
        verts, other = leaf(MESH.verts), leaf(MESH.verts)
        assert torch.equal(first_order(loss, verts), torch.autograd.grad(loss(other), other)[0])


def test_forward_mode_of_what_is_not_rendered():
    constant = torch.func.jacfwd(lambda x: x * triangle(MESH.verts).sum())(torch.ones(()))
    assert torch.equal(constant, triangle(MESH.verts).sum())


def test_functional_gradient():
    verts = leaf(MESH.verts)
    assert torch.equal(torch.func.grad(linear)(MESH.verts), *torch.autograd.grad(linear(verts), verts))


@pytest.mark.parametrize("jacobian", [torch.func.jacrev, None])
def test_jacobian(jacobian):
    """A row of it is the gradient of a pixel."""
    small = CAMERA.resized((4, 5))
    verts = leaf(MESH.verts)
    image = triangle(verts, small)
    if jacobian is None:
        found = torch.autograd.functional.jacobian(lambda v: triangle(v, small), MESH.verts, vectorize=True)
    else:
        found = jacobian(lambda v: triangle(v, small))(MESH.verts)
    assert found.shape == (4, 5, 3, 3, 3)
    for pixel in ((1, 2, 0), (2, 3, 1)):
        expected = torch.autograd.grad(image[pixel], verts, retain_graph=True)[0]
        assert expected.any() and torch.equal(found[pixel], expected)


SHIFTS = torch.tensor([[0.0, 0.0, 0.0], [0.1, 0.0, 0.2], [0.0, -0.2, 0.1]], dtype=F64)
EYES = torch.tensor([[0.0, 0.0, 4.0], [0.5, 0.2, 3.0]], dtype=F64)
FOCAL = torch.diag(torch.tensor([1.0, 1.0, 0.0], dtype=F64))


def textured(texture: Tensor) -> eg.Mesh:
    return eg.Mesh(MESH.verts, MESH.faces, texture=texture, uvs=MESH.verts[:, :2], uv_faces=MESH.faces)


def view_from(eye: Tensor, fov_y: Tensor | float = 40.0) -> eg.Camera:
    return eg.Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=fov_y, size=(SIZE, SIZE))


BATCHES = {
    "verts": (triangle, MESH.verts + SHIFTS[:, None]),
    "translation": (lambda t: eg.render(MESH.transformed(t=t), CAMERA, 4, seed=0), SHIFTS),
    "colours": (lambda c: eg.render(MESH.replace(colors=c), CAMERA, 4, seed=0), MESH.colors + SHIFTS[:, None]),
    "background": (lambda b: eg.render(eg.Scene(MESH, b), CAMERA, 4, seed=0), SHIFTS),
    "texture": (lambda t: eg.render(textured(t), CAMERA, 4, seed=0), ADJOINT[:6, :6].reshape(2, 3, 6, 3)),
    "world_to_camera": (
        lambda m: triangle(MESH.verts, CAMERA.replace(world_to_camera=m)),
        CAMERA.world_to_camera + torch.nn.functional.pad(SHIFTS[:, :, None], (3, 0, 0, 1)),
    ),
    "K": (lambda k: triangle(MESH.verts, CAMERA.replace(K=k)), CAMERA.K + SHIFTS[:, :1, None] * FOCAL),
    "eye": (lambda e: triangle(MESH.verts, view_from(e)), EYES),
    "fov_y": (lambda f: triangle(MESH.verts, view_from(EYES[0], f)), torch.tensor([30.0, 50.0], dtype=F64)),
}


@pytest.mark.parametrize("name", BATCHES)
def test_vmap(name):
    """Images and gradients are those of a loop, also of the other transforms within vmap and around it."""
    function, batch = BATCHES[name]

    def loss(x: Tensor) -> Tensor:
        return (function(x) * ADJOINT).sum()

    assert torch.equal(torch.vmap(function)(batch), torch.stack([function(x) for x in batch]))
    expected = torch.stack([torch.func.grad(loss)(x) for x in batch])
    assert expected.any()
    assert torch.equal(torch.vmap(torch.func.grad(loss))(batch), expected)
    assert torch.equal(torch.func.grad(lambda x: torch.vmap(loss)(x).sum())(batch), expected)
    leaves = leaf(batch)
    torch.vmap(loss)(leaves).sum().backward()
    assert torch.equal(leaves.grad, expected)


def test_vmap_in_vmap_over_other_axes():
    verts = (MESH.verts + SHIFTS[:, None])[None] * torch.tensor([1.0, 1.1], dtype=F64)[:, None, None, None]
    images = torch.vmap(torch.vmap(triangle, in_dims=1, out_dims=2))(verts.movedim(1, 2))
    expected = torch.stack([torch.stack([triangle(v) for v in row], 2) for row in verts])
    assert torch.equal(images, expected)


def test_vmap_still_refuses_what_is_not_finite():
    verts = MESH.verts + SHIFTS[:, None]
    verts[1, 2, 0] = torch.nan
    with pytest.raises(ValueError, match=r"verts: expected finite numbers, got nan at \[2, 0\]"):
        torch.vmap(triangle)(verts)
