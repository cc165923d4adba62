"""antialias(…, exact=True): means over pixels and their derivatives next to polygons' areas."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from raster_twin import Floats
from scenes import icosphere
from test_raster import clip
from threads import check_threads

import edgegrad.raster as dr

SIZE = 10, 14  # height, width


def cut(polygon: Floats, normal: Floats) -> Floats:
    """Return the part of a convex polygon (n, K) where normal · p ≥ 0."""
    heights = polygon @ normal
    out = []
    for k in range(len(polygon)):
        a, b = heights[k], heights[(k + 1) % len(polygon)]
        if a >= 0:
            out.append(polygon[k])
        if (a >= 0) != (b >= 0):
            out.append(polygon[k] + a / (a - b) * (polygon[(k + 1) % len(polygon)] - polygon[k]))
    return np.array(out).reshape(-1, polygon.shape[1])


def outline(corners: Floats) -> Floats:
    """The visible part of a triangle in clip space, in pixels and a 1: (n, 3)."""
    for plane in ((0, 0, 1, 1), (0, 0, -1, 1)):
        corners = cut(corners, np.array(plane, float))
    flat = (corners[:, :2] / corners[:, 3:] + 1) / 2 * np.array(SIZE[::-1])
    return np.concatenate([flat, np.ones((len(flat), 1))], 1)


def sides(polygon: Floats) -> list[Floats]:
    """Lines that have a convex polygon on their positive side."""
    lines = [np.cross(polygon[k], polygon[(k + 1) % len(polygon)]) for k in range(len(polygon))]
    return [line * np.sign((polygon @ line).sum()) for line in lines]


def area(polygon: Floats) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return float(abs(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2) if len(polygon) > 2 else 0.0


def means(front: Floats, back: Floats, colors: Floats) -> Floats:
    """(H, W): the front triangle before the back one before black."""
    out = np.zeros(SIZE)
    a, b = outline(front), outline(back)
    for y, x in np.ndindex(*SIZE):
        pixel = [np.array(line, float) for line in ((1, 0, -x), (-1, 0, x + 1), (0, 1, -y), (0, -1, y + 1))]

        def within(polygon: Floats, lines: list[Floats]) -> Floats:
            for line in lines:
                if len(polygon):
                    polygon = cut(polygon, line)
            return polygon

        own, other = within(a, pixel), within(b, pixel)
        hidden = area(within(other, sides(a)))
        out[y, x] = colors[0] * area(own) + colors[1] * (area(other) - hidden)
    return out


SCENES = {
    "before the eye": (
        [[-0.9, -0.5, 0.3], [0.6, -0.4, 0.5], [0.1, 0.7, 0.1]],
        [[-0.6, 0.9, -0.6], [1.3, 0.2, -0.3], [-0.2, -1.1, -0.8]],
    ),
    "through the near plane": (
        [[-0.4, -0.6, 3.5], [0.5, -0.3, -1.0], [-1.0, 0.2, -1.5]],
        [[-2.5, 1.0, -1.9], [3.3, 1.2, -1.7], [-0.2, -2.9, -1.8]],
    ),
    "through the far plane": (
        [[-0.9, -0.5, 0.3], [0.6, -0.4, 0.5], [0.1, 0.7, 0.1]],
        [[-0.6, 0.9, -0.6], [60.0, 20.0, -120.0], [-0.2, -1.1, -0.8]],
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_means_and_derivatives(name: str) -> None:
    verts = torch.tensor(SCENES[name], dtype=torch.float64).reshape(6, 3)
    pos = clip(verts).requires_grad_()
    tri, colors = torch.tensor([[0, 1, 2], [3, 4, 5]]), np.array([1.0, 0.4])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, SIZE)
    assert {1, 2} <= set(rast[..., 3].flatten().tolist())
    color = torch.tensor([0, *colors], dtype=torch.float64)[rast[..., 3:].detach().long()]
    image = dr.antialias(color, rast, pos[None], tri, exact=True, spp=4096, seed=0)
    given = pos.detach().numpy()
    np.testing.assert_allclose(image[0, ..., 0].detach().numpy(), means(given[:3], given[3:], colors), atol=0.004)

    weight = torch.rand(*SIZE, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (image[0, ..., 0] * weight).sum().backward()
    assert pos.grad is not None
    found, expected, h = [], [], 1e-5
    for seed in range(6):
        along = torch.randn(6, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        ends = [given + sign * h * along.numpy() for sign in (1, -1)]
        values = [(means(end[:3], end[3:], colors) * weight.numpy()).sum() for end in ends]
        found.append(float((pos.grad * along).sum())), expected.append((values[0] - values[1]) / (2 * h))
    # Samples are as many as for 4,096 a pixel: they estimate this to about 0.3 %.
    assert np.linalg.norm(np.subtract(found, expected)) < 0.01 * np.linalg.norm(expected)


def grown(subdivisions: int, size: int, exact: bool) -> float:
    """How an outline's area grows with a sphere, divided by what it must: twice the area by the radius."""
    mesh = icosphere(subdivisions)
    scale = torch.tensor(0.6, dtype=torch.float64, requires_grad=True)
    turn = torch.linalg.matrix_exp(torch.tensor([[0, 0.3, -0.8], [-0.3, 0, 0.5], [0.8, -0.5, 0]], dtype=torch.float64))
    verts = torch.nn.functional.pad(mesh.verts.double() @ turn * scale, (0, 1), value=1.0)[None]
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), verts, mesh.faces, (size, size))
    image = dr.antialias((rast[..., 3:] > 0).double(), rast, verts, mesh.faces, exact=exact)
    (grad,) = torch.autograd.grad(image.sum(), scale)
    return float(grad) / (2 * float(image.detach().sum()) / 0.6)


def test_small_triangles_count_too() -> None:
    """No centre shows the thin faces at the silhouette, of 1,280 faces in 64 by 64 pixels."""
    assert grown(3, 64, exact=False) < 0.5
    assert abs(grown(3, 64, exact=True) - 1) < 0.01


def test_colors_get_the_shares_of_samples() -> None:
    verts = torch.tensor(SCENES["before the eye"], dtype=torch.float64).reshape(6, 3)
    pos, tri = clip(verts)[None], torch.tensor([[0, 1, 2], [3, 4, 5]])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, SIZE)
    color = torch.rand(1, *SIZE, 2, dtype=torch.float64, requires_grad=True)
    weight, along = torch.rand(2, 1, *SIZE, 2, dtype=torch.float64)
    image = dr.antialias(color, rast, pos, tri, exact=True, spp=4, seed=0)
    (grad,) = torch.autograd.grad((image * weight).sum(), color)
    of_along = dr.antialias(along, rast, pos, tri, exact=True, spp=4, seed=0)  # it is linear
    torch.testing.assert_close((grad * along).sum(), (of_along * weight).sum())
    ones = dr.antialias(torch.ones_like(color), rast, pos, tri, exact=True, seed=0)
    torch.testing.assert_close(ones, torch.ones_like(ones))


def test_batches_ranges_and_boost() -> None:
    a, b = (clip(torch.tensor(points, dtype=torch.float64).reshape(-1, 3)) for points in SCENES["before the eye"])
    tri = torch.tensor([[0, 1, 2]])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), torch.stack([a, b]), tri, SIZE)
    color = (rast[..., 3:] > 0).double()
    instanced = torch.stack([a, b]).requires_grad_()
    image = dr.antialias(color, rast, instanced, tri, exact=True, seed=0)
    (grad,) = torch.autograd.grad(image.sum(), instanced)

    both, tris = torch.cat([a, b]).requires_grad_(), torch.tensor([[0, 1, 2], [3, 4, 5]])
    ranges = torch.tensor([[0, 1], [1, 1]])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), both, tris, SIZE, ranges=ranges)
    again = dr.antialias(color, rast, both, tris, exact=True, ranges=ranges, pos_gradient_boost=2.0, seed=0)
    assert torch.equal(image, again)
    torch.testing.assert_close(torch.autograd.grad(again.sum(), both)[0].view(2, 3, 4), 2 * grad)

    wrong: list[tuple[dict[str, object], str]] = [
        ({}, "ranges: expected those"),
        ({"ranges": ranges[:1]}, "ranges: expected shape"),
        ({"ranges": ranges + 1}, "ranges: expected a first triangle"),
        ({"ranges": ranges.flip(0)}, "rast: expected numbers of triangles"),
        ({"ranges": ranges, "spp": 0}, "spp: expected"),
    ]
    for given, words in wrong:
        with pytest.raises(ValueError, match=words):
            dr.antialias(color, rast, both, tris, exact=True, **given)  # pyright: ignore[reportArgumentType]


def test_nothing_to_see() -> None:
    pos = torch.tensor([[[0.0, 0, 0, -1], [1, 0, 0, -1], [0, 1, 0, -1]]], requires_grad=True)
    tri, color = torch.tensor([[0, 1, 2]]), torch.rand(1, 4, 4, 3)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (4, 4))
    assert torch.equal(dr.antialias(color, rast, pos, tri, exact=True, seed=0), color)


def test_same_bits_at_any_number_of_threads() -> None:
    mesh = icosphere(1)
    pos = clip(mesh.verts.double()).float()[None].requires_grad_()

    def compute() -> list[torch.Tensor]:
        rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, mesh.faces, (24, 24))
        image = dr.antialias((rast[..., 3:] > 0).float(), rast, pos, mesh.faces, exact=True, seed=0)
        return [image, *torch.autograd.grad(image.square().sum(), pos)]

    check_threads(compute)
