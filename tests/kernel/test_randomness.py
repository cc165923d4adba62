"""Seeds of renders: drawn by torch's generator as its own random functions draw, or given."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint
from torch_scenes import CAMERA, MESH, leaf

import edgegrad as eg

SUN = eg.lights.DirectionalLight(torch.tensor([0.2, -0.3, -1.0]), 2.0)
LIT = eg.Scene(MESH.replace(material=eg.Material()), lights=[SUN])


def plain(verts: Tensor, seed: int | None = None) -> Tensor:
    return eg.render(MESH.replace(verts=verts), CAMERA, 4, seed)


def lit(verts: Tensor, seed: int | None = None) -> Tensor:
    return eg.render(LIT.replace(meshes=[LIT.meshes[0].replace(verts=verts)]), CAMERA, 4, seed)


def shaded(verts: Tensor, seed: int | None = None) -> Tensor:
    return eg.render(MESH.replace(verts=verts), CAMERA, 4, seed, shader=lambda hits: hits.position.square())


CALLS: dict[str, Callable[..., object]] = {
    "render": lambda **given: plain(MESH.verts) if not given else eg.render(MESH, CAMERA, 4, **given),
    "lit": lambda **given: eg.render(LIT, CAMERA, 4, **given),
    "bounces": lambda **given: eg.render(LIT, CAMERA, 4, bounces=2, **given),
    "shader": lambda **given: eg.render(MESH, CAMERA, 4, shader=lambda hits: hits.position, **given),
    "render_aovs": lambda **given: eg.render_aovs(MESH, CAMERA, ["image", "alpha"], 4, **given)["alpha"],
    "render_batch": lambda **given: eg.render_batch([(MESH, CAMERA), (LIT, CAMERA)], 4, **given)[0],
    "jvp": lambda **given: eg.jvp(MESH, CAMERA, {MESH.verts: torch.ones_like(MESH.verts)[None]}, 4, **given)[1],
    "screen_gradient": lambda **given: eg.screen_gradient(MESH, CAMERA, torch.ones(*CAMERA.size, 3), 4, **given),
    "primary_hits": lambda **given: eg.points.primary_hits(MESH, CAMERA, 4, **given).hits.pixel,
}


@pytest.mark.quick
@pytest.mark.parametrize("name", CALLS)
def test_torch_draws_the_seed_unless_one_is_given(name: str):
    call = CALLS[name]
    first, second = call(), call()
    torch.manual_seed(0)
    again = call()
    assert not torch.equal(first, second)
    assert torch.equal(first, again)
    generator = torch.Generator().manual_seed(0)
    state = torch.get_rng_state()
    assert torch.equal(call(generator=generator), first)
    assert torch.equal(call(seed=7), call(seed=7))
    assert torch.equal(torch.get_rng_state(), state), "a seed that is given draws nothing"


def test_a_batch_draws_a_seed_for_each_pair():
    torch.manual_seed(1)
    images = eg.render_batch([(MESH, CAMERA), (MESH, CAMERA)], 4)
    torch.manual_seed(1)
    one_by_one = torch.stack([eg.render(MESH, CAMERA, 4) for _ in range(2)])
    assert torch.equal(images, one_by_one)
    assert not torch.equal(images[0], images[1])


def test_a_plan_draws_nothing():
    state = torch.get_rng_state()
    eg.plan(MESH, CAMERA)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("image", [plain, lit])
def test_vmap_draws_as_its_randomness_says(image: Callable[..., Tensor]):
    verts = torch.stack([MESH.verts] * 3)
    with pytest.raises(RuntimeError, match="randomness error mode"):
        torch.vmap(image)(verts)
    same = torch.vmap(image, randomness="same")(verts)
    assert torch.equal(same[0], same[1])
    different = torch.vmap(image, randomness="different")(verts)
    assert not torch.equal(different[0], different[1])
    fixed = torch.vmap(lambda v: image(v, 5))(verts)
    assert torch.allclose(fixed[2], image(MESH.verts, 5))


def test_vmap_of_a_shader_takes_one_seed():
    lift = torch.tensor([0.0, 1.0])

    def image(z: Tensor) -> Tensor:
        return eg.render(MESH, CAMERA, 4, shader=lambda hits: hits.position + z)

    same = torch.vmap(image, randomness="same")(lift)
    assert not torch.equal(same[0], same[1])
    with pytest.raises(RuntimeError, match=r'seed: expected one of all elements.*randomness="same"'):
        torch.vmap(image, randomness="different")(lift)


@pytest.mark.parametrize("image", [plain, lit, shaded])
def test_transforms_of_torch_func_draw_once(image: Callable[..., Tensor]):
    torch.manual_seed(3)
    seed = int(torch.randint(2**63 - 1, ()))
    torch.manual_seed(3)
    found = torch.func.grad(lambda v: image(v).sum())(MESH.verts)
    assert torch.allclose(found, torch.func.grad(lambda v: image(v, seed).sum())(MESH.verts))
    torch.manual_seed(3)
    value, tangent = torch.func.jvp(image, (MESH.verts,), (torch.ones_like(MESH.verts),))
    assert torch.equal(value, image(MESH.verts, seed))
    assert bool(tangent.abs().sum() > 0)


def test_checkpointing_draws_the_same_seed_again():
    verts = leaf(MESH.verts)
    torch.manual_seed(5)
    checkpoint(plain, verts, use_reentrant=False).square().sum().backward()
    found, verts.grad = verts.grad, None
    torch.manual_seed(5)
    plain(verts).square().sum().backward()
    assert torch.equal(found, verts.grad)


@pytest.mark.parametrize("image", [plain, lit])
def test_compiled_functions_draw_in_the_graph(image: Callable[..., Tensor]):
    torch._dynamo.reset()
    compiled = torch.compile(image, fullgraph=True, backend="aot_eager")
    torch.manual_seed(2)
    first, second = compiled(MESH.verts), compiled(MESH.verts)
    assert not torch.equal(first, second)
    torch.manual_seed(2)
    assert torch.equal(image(MESH.verts), first)
    torch._dynamo.reset()
