"""How many samples are taken, and what more of them bring."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from oracles import reference
from scenes import one_triangle
from torch import Tensor
from torch_scenes import (
    ADJOINT,
    CAMERA,
    F64,
    MESH,
    SIZE,
    TRIANGLE,
    gradients,
    image_and_gradients,
    mixed_scene,
    with_leaves,
)

import edgegrad as eg
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import HitBuffers, kernel_camera, kernel_channels, kernel_hits, kernel_scene
from edgegrad.kernel.request import make_request, pack_camera
from edgegrad.library import core


def relative_error(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


def sample_counts(
    surface: int, edge: int, adjoint: Tensor, boundary: bool = True, spp: int = 16, **light: bool
) -> tuple[int, int]:
    """Return how many samples the kernel says it drew for the triangle's vertices."""
    # All pixels covered, and so few samples that no budget binds; nothing is occluded.
    hits = HitBuffers(
        torch.ones(1, SIZE, SIZE, dtype=F64),
        torch.full((1, SIZE, SIZE), torch.inf),
        torch.zeros((1, SIZE, SIZE, 2), dtype=torch.int32),
        torch.ones((1, 1), dtype=torch.uint8),
    )
    profile = kernel_scene(flatten(TRIANGLE)).backward(
        kernel_camera(pack_camera(CAMERA)),
        kernel_channels(make_request(TRIANGLE, CAMERA)),
        core.ImageOptions(spp=spp, filter="box", seed=0),
        core.GradientOptions(seed=0, surface_samples=surface, edge_samples=edge, boundary=boundary, **light),
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


def test_sample_counts_grow_with_those_of_the_image():
    """In proportion from 16 a pixel on; below, they stay. Numbers that one gives stay as well."""
    smooth = torch.ones_like(ADJOINT)
    surface, edge = sample_counts(-1, -1, smooth)
    for spp in (64, 100, 4096):
        more = sample_counts(-1, -1, smooth, spp=spp)
        assert abs(more[0] - spp / 16 * surface) <= spp / 16 and abs(more[1] - spp / 16 * edge) <= spp / 16
        assert sample_counts(123, 45, ADJOINT, spp=spp) == (123, 45)
    for spp in (1, 4):
        assert sample_counts(-1, -1, smooth, spp=spp) == (surface, edge)


def test_sample_counts_where_surfaces_light_each_other():
    """Four times as many inside faces as with direct light, for each has a noisy path."""
    smooth = torch.ones_like(ADJOINT)
    direct, indirect = (sample_counts(-1, -1, smooth, lit=True, indirect=on) for on in (False, True))
    assert abs(indirect[0] - 4 * direct[0]) <= 4 and indirect[1] == direct[1]


def test_more_samples_are_better():
    """Gradients from one sample of each kind and from many: finite, and the many closer to those of very many."""
    truth = image_and_gradients(TRIANGLE, CAMERA, sampling=eg.Sampling(surface=200_000, edges=200_000))
    errors = []
    for n in (1, 100, 10_000):
        runs = [image_and_gradients(TRIANGLE, CAMERA, sampling=eg.Sampling(n, n, seed=seed)) for seed in range(8)]
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
        gradients(
            eg.render(scene, camera, 144, visibility=on, sampling=eg.Sampling(surface=100_000), seed=0), leaves, ADJOINT
        )
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
