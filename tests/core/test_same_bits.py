"""Bits do not depend on the number of threads nor on what came before, but on the seed."""

from __future__ import annotations

import pytest
import torch
from scenes import cube, front_camera, icosphere, soup
from threads import check_threads
from torch_scenes import CAMERA, F32, F64, TRIANGLE, image_and_gradients, mixed_scene, same_bits

import edgegrad as eg
from edgegrad.library import core

REPEATABLE = {
    "mixed": lambda: (mixed_scene(), CAMERA),
    "mixed, float32": lambda: (mixed_scene().to(F32), CAMERA),
    "20,480 faces": lambda: (eg.Scene(icosphere(5)), front_camera(64)),
    "soup": lambda: (eg.Scene(soup(icosphere(4))), front_camera(64)),
}


@pytest.mark.parametrize("case", REPEATABLE)
def test_same_bits_at_any_number_of_threads(case):
    scene, camera = REPEATABLE[case]()

    def compute() -> list[torch.Tensor]:
        core.clear_geometry()
        return image_and_gradients(scene, camera, seed=11)

    check_threads(compute, (1, 2, 3))


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
        eg.render(cube(0.1 + 0.1 * i).replace(faces=cube().faces[: 12 - i]), camera, 1, seed=0)
    eg.render(scene, camera, 1, visibility=False, seed=0)
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


def test_seeds():
    scene = mixed_scene()
    first = image_and_gradients(scene, CAMERA, seed=0)
    for options in ({"seed": 1}, {"seed": 2**63 - 1}):
        assert not any(map(torch.equal, first, image_and_gradients(scene, CAMERA, **options)))
    image, *grads = image_and_gradients(scene, CAMERA, seed=0, sampling=eg.Sampling(seed=5))
    assert torch.equal(image, first[0])
    # The gradient of the background follows from the image's own samples, the others have their own.
    background = len(grads) - 3
    for i, (a, b) in enumerate(zip(grads, first[1:], strict=True)):
        assert torch.equal(a, b) == (i == background)
    # The samples of the gradient depend on those of the image only by which faces these hit: here the one there is.
    (image, *grads), (other_image, *others) = (
        image_and_gradients(TRIANGLE, CAMERA, seed=seed, sampling=eg.Sampling(seed=5)) for seed in (0, 1)
    )
    assert not torch.equal(image, other_image)
    for i, (a, b) in enumerate(zip(grads, others, strict=True)):
        assert torch.equal(a, b) == (i != len(grads) - 3)
