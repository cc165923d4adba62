"""The operators of torch.library by opcheck."""

from __future__ import annotations

import pytest
import torch
from torch_scenes import ADJOINT, CAMERA, F32, F64, SIZE, TRIANGLE, mixed_scene

import edgegrad as eg
from edgegrad.aovs import with_channels
from edgegrad.kernel.request import SLOTS, make_request

pytestmark = pytest.mark.quick


def operator_inputs(scene: eg.Scene) -> tuple:
    return make_request(scene, CAMERA, 4, sampling=eg.Sampling(surface=200, edges=200, seed=3)).pack()


SCENES = {"colors": lambda: TRIANGLE, "mixed": mixed_scene, "float32": lambda: TRIANGLE.to(F32)}


@pytest.mark.parametrize("wanted", ["11111111111", "10000110000"])
def test_opcheck_of_auxiliary_channels(wanted):
    names = ["image", "alpha", "position", "depth", "shading_normal", "normal", "barycentrics"]
    inputs = with_channels(
        make_request(TRIANGLE, CAMERA, 4, sampling=eg.Sampling(surface=200, edges=200)), names
    ).pack()
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


WANTED = [("11111111111", "mixed"), ("10000000000", "colors"), ("01000001101", "float32"), ("00000000000", "mixed")]
REST = [(wanted, scene) for wanted, _ in WANTED for scene in SCENES if (wanted, scene) not in WANTED]


@pytest.mark.parametrize(
    ("wanted", "scene"), [*WANTED, *(pytest.param(*case, marks=pytest.mark.slow) for case in REST)]
)
def test_opcheck_render_backward(wanted, scene):
    inputs = operator_inputs(SCENES[scene]())
    image, *forward = torch.ops.edgegrad.render(*inputs)
    inputs = (ADJOINT[None].to(image.dtype), *forward, *inputs, [w == "1" for w in wanted])
    torch.library.opcheck(torch.ops.edgegrad.render_backward.default, inputs)


@pytest.mark.parametrize("moving", ["11111111111", "10000000000", "01000001101"])
def test_opcheck_render_jvp(moving):
    request = make_request(mixed_scene(), CAMERA, 4, sampling=eg.Sampling(surface=200, edges=200))
    _, *hits = torch.ops.edgegrad.render(*request.pack())
    slots = [request.slot(name) for name in SLOTS]
    tangents = [torch.ones(2, *x.shape, dtype=F64) if m == "1" else None for m, x in zip(moving, slots, strict=True)]
    torch.library.opcheck(torch.ops.edgegrad.render_jvp.default, (*hits, *request.pack(), tangents, 2))
