"""edgegrad.raster: rasterize and interpolate next to a slow twin, exact coverage, and derivatives."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import raster_twin as twin
import torch
from scenes import icosphere
from threads import check_threads
from torch import Tensor

import edgegrad.raster as dr

pytestmark = [pytest.mark.quick, pytest.mark.watched]


def perspective(f: float = 2.0, near: float = 0.5, far: float = 20.0) -> Tensor:
    """OpenGL's, with the eye looking along −z."""
    a, b = -(far + near) / (far - near), -2 * far * near / (far - near)
    return torch.tensor([[f, 0, 0, 0], [0, f, 0, 0], [0, 0, a, b], [0, 0, -1, 0]], dtype=torch.float64)


def clip(points: Tensor, distance: float = 3.0) -> Tensor:
    moved = points - points.new_tensor([0, 0, distance])
    return torch.nn.functional.pad(moved, (0, 1), value=1.0) @ perspective().to(points).T


def random_triangles(seed: int, count: int = 12, spread: float = 1.0) -> tuple[Tensor, Tensor]:
    """Return triangles in clip space; some reach behind the eye where `spread` is above 2."""
    points = torch.randn(3 * count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(seed)) * spread
    return clip(points), torch.arange(3 * count).reshape(count, 3)


@pytest.mark.parametrize("seed, spread", [(0, 0.7), (1, 1.0), (2, 2.5), (3, 4.0)])
def test_rasterize_equal_the_twin(seed: int, spread: float) -> None:
    pos, tri = random_triangles(seed, spread=spread)
    behind = (pos[tri][..., 3] < 0).any(1).sum()
    assert (behind > 0) == (spread > 2), behind
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (9, 14))
    expected = torch.from_numpy(twin.rasterize(pos.numpy(), tri.numpy(), (9, 14)))
    assert (expected[..., 3] > 0).sum() > 20
    torch.testing.assert_close(rast[0], expected, rtol=1e-9, atol=1e-10)
    xs, ys = twin.centers(9, 14)
    for j, i in (expected[..., 3] > 0).nonzero().tolist():
        corners, h = tri[int(expected[j, i, 3]) - 1].numpy(), 1e-6
        at = xs[i], ys[j]

        def difference(dx: float, dy: float, corners: twin.Ints = corners, at: tuple[float, float] = at) -> twin.Floats:
            ends = (twin.barycentrics_at(pos.numpy(), corners, at[0] + s * dx, at[1] + s * dy) for s in (1, -1))
            return next(ends) - next(ends)

        step = difference(h, 0), difference(0, h)
        by_pixel = np.stack([step[0] / (2 * h) * 2 / 14, step[1] / (2 * h) * 2 / 9], 1).reshape(4)
        np.testing.assert_allclose(rast_db[0, j, i].numpy(), by_pixel, rtol=1e-4, atol=1e-5)


def test_float32_is_rounded_once() -> None:
    pos, tri = random_triangles(4)
    single = pos.float()
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), single[None], tri, (20, 20))
    exact, exact_db = dr.rasterize(dr.RasterizeCudaContext(), single.double()[None], tri, (20, 20))
    assert rast.dtype == torch.float32 and torch.equal(rast, exact.float()) and torch.equal(rast_db, exact_db.float())


def coverage(pos: Tensor, tri: Tensor, size: tuple[int, int]) -> Tensor:
    """(F, H, W): what each triangle covers alone."""
    one_each = torch.stack([torch.arange(len(tri)), torch.ones(len(tri), dtype=torch.long)], 1)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, size, ranges=one_each)
    return rast[..., 3] > 0


def faces_front(pos: Tensor, tri: Tensor) -> Tensor:
    """(F,) 1 where the corners run counter-clockwise as the eye sees them, −1 where clockwise."""
    return torch.linalg.det(pos[tri][:, :, [0, 1, 3]].double()).sign()


@pytest.mark.parametrize("seed", range(4))
def test_each_centre_of_a_closed_surface_is_hit_once(seed: int) -> None:
    """All vertices of a convex mesh lie on centres, or between them, so that edges pass through many."""
    n = 16
    mesh = icosphere(2)
    verts = mesh.verts.double() * 0.9
    if seed % 2:  # in the image on the lattice of centres and of pixels' corners
        verts[:, :2] = (verts[:, :2] * n).round() / n
    pos = torch.nn.functional.pad(verts, (0, 1), value=1.0)
    if seed >= 2:
        pos = pos.float()
    covered = coverage(pos, mesh.faces, (n, n))
    sign = faces_front(pos, mesh.faces)
    front, back = covered[sign > 0].sum(0), covered[sign < 0].sum(0)
    assert front.max() == back.max() == 1 and torch.equal(front, back)
    inside = front.float().sum() / n**2 * 4  # of the image's area, which is 4
    assert 0.85 < inside / (np.pi * 0.81) < 1.15


def random_closed_mesh(seed: int, lattice: int) -> tuple[Tensor, Tensor]:
    """A sphere's faces with vertices anywhere on a lattice: it passes through itself, folds and degenerates."""
    mesh = icosphere(1)
    draws = torch.randint(-lattice, lattice + 1, (len(mesh.verts), 3), generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.pad(draws.double() / lattice, (0, 1), value=1.0), mesh.faces


@pytest.mark.parametrize("seed", range(6))
def test_surfaces_without_border_cover_from_both_sides_alike(seed: int) -> None:
    pos, tri = random_closed_mesh(seed, 12)
    pos[:, :2] *= (1, 11 / 12)[seed % 2]
    if seed >= 4:  # seen in perspective, partly from within
        pos = clip(pos[:, :3] * 4, 3.0).float()
        pos[:, 2] = 0  # no near or far plane cuts it
    covered, sign = coverage(pos, tri, (12, 12)), faces_front(pos, tri)
    assert covered.sum() > 100
    around = covered[sign > 0].sum(0) - covered[sign < 0].sum(0)  # how often the surface goes around the eye
    assert (around == around[0, 0]).all() and (seed >= 4 or around[0, 0] == 0)


def test_coverage_is_exact() -> None:
    """Beside rational arithmetic, with vertices of which most lie on the lines between centres."""
    n = 8
    corners = torch.randint(-n, n + 1, (40, 3, 2), generator=torch.Generator().manual_seed(1))
    pos = torch.nn.functional.pad(corners.reshape(-1, 2).double() / n, (0, 2), value=0.0)
    pos[:, 3] = 1
    covered = coverage(pos.float(), torch.arange(120).reshape(40, 3), (n, n))
    for t in range(40):
        exact = [(Fraction(int(x), n), Fraction(int(y), n)) for x, y in corners[t].tolist()]
        for j in range(n):
            for i in range(n):
                expected = twin.covers(exact, Fraction(2 * i + 1 - n, n), Fraction(2 * j + 1 - n, n))
                assert bool(covered[t, j, i]) == expected, (t, j, i)
    assert covered.sum() > 100


def test_planes_cut_at_each_pixel() -> None:
    """A floor from behind the eye to beyond the far plane."""
    corners = torch.tensor([[-50.0, -1, 40], [50, -1, 40], [0, -1, -400]], dtype=torch.float64)
    pos = clip(corners, 0.0)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], torch.tensor([[0, 1, 2]]), (64, 64))
    rows = rast[0, :, 32, 3] > 0
    _, y = twin.centers(64, 64)
    distance = np.divide(2.0, -y, where=y < 0, out=np.full(64, np.inf))  # where row y meets the floor one below the eye
    assert torch.equal(rows, torch.from_numpy((distance >= 0.5) & (distance <= 20.0)))
    depth = rast[0, rows, 32, 2]
    assert (depth.diff() > 0).all() and depth.min() >= -1 and depth.max() <= 1


def test_what_shows_nothing() -> None:
    pos = torch.tensor(
        [[0.0, 0, 0, 1], [0.5, 0, 0, 1], [1, 0, 0, 1], [0, 0.5, 0, -1], [0.5, 0.5, 0, -1], [0, 1, 0, -2]]
    )
    for tri in ([[0, 1, 2]], [[0, 0, 1]], [[3, 4, 5]]):  # in a line, of two corners, behind the eye
        rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos[None], torch.tensor(tri), (8, 8))
        assert not rast.any() and not rast_db.any()
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], torch.zeros(0, 3, dtype=torch.int32), (8, 8))
    assert not rast.any() and rast.shape == (1, 8, 8, 4)


def test_nearer_is_smaller_and_the_first_of_equals() -> None:
    square = torch.tensor([[-1.0, -1, 0, 1], [3, -1, 0, 1], [-1, 3, 0, 1]])
    pos = torch.cat([square + square.new_tensor([0, 0, z, 0]) for z in (0.5, -0.5, -0.5)])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], torch.arange(9).reshape(3, 3), (4, 4))
    assert (rast[..., 3] == 2).all() and (rast[..., 2] == -0.5).all()


def test_ranges_are_images_of_their_own() -> None:
    (a, tri_a), (b, tri_b) = random_triangles(5, 8), random_triangles(6, 11)
    ctx = dr.RasterizeCudaContext()
    pos, tri = torch.cat([a, b]), torch.cat([tri_a, tri_b + len(a)])
    ranges = torch.tensor([[8, 11], [0, 8], [3, 2], [0, 0]], dtype=torch.int32)
    rast, rast_db = dr.rasterize(ctx, pos, tri, (10, 12), ranges=ranges)
    for image, (own, own_tri, first) in enumerate([(b, tri_b, 8), (a, tri_a, 0), (a, tri_a[3:5], 3)]):
        alone, alone_db = dr.rasterize(ctx, own[None], own_tri, (10, 12))
        alone[..., 3] += first * (alone[..., 3] > 0)
        assert torch.equal(rast[image], alone[0]) and torch.equal(rast_db[image], alone_db[0])
    assert not rast[3].any()
    attr = torch.rand(len(pos), 5, dtype=torch.float64)
    values, _ = dr.interpolate(attr, rast, tri)
    alone, _ = dr.interpolate(attr[None], rast[:1], tri)
    assert torch.equal(values[:1], alone)


def test_layers_behind_one_another() -> None:
    pos, tri = random_triangles(7, 10)
    behind = None
    with dr.DepthPeeler(dr.RasterizeCudaContext(), pos[None], tri, (8, 8)) as peeler:
        first, _ = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (8, 8))
        for layer in range(4):
            rast, _ = peeler.rasterize_next_layer()
            assert layer > 0 or torch.equal(rast, first)
            expected = twin.rasterize(pos.numpy(), tri.numpy(), (8, 8), behind)
            np.testing.assert_allclose(rast[0].numpy(), expected, rtol=1e-9, atol=1e-10)
            behind = np.where(expected[..., 3] > 0, expected[..., 2], np.inf)  # rounded as the twin does
            assert layer > 2 or (rast[..., 3] > 0).any()
    with pytest.raises(RuntimeError, match="within `with"):
        peeler.rasterize_next_layer()


def test_interpolate_equals_its_definition() -> None:
    pos, tri = random_triangles(8)
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (9, 9))
    attr = torch.rand(1, len(pos), 4, dtype=torch.float64)
    values, da = dr.interpolate(attr, rast, tri, rast_db, [2, 0])
    everything, all_da = dr.interpolate(attr, rast, tri, rast_db, "all")
    hit = rast[..., 3:] > 0
    corners = attr[0][tri[(rast[..., 3].long() - 1).clamp(min=0)]]  # (1, H, W, 3, A)
    u, v = rast[..., 0:1], rast[..., 1:2]
    expected = u * corners[..., 0, :] + v * corners[..., 1, :] + (1 - u - v) * corners[..., 2, :]
    torch.testing.assert_close(values, torch.where(hit, expected, 0))
    by_u, by_v = corners[..., 0, :] - corners[..., 2, :], corners[..., 1, :] - corners[..., 2, :]
    by_x = torch.where(hit, by_u * rast_db[..., 0:1] + by_v * rast_db[..., 2:3], 0)
    by_y = torch.where(hit, by_u * rast_db[..., 1:2] + by_v * rast_db[..., 3:4], 0)
    torch.testing.assert_close(da, torch.stack([by_x[..., 2], by_y[..., 2], by_x[..., 0], by_y[..., 0]], -1))
    torch.testing.assert_close(all_da[..., 0::2], by_x)
    assert torch.equal(everything, values)
    assert dr.interpolate(attr, rast, tri)[1].shape == (1, 9, 9, 0)


@pytest.mark.parametrize("mode", ["instanced", "ranges"])
def test_derivatives_of_rasterize_and_interpolate(mode: str) -> None:
    """All four outputs that have derivatives are used; positions move so little that no centre changes its triangle."""
    pos, tri = random_triangles(9, 4)
    ranges = None
    if mode == "instanced":
        pos = torch.stack([pos, pos.roll(3, 0)])
    else:
        ranges = torch.tensor([[0, 4], [1, 2], [2, 2]])
    pos.requires_grad_()
    attr = torch.rand(*pos.shape[:-1], 2, dtype=torch.float64, requires_grad=True)

    def f(pos: Tensor, attr: Tensor) -> tuple[Tensor, ...]:
        rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (5, 6), ranges=ranges)
        values, da = dr.interpolate(attr, rast, tri, rast_db, "all")
        return rast[..., :2], rast_db, values, da

    assert f(pos, attr)[0].any()
    assert torch.autograd.gradcheck(f, (pos, attr), eps=1e-7, atol=1e-5)


def test_attributes_of_all_images() -> None:
    """(1, V, A) gets the sum of what images say."""
    pos, tri = random_triangles(10, 6)
    pos = torch.stack([pos, pos.flip(0), pos.roll(6, 0)])
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (7, 7))
    attr = torch.rand(1, pos.shape[1], 3, dtype=torch.float64, requires_grad=True)
    weight = torch.rand(3, 7, 7, 3, dtype=torch.float64)
    (dr.interpolate(attr, rast, tri)[0] * weight).sum().backward()
    each = attr.detach().expand(3, -1, -1).clone().requires_grad_()
    (dr.interpolate(each, rast, tri)[0] * weight).sum().backward()
    torch.testing.assert_close(attr.grad, each.grad.sum(0, keepdim=True))


def test_gradients_of_derivatives_can_stay_out() -> None:
    pos, tri = random_triangles(11, 4)
    pos = pos[None].requires_grad_()
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (6, 6), grad_db=False)
    (grad,) = torch.autograd.grad(rast_db.sum() + rast[..., 0].sum(), pos)
    rast, rast_db = dr.rasterize(dr.RasterizeGLContext(output_db=False), pos, tri, (6, 6))
    assert rast_db.shape == (1, 6, 6, 0)
    assert torch.equal(grad, torch.autograd.grad(rast[..., 0].sum(), pos)[0])
    assert not grad[..., 2].any() and grad.any()


def test_same_bits_at_any_number_of_threads() -> None:
    pos, tri = random_triangles(12, 60)
    attr = torch.linspace(0, 1, 3 * len(pos)).reshape(1, -1, 3).requires_grad_()
    for given in (pos.float()[None], torch.stack([pos, pos.roll(3, 0), pos.flip(0)]).float()):
        given.requires_grad_()

        def compute(given: Tensor = given) -> list[Tensor]:
            rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), given, tri, (33, 40))
            values, da = dr.interpolate(attr, rast, tri, rast_db, [1])
            image = dr.antialias(torch.cat([values, da], 3), rast, given, tri)
            loss = (image * torch.linspace(0, 1, image.numel()).view_as(image)).sum()
            return [rast, rast_db, image, *torch.autograd.grad(loss, [given, attr])]

        check_threads(compute)


@pytest.mark.parametrize(
    "change, error, words",
    [
        ({"ctx": None}, TypeError, "ctx: expected a RasterizeCudaContext or RasterizeGLContext"),
        ({"pos": torch.zeros(3, 4)}, ValueError, "ranges: expected .* use pos\\[None\\]"),
        ({"pos": torch.zeros(1, 3, 3)}, ValueError, "pos: expected shape"),
        ({"pos": torch.full((1, 3, 4), torch.nan)}, ValueError, "pos: expected finite"),
        ({"tri": torch.tensor([[0, 1, 3]])}, ValueError, "tri: expected indices from 0 to 2"),
        ({"tri": torch.tensor([[0.0, 1, 2]])}, TypeError, "tri: expected an integer"),
        ({"resolution": (8,)}, ValueError, "resolution: expected \\(height, width\\)"),
        ({"resolution": (8, 0)}, ValueError, "resolution: expected a height"),
        ({"resolution": 8}, ValueError, "resolution: expected \\(height, width\\), got 8"),
        ({"pos": torch.ones(1, 3, 4, device="meta")}, ValueError, "pos: "),
        (
            {"pos": torch.full((1, 3, 4), 1e-120, dtype=torch.float64)},
            ValueError,
            "pos: expected numbers of which some",
        ),
        ({"pos": torch.zeros(3, 4), "ranges": torch.tensor([[2**32, 1]])}, ValueError, "ranges: .*4294967296"),
        ({"pos": torch.zeros(3, 4), "ranges": torch.tensor([[0, 2]])}, ValueError, "ranges: expected a first triangle"),
        ({"pos": torch.zeros(3, 4), "ranges": torch.tensor([0, 1])}, ValueError, "ranges: expected shape"),
    ],
)
def test_wrong_arguments(change: dict[str, object], error: type[Exception], words: str) -> None:
    given = {
        "ctx": dr.RasterizeCudaContext(),
        "pos": torch.ones(1, 3, 4),
        "tri": torch.tensor([[0, 1, 2]]),
        "resolution": (8, 8),
    }
    with pytest.raises(error, match=words):
        dr.rasterize(**(given | change))  # pyright: ignore[reportArgumentType]


def test_levels_of_a_log_that_is_empty() -> None:
    before = dr.get_log_level()
    dr.set_log_level(2)
    assert dr.get_log_level() == 2
    dr.set_log_level(before)


def test_wrong_attributes() -> None:
    pos, tri = random_triangles(13, 2)
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos[None], tri, (4, 4))
    for attr, more, words in (
        (torch.ones(2, 6, 3), {}, "attr: expected shape"),
        (torch.ones(5, 3), {}, "tri: expected indices from 0 to 4"),
        (torch.ones(6, 3), {"rast_db": rast_db, "diff_attrs": [3]}, "diff_attrs: expected numbers from 0 to 2"),
        (torch.ones(6, 3), {"rast_db": rast_db, "diff_attrs": "both"}, "diff_attrs: expected numbers .* or 'all'"),
        (torch.ones(6, 3), {"rast_db": rast_db[:, 1:]}, "rast_db: expected shape"),
        (torch.ones(6, 3), {"rast_db": rast_db[..., :0], "diff_attrs": "all"}, "rast_db: .* output_db=True"),
    ):
        with pytest.raises(ValueError, match=words):
            dr.interpolate(attr, rast, tri, **more)
    with pytest.raises(TypeError, match=r"diff_attrs: expected .* use \[1\]"):
        dr.interpolate(torch.ones(6, 3), rast, tri, rast_db, 1)  # pyright: ignore[reportArgumentType]
    assert dr.interpolate(torch.ones(6, 3), rast, tri, rast_db[..., :0])[1].shape == (1, 4, 4, 0)
    with pytest.raises(
        ValueError, match=r"rast: expected numbers of triangles from 1 to 2, or 0, .* at \[0, 0, 0, 3\]"
    ):
        dr.interpolate(torch.ones(6, 3), rast + 7, tri)
    with pytest.raises(ValueError, match="mode: expected"):
        dr.RasterizeGLContext(mode="fast")
    assert dr.RasterizeCudaContext("cpu").output_db and not dr.RasterizeGLContext(False, device="cpu").output_db
