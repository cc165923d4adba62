"""Borders between nearest texels of lights, by what they light: against irradiances of polygons in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from lit_scenes import F64, grid, hits_of, plane, polygon_irradiance, vector
from oracles.shading import radiance, reference
from torch import Tensor

import edgegrad as eg
from edgegrad.light.radiance import declare_texel_edges
from edgegrad.scene import texel_edges
from edgegrad.scene.lights import LightPoints
from edgegrad.scene.mesh_light import MeshLight

SQUARE = torch.tensor([[-1, -0.8, 2], [1, -0.8, 2], [1.1, 0.8, 2.2], [-1, 0.8, 2.2]], dtype=F64)
FACES = torch.tensor([[0, 2, 1], [0, 3, 2]])  # seen from below
TEXELS = torch.rand((5, 4, 3), dtype=F64, generator=torch.Generator().manual_seed(2))
FACTOR = vector(2.0, 1.0, 3.0)
ALBEDO = 0.7
# Askew, beyond the border of the texture, and with a border of texels along an edge of the mesh and along the diagonal.
COORDINATES = {
    "askew": torch.tensor([[0.1, 0.2], [1.3, -0.2], [1.6, 0.9], [-0.1, 1.1]], dtype=F64),
    "along an edge": torch.tensor([[0.25, 0.1], [1.1, 0.3], [0.9, 1.3], [0.25, 0.8]], dtype=F64),
    "along the diagonal": torch.tensor([[0.5, 0.1], [1.1, 0.3], [0.5, 1.1], [-0.2, 0.8]], dtype=F64),
}


def wrapped(i: int, n: int, wrap: str) -> int:
    if wrap == "clamp":
        return min(max(i, 0), n - 1)
    period = 2 * n if wrap == "mirror" else n
    return min(i % period, period - 1 - i % period) if wrap == "mirror" else i % n


def clipped(polygon: Tensor, height: Tensor) -> Tensor:
    """The part of a convex polygon (n, 3) where a function that is linear on it, `height` at its corners, is positive."""
    kept = []
    for k in range(len(polygon)):
        p, q, at_p, at_q = polygon[k - 1], polygon[k], float(height[k - 1]), float(height[k])
        if (at_p > 0) != (at_q > 0):
            kept.append(p + at_p / (at_p - at_q) * (q - p))
        if at_q > 0:
            kept.append(q)
    return torch.stack(kept) if kept else polygon[:0]


def irradiance(uvs: Tensor, wraps: tuple[str, str], place: Tensor) -> Tensor:
    """(3,) at a place of z = 0 from the square: the sum over its texels."""
    h, w = TEXELS.shape[:2]
    total = torch.zeros(3, dtype=F64)
    for face in FACES:
        p = torch.stack([uvs[face, 0] * w, (1 - uvs[face, 1]) * h], 1)  # in texels, at the corners
        low, high = p.amin(0).floor().int().tolist(), p.amax(0).ceil().int().tolist()
        for i in range(low[0], high[0]):
            for j in range(low[1], high[1]):
                b = torch.eye(3, dtype=F64)
                for axis, cell in enumerate((i, j)):
                    b = clipped(b, b @ p[:, axis] - cell)
                    b = clipped(b, cell + 1 - b @ p[:, axis])
                if len(b) > 2:
                    texel = TEXELS[wrapped(j, h, wraps[1]), wrapped(i, w, wraps[0])] * FACTOR
                    total += texel * polygon_irradiance(b @ SQUARE[face], place, vector(0, 0, 1)).abs()
    return total


def derivative(uvs: Tensor, wraps: tuple[str, str], place: Tensor, weights: Tensor) -> Tensor:
    """(4, 2) of the weighted irradiance, a central difference: where a border lies on an edge, the mean of both sides."""
    h, found = 1e-5, torch.zeros(8, dtype=F64)
    for k in range(8):
        step = torch.zeros(8, dtype=F64).index_fill(0, torch.tensor(k), h).reshape(4, 2)
        found[k] = weights @ (irradiance(uvs + step, wraps, place) - irradiance(uvs - step, wraps, place)) / (2 * h)
    return found.reshape(4, 2)


def scene(uvs: Tensor, wraps: tuple[str, str] = ("repeat", "repeat"), *others: eg.Mesh) -> eg.Scene:
    emission = eg.Texture(TEXELS, wrap=wraps, filter="nearest", factor=FACTOR)
    emitter = eg.Mesh(SQUARE, FACES, uvs=uvs, uv_faces=FACES, material=eg.Material(0.0, emission=emission))
    return eg.Scene([plane(4.0, material=eg.Material(ALBEDO)), emitter, *others])


def by_borders(uvs: Tensor, wraps: tuple[str, str], place: Tensor, weights: Tensor) -> Tensor:
    """(4, 2): the same by the borders that points are drawn from, integrated along each of them by the midpoint rule."""
    uvs = uvs.clone().requires_grad_()
    light = MeshLight(scene(uvs, wraps).meshes[1])
    borders, n = light.texel_edges((0.5, 0.5)), 40
    assert borders is not None
    measure = borders.running.diff(prepend=torch.zeros(1, dtype=F64)) / borders.running[-1]
    along = (torch.arange(n, dtype=F64) + 0.5) / n
    points = borders.draw(
        torch.stack(
            [(borders.running / borders.running[-1] - measure / 2).repeat_interleave(n), along.repeat(len(measure))], 1
        )
    )
    towards = light.place(LightPoints(points.face, points.b[:, 1:], points.b[:, 0])) - place
    facing = light.facing(points.face, points.b, place) * (towards[:, 2:] / towards.norm(dim=1, keepdim=True))
    reaches = (facing[:, 0] * (points.weight @ weights) * measure.repeat_interleave(n) / n).detach()
    return torch.autograd.grad((reaches * borders.motion(points)[:, 0]).sum(), uvs)[0]


ASIDE = vector(1.0, 0.0, 0.3)  # from where places are seen, below the light
WEIGHTS = vector(1.0, -0.3, 0.5)
PLACE = vector(0.3, -0.2, 0.0)


WRAPS = [("repeat", "mirror"), ("clamp", "repeat"), ("mirror", "clamp")]


@pytest.mark.parametrize(
    ("coordinates", "wraps"),
    [
        pytest.param(name, wraps, marks=[] if (j - k) % 3 == 0 else [pytest.mark.slow])
        for j, name in enumerate(COORDINATES)
        for k, wraps in enumerate(WRAPS)
    ],
)
def test_texture_coordinates_of_an_emitter(coordinates: str, wraps: tuple[str, str]) -> None:
    uvs = COORDINATES[coordinates]
    exact = derivative(uvs, wraps, PLACE, WEIGHTS)
    assert torch.allclose(
        by_borders(uvs, wraps, PLACE, WEIGHTS), exact, rtol=1e-3, atol=1e-3 * float(exact.abs().max())
    )


def test_radiance_itself_stays() -> None:
    """Borders add zero, and there are none where nothing moves."""
    uvs = COORDINATES["askew"]
    hits = [hits_of(scene(u), 50, PLACE, ASIDE) for u in (uvs, uvs.clone().requires_grad_())]
    still, moving = map(radiance, hits)
    assert not still.requires_grad
    assert torch.equal(still, moving)


def test_an_emitter_in_shadow_and_its_back() -> None:
    uvs = COORDINATES["askew"].clone().requires_grad_()
    blocked = scene(uvs, ("repeat", "repeat"), plane(3.0).transformed(t=vector(0, 0, 1.5)))
    hits = hits_of(blocked, 50, PLACE, ASIDE)
    for shadows in (True, False):
        (found,) = torch.autograd.grad(radiance(hits, shadows).sum(), uvs)
        assert bool(found.any()) != shadows
    turned = scene(uvs)
    emitter = turned.meshes[1].replace(faces=FACES.flip(1), uv_faces=FACES.flip(1), material=eg.Material(
        0.0, emission=eg.Texture(TEXELS, filter="nearest"), two_sided=False
    ))  # fmt: skip
    hits = hits_of(turned.replace(meshes=[turned.meshes[0], emitter]), 50, PLACE, ASIDE)
    assert not bool(radiance(hits).any())
    (found,) = torch.autograd.grad(radiance(hits).sum(), uvs)
    assert not bool(found.any())


def test_borders_that_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there are too many, a number picks some. The mean over that number is what all give."""
    mesh = scene(COORDINATES["askew"]).meshes[1]
    assert mesh.material is not None
    texture = mesh.material.emission
    assert isinstance(texture, eg.Texture)
    area = torch.tensor([1.0, 2.0])

    def sums(*u: float) -> Tensor:
        """The measure, and its moments by barycentrics and axis."""
        found = texel_edges.TexelEdges.from_mesh(mesh, texture, area, u)
        assert found is not None
        measure = found.running.diff(prepend=torch.zeros(1, dtype=F64))
        middle = (found.begin + found.end) / 2
        columns = [torch.ones(len(measure)), *middle.T, found.axis.double(), found.face.double(), *found.jump.T]
        return torch.stack([(measure * column).sum() for column in columns])

    exact = sums(0.0, 0.0)
    for most_lines, most_segments in ((7, 1 << 18), (1 << 17, 11), (9, 13)):
        monkeypatch.setattr(texel_edges, "MOST_LINES", most_lines)
        monkeypatch.setattr(texel_edges, "MOST_SEGMENTS", most_segments)
        numbers = torch.rand((250, 2), generator=torch.Generator().manual_seed(1)).tolist()
        some = torch.stack([sums(*u) for u in numbers])
        error = some.std(0) / len(some) ** 0.5
        assert 0 < float(error[0]) < 0.02 * float(exact[0])
        assert bool(((some.mean(0) - exact).abs() < 4 * error + 1e-9).all()), (some.mean(0), exact, error)


def test_a_texture_of_one_colour_has_no_borders() -> None:
    mesh = scene(COORDINATES["askew"]).meshes[1]
    assert mesh.material is not None
    plain = mesh.replace(material=mesh.material.replace(emission=eg.Texture(TEXELS[:1, :1], filter="nearest")))
    assert MeshLight(plain).texel_edges((0.5, 0.5)) is None


@pytest.mark.slow
def test_images_in_reverse_and_forward_mode() -> None:
    """The kernel shades the floor alone; the exact derivative is that of a fine grid of points."""
    wraps, uvs, motion = ("repeat", "repeat"), COORDINATES["askew"], torch.tensor([0.7, -0.7], dtype=F64)
    # Below the light, one above the floor, of which it sees a square with sides of 1.
    w2c = torch.tensor([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1], [0, 0, 0, 1]], dtype=F64)
    camera = eg.Camera(w2c, torch.tensor([[3, 0, 1.5], [0, 3, 1.5], [0, 0, 1]], dtype=F64), (3, 3))
    weights = torch.linspace(0.2, 1.0, 9, dtype=F64).reshape(3, 3, 1) * WEIGHTS

    def on_floor(h: float) -> float:
        rows = zip(grid(3, 1.0, 1).reshape(9, 3), weights.reshape(9, 3), strict=True)
        return sum(float(irradiance(uvs + h * motion, wraps, y) @ weight) for y, weight in rows) * ALBEDO / torch.pi

    exact = (on_floor(1e-5) - on_floor(-1e-5)) / 2e-5

    def loss(theta: Tensor, seed: int) -> Tensor:
        image = eg.render(
            scene(uvs + theta * motion, wraps), camera, 4, seed=seed, sampling=eg.Sampling(surface=400, lights=12)
        )
        return (image * weights).sum()

    theta, seeds = torch.zeros((), dtype=F64), range(32)
    reverse = []
    for seed in seeds:
        leaf = theta.clone().requires_grad_()
        reverse.append(float(torch.autograd.grad(loss(leaf, seed), leaf)[0]))
    error = float(np.std(reverse)) / len(reverse) ** 0.5
    assert error < 0.012 * abs(exact)
    # Of the grid of one point a pixel: 0.4 % at most, the next finer one tells.
    assert abs(np.mean(reverse) - exact) < 4 * error + 0.004 * abs(exact), (np.mean(reverse), exact, error)
    forward = torch.func.jvp(lambda t: loss(t, 0), (theta,), (torch.ones((), dtype=F64),))[1]
    assert abs(float(forward) - reverse[0]) < 1e-6 * abs(reverse[0])


def test_texture_coordinates_in_single_precision() -> None:
    """The scene in float32 has the same derivative."""
    camera = eg.Camera.look_at((0.3, -2.0, 1.0), PLACE.tolist(), fov_y=30.0, size=(4, 4)).to(F64)

    def gradient(dtype: torch.dtype) -> Tensor:
        uvs = COORDINATES["askew"].to(dtype).requires_grad_()
        lit = scene(COORDINATES["askew"]).to(dtype)
        floor, emitter = lit.meshes
        image = eg.render(lit.replace(meshes=[floor, emitter.replace(uvs=uvs)]), camera.to(dtype), 4, seed=0)
        assert image.dtype == dtype
        return torch.autograd.grad(image.sum(), uvs)[0]

    exact = gradient(F64)
    assert bool(exact.any())
    torch.testing.assert_close(gradient(torch.float32).double(), exact, rtol=1e-3, atol=1e-3 * float(exact.abs().max()))


def test_texel_edges_are_declared_as_shading_looks_them_up() -> None:
    """declare_texel_edges() alone declares them in the same order."""
    draw = torch.Generator().manual_seed(5)

    def nearest(channels: int) -> eg.Texture:
        return eg.Texture(0.2 + 0.6 * torch.rand((3, 4, channels), generator=draw, dtype=F64), filter="nearest")

    material = eg.Material(nearest(3), nearest(1), nearest(1), emission=nearest(3), normal_map=nearest(3))
    painted = plane(1.0, texture=TEXELS, filter="nearest", material=material)
    smooth = plane(3.0, texture=TEXELS, material=eg.Material(nearest(3))).transformed(t=vector(0, 0, -1))
    lit = eg.Scene([painted, smooth], lights=[eg.lights.PointLight(vector(0, 0, 2), 5.0)])
    place = torch.rand((60, 3), dtype=F64, generator=draw) * vector(4, 4, 0) - vector(2, 2, -1)
    whole, alone = (eg.points.trace(lit, place, vector(0, 0, -1)) for _ in range(2))
    reference(whole)
    declare_texel_edges(alone)
    assert whole._discontinuities.kinds == alone._discontinuities.kinds == ["floor"] * 14
    for a, b in zip(whole._discontinuities.values, alone._discontinuities.values, strict=True):
        assert torch.equal(a.isnan(), b.isnan())
        assert torch.equal(a.nan_to_num(), b.nan_to_num())


def test_an_emitter_that_is_masked_gives_no_light_there() -> None:
    """The kernel and PyTorch give the light of the half that is left, masked or blended, in closed form."""
    alpha = torch.tensor([[0.2, 0.9]])
    uvs = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)
    left = (SQUARE[[1, 2]] + SQUARE[[0, 3]]) / 2
    exact = float(
        polygon_irradiance(torch.stack([left[0], SQUARE[1], SQUARE[2], left[1]]), PLACE, vector(0, 0, 1)).abs()
    )
    camera = eg.Camera.look_at((0.3, -2.0, 1.0), PLACE.tolist(), fov_y=2.0, size=(1, 1))
    for mode in ("MASK", "BLEND"):
        glow = eg.Material(0.0, emission=1.0, alpha_mode=mode)
        emitter = eg.Mesh(SQUARE, FACES, uvs=uvs, uv_faces=FACES, alpha=alpha, filter="nearest", material=glow)
        lit = eg.Scene([plane(4.0, material=eg.Material(torch.pi * vector(1, 1, 1) / 4)), emitter])
        with torch.no_grad():
            found = [
                torch.stack([eg.render(lit, camera, 1024, seed=s, sampling=eg.Sampling(lights=16)) for s in range(4)]),
                reference(hits_of(lit, 20_000, PLACE, ASIDE)),
            ]
        for values in found:
            assert abs(4 * float(values.mean()) - exact) < 0.02 * exact, (mode, values.mean(), exact)
