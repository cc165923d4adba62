"""edgegrad.raster.antialias next to a slow twin, and its derivatives."""

from __future__ import annotations

import math
import pickle

import numpy as np
import pytest
import raster_twin as twin
import torch
from scenes import icosphere
from test_raster import clip, random_triangles
from torch import Tensor

import edgegrad.raster as dr

pytestmark = pytest.mark.watched


def scene(seed: int) -> tuple[Tensor, Tensor]:
    """A sphere, folded at its silhouette, before loose triangles."""
    mesh = icosphere(1)
    loose, tri = random_triangles(seed, 5, 0.6)
    return torch.cat([clip(mesh.verts.double() * 0.6), loose]), torch.cat([mesh.faces, tri + len(mesh.verts)])


@pytest.mark.parametrize("seed", range(3))
def test_values_beside_the_twin(seed: int) -> None:
    pos, tri = scene(seed)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (22, 18))
    color = torch.rand(1, 22, 18, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    found = dr.antialias(color, rast, pos[None], tri)
    expected = twin.antialias(color[0].numpy(), rast[0].numpy(), pos.numpy(), tri.numpy())
    assert (np.abs(expected - color[0].numpy()).max(2) > 0).sum() > 20
    np.testing.assert_allclose(found[0].numpy(), expected, atol=1e-10)
    assert torch.equal(found, dr.antialias(color, rast, pos[None], tri, dr.antialias_construct_topology_hash(tri)))


def test_edges_up_and_along_give_exact_means() -> None:
    """A half-plane whose edge is straight up, or along: each pixel gets the share that it covers."""
    ctx, tri = dr.RasterizeCudaContext(), torch.tensor([[0, 1, 2]])
    for at in np.linspace(-0.4, 0.4, 9):
        corners = torch.tensor([[at, -9.0], [at, 9.0], [-30.0, 0.0]], dtype=torch.float64)
        covered = (4 + 4 * at - torch.arange(8, dtype=torch.float64)).clamp(0, 1)
        for points in (corners, corners.flip(1)):
            pos = torch.nn.functional.pad(points, (0, 1)).unsqueeze(0)
            pos = torch.nn.functional.pad(pos, (0, 1), value=1.0)
            rast, _ = dr.rasterize(ctx, pos, tri, (8, 8))
            image = dr.antialias((rast[..., 3:] > 0).double(), rast, pos, tri)[0, ..., 0]
            expected = covered.expand(8, 8)
            torch.testing.assert_close(image, expected if points is corners else expected.T)


@pytest.mark.parametrize("mode", ["instanced", "ranges"])
def test_derivatives(mode: str) -> None:
    pos, tri = scene(4)
    ranges = torch.tensor([[0, len(tri)], [80, 5]])
    pos = pos if mode == "ranges" else torch.stack([pos, pos * pos.new_tensor([1.2, 0.9, 1, 1])])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (12, 10), ranges=ranges)
    color = torch.rand(2, 12, 10, 2, dtype=torch.float64, requires_grad=True)
    image = dr.antialias(color, rast, pos, tri)
    assert ((image - color).abs().amax((1, 2, 3)) > 0).all()
    weight = torch.rand(image.shape, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda c: dr.antialias(c, rast, pos, tri), (color,), eps=1e-6, atol=1e-6)

    def loss(pos: Tensor) -> Tensor:
        return (dr.antialias(color.detach(), rast, pos, tri) * weight).sum()

    assert torch.autograd.gradcheck(loss, (pos.requires_grad_(),), eps=1e-7, atol=1e-5)
    (grad,) = torch.autograd.grad(loss(pos), pos)
    assert not grad[..., 2].any() and (grad[..., [0, 1, 3]].abs().amax(-1) > 0).sum() > 12
    boosted = (dr.antialias(color.detach(), rast, pos, tri, pos_gradient_boost=3.0) * weight).sum()
    torch.testing.assert_close(torch.autograd.grad(boosted, pos)[0], 3 * grad)


def test_the_area_of_an_outline_grows_with_the_square_of_its_size() -> None:
    mesh = icosphere(0)  # whose triangles are large: those at the silhouette are all seen
    scale = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, -0.8], [-0.3, 0, 0.5], [0.8, -0.5, 0]], dtype=torch.float64))
    verts = torch.nn.functional.pad(mesh.verts.double() @ turn * scale, (0, 1), value=1.0)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), verts[None], mesh.faces, (128, 128))
    image = dr.antialias((rast[..., 3:] > 0).double(), rast, verts[None], mesh.faces)
    image.sum().backward()
    area = float(image.detach().sum())
    assert scale.grad is not None and abs(float(scale.grad) / (2 * area / 0.6) - 1) < 0.05


def test_interior_edges_are_left_alone() -> None:
    """A flat square of two triangles, one of another colour: only its border is blended."""
    corners = torch.tensor([[-0.7, -0.7], [0.7, -0.7], [0.7, 0.7], [-0.7, 0.7]], dtype=torch.float64)
    pos = torch.cat([corners, torch.zeros(4, 1), torch.ones(4, 1)], 1)[None].double()
    tri = torch.tensor([[0, 1, 2], [0, 2, 3]])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (16, 16))
    color = rast[..., 3:].clone()
    image = dr.antialias(color, rast, pos, tri)
    inside = slice(4, 12)
    assert torch.equal(image[0, inside, inside], color[0, inside, inside]) and not torch.equal(image, color)
    apart = torch.tensor([[0, 1, 2], [4, 6, 7]])  # unwelded, of which each is a border
    both = torch.cat([pos, pos], 1)
    assert not torch.equal(dr.antialias(color, rast, both, apart)[0, inside, inside], color[0, inside, inside])


def test_wrong_arguments() -> None:
    pos, tri = random_triangles(5, 3)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (4, 4))
    color = torch.ones(1, 4, 4, 3)
    topology = dr.antialias_construct_topology_hash(tri)
    copied = pickle.loads(pickle.dumps(topology))
    assert torch.equal(dr.antialias(color, rast, pos, tri, topology), dr.antialias(color, rast, pos, tri, copied))
    for given, error, words in (
        ((torch.ones(1, 4, 5, 3), rast, pos, tri), ValueError, "color: expected shape \\(1, 4, 4, C\\)"),
        ((color, rast[..., :3], pos, tri), ValueError, "rast: expected shape"),
        ((color, rast, torch.stack([pos, pos]), tri), ValueError, "pos: expected shape"),
        ((color, rast + 9, pos, tri), ValueError, "rast: expected numbers of triangles"),
        ((color, rast, pos, tri, 3), TypeError, "topology_hash: expected what"),
        (
            (color, rast, pos, tri, dr.antialias_construct_topology_hash(tri[:1])),
            ValueError,
            "topology_hash: expected that of these 3",
        ),
        ((color, rast, pos, tri, dr.antialias_construct_topology_hash(tri.flip(0))), ValueError, "make it of tri anew"),
        ((color, rast, pos * torch.nan, tri), ValueError, "pos: expected finite"),
        ((color, rast, pos, tri, None, math.nan), ValueError, "pos_gradient_boost: expected a finite"),
    ):
        with pytest.raises(error, match=words):
            dr.antialias(*given)  # pyright: ignore[reportArgumentType]
