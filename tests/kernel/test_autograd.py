"""render() in graphs: modes, modules, optimisers, repeated backward passes, changes in place."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from scenes import smooth_adjoint
from torch import Tensor
from torch_scenes import (
    ADJOINT,
    BACKGROUND,
    CAMERA,
    F32,
    F64,
    MESH,
    OTHER,
    SIZE,
    TRIANGLE,
    gradients,
    image_and_gradients,
    leaf,
    mixed_scene,
    same_bits,
    with_leaves,
)

import edgegrad as eg
from edgegrad.library import core

BATCH = eg.Camera.stack([CAMERA, OTHER])


@pytest.mark.parametrize("mode", [torch.no_grad, torch.inference_mode])
def test_without_gradients(mode):
    expected = eg.render(TRIANGLE, CAMERA, 4, seed=0)
    with mode():
        mesh = MESH.replace(verts=leaf(MESH.verts) * 1.0)
        image = eg.render(eg.Scene(mesh, BACKGROUND), CAMERA, 4, seed=0)
    assert torch.equal(image, expected) and not image.requires_grad


def test_with_what_was_made_in_inference_mode():
    """Autograd keeps no such tensor, but a copy of it."""
    with torch.inference_mode():
        scene, camera = TRIANGLE.transformed(scale=1.0), CAMERA.to(F64, copy=True)
        scene = scene.replace(meshes=[scene.meshes[0].replace(colors=1.0 * MESH.colors, faces=MESH.faces.int())])
    assert scene.meshes[0].colors.is_inference() and camera.K.is_inference()
    t = leaf(torch.zeros(3, dtype=F64))
    mesh = scene.meshes[0].replace(verts=MESH.verts + t)
    image = eg.render(eg.Scene(mesh, BACKGROUND), camera, 4, seed=0)
    assert torch.equal(gradients(image, [t])[0], gradients(triangle(MESH.verts + t), [t])[0])


def test_image_requires_gradients_if_anything_does():
    assert not eg.render(TRIANGLE, CAMERA, 4, seed=0).requires_grad
    assert eg.render(TRIANGLE, CAMERA.replace(K=leaf(CAMERA.K)), 4, seed=0).requires_grad


def test_only_what_requires_a_gradient_gets_one():
    everything = image_and_gradients(mixed_scene(), CAMERA)[1:]
    for chosen in range(len(everything)):
        scene, camera, leaves = with_leaves(mixed_scene(), CAMERA)
        for i, tensor in enumerate(leaves):
            tensor.requires_grad_(i == chosen)
        image = eg.render(scene, camera, 4, seed=0)
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
        target = eg.render(
            eg.Scene(MESH.to(F32).transformed(t=[0.1, -0.05, 0.0]), BACKGROUND.to(F32)), CAMERA, 64, seed=0
        )
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
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (loop,) = (block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "optimizer.step()" in block)
    target = eg.render(MESH.transformed(t=[0.05, -0.03, 0.0]), CAMERA, 64, seed=1 << 40)
    states, render = [], eg.render

    def watched(*args, **options) -> Tensor:
        states.append(torch.get_rng_state())
        return render(*args, **options)

    monkeypatch.setattr(eg, "render", watched)
    names = {"torch": torch, "eg": eg, "mesh": MESH, "camera": CAMERA, "target": target}
    exec(loop.replace("range(200)", "range(40)"), names)
    assert len(states) == 40 and not torch.equal(states[0], states[1])
    fitted, start = (render(MESH.replace(verts=v), CAMERA, 64) for v in (names["verts"], MESH.verts))
    assert (fitted - target).norm() < 0.6 * (start - target).norm()


def test_the_light_in_the_readme():
    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    (lit,) = (
        block
        for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL)
        if "eg.lights.DirectionalLight(sun" in block
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
    image = eg.render(MESH.replace(verts=verts), CAMERA, 4, seed=0)
    first, second = (torch.autograd.grad(image, verts, ADJOINT, retain_graph=True)[0] for _ in range(2))
    assert torch.equal(first, second)
    torch.autograd.grad(image, verts, ADJOINT)
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(image, verts, ADJOINT)


def test_gradient_is_linear_in_the_adjoint():
    """The samples do not depend on the adjoint's size, nor on its sign."""
    verts = leaf(MESH.verts)
    image = eg.render(MESH.replace(verts=verts), CAMERA, 4, seed=0)
    one, other = (torch.autograd.grad(image, verts, s * ADJOINT, retain_graph=True)[0] for s in (1, -4))
    torch.testing.assert_close(other, -4 * one, rtol=1e-12, atol=0)
    assert not torch.autograd.grad(image, verts, torch.zeros_like(ADJOINT))[0].any()


def triangle(verts: Tensor, camera: eg.Camera = CAMERA) -> Tensor:
    return eg.render(eg.Scene(MESH.replace(verts=verts), BACKGROUND), camera, 4, seed=0)


@pytest.mark.parametrize("value", [torch.nan, -torch.inf])
def test_an_adjoint_that_is_not_finite_is_named_at_its_place(value):
    """The place is that in the user's image, with an axis for cameras where there is a batch of them."""
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
        expected = gradients(eg.render(mesh.replace(verts=verts), CAMERA, 4, seed=0), [verts])
        image = eg.render(mesh.replace(verts=verts), CAMERA, 4, seed=0)
        with torch.no_grad():
            verts += 0.3
        if dtype == F32:
            assert same_bits(gradients(image, [verts]), expected)
        else:
            with pytest.raises(RuntimeError, match="modified by an inplace operation"):
                gradients(image, [verts])


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
