"""Paths of light that is scattered more than once: what the kernel makes of them, and its derivatives, against PyTorch's."""

from __future__ import annotations

from typing import NamedTuple

import pytest
import torch
from combinations import diagonal
from kernel_parts import parts
from lit_words import CAMERAS, Leaves, cotangents, numbers_of, scene_of
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel
from edgegrad.light.at_points import LitOptions
from edgegrad.light.bsdf import dot, terminator
from edgegrad.light.shaded_points import ShadedPoints, on_mesh
from edgegrad.points.hits import Hits
from edgegrad.points.image_context import ImageContext
from edgegrad.scene.lights import LightPoints, SphericalHarmonics

F64 = torch.float64
SCENES = [
    "colors directional",
    "face_colors spot one_sided harmonics",
    "normals normal_map texture point sky",
    "microfacets normals environment",
    "area microfacets base",
    "bulb normals microfacets normal_map texture",
    "mipmap texture normal_map normals microfacets base emission point directional spot harmonics environment area",
]
BOUNCES = [2, 3, 4]
FEW = 30  # points of the image


def numbers(words: str) -> Leaves:
    """Return the numbers of lit_words.py, and those of glossy walls around, so that light goes to and fro."""
    corner = [(-2.0, -2.0), (2.0, -2.0), (2.0, 4.5), (-2.0, 4.5)]
    wall = [[x, y, z] for y in (-1.2, 3.0) for x, z in corner]
    own = {"wall": wall, "wall_color": [0.8, 0.3, 0.5], "wall_roughness": 0.5, "wall_metallic": 0.6}
    return numbers_of(words) | {name: torch.tensor(value, dtype=F64) for name, value in own.items()}


def room(words: str, n: Leaves) -> eg.Scene:
    scene = scene_of(words, n)
    material = eg.Material(n["wall_color"], roughness=n["wall_roughness"], metallic=n["wall_metallic"])
    faces = [[i, (i + 1) % 4, 4 + i] for i in range(4)] + [[(i + 1) % 4, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    wall = eg.Mesh(n["wall"], torch.tensor(faces), material=material)
    return scene.replace(meshes=[*scene.meshes, wall])


def hits_of(scene: eg.Scene, camera: eg.Camera) -> Hits:
    """Few of those that an image of the scene has."""
    frame = ImageContext(scene, make_request(scene, camera, 1, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 40)
    some = torch.arange(0, len(found.face), max(1, len(found.face) // FEW))
    seed = frame.seeds("image", len(found.face))[some]
    return frame.moving_hits(found.face[some], frame.sampler.rays_at(found.x[some]), found.x[some], seed)


class Point(NamedTuple):
    """One of a path."""

    surface: ShadedPoints
    doubled_area: Tensor  # (1, 1) of its face


class Oracle:
    """Paths in float64 by PyTorch, point by point.

    It is the recursion of csrc/shading/lit/path_radiance.h by the surfaces, materials and lights of edgegrad/light. Textures of
    points that no pixel sees are those of `unfiltered`, hits of the same scene.
    """

    def __init__(self, hits: Hits, unfiltered: Hits, bounces: int) -> None:
        self._hits, self._unfiltered = hits, unfiltered
        at, tensors = in_kernel._at(hits)
        options = LitOptions(shadows=True, samples=1, bounces=bounces)
        found = parts.paths(at.kernel(tensors), **at.arguments(tensors, options))
        self.paths = {name: torch.from_numpy(value) for name, value in found.items()}

    def radiance(self) -> Tensor:
        rows = []
        for i in range(len(self._hits)):
            points = self._points(i)
            total = torch.zeros(1, 3, dtype=F64)
            for k in range(len(points) - 1, -1, -1):
                if k + 1 < len(points):
                    total = total * self._step(points[k], points[k + 1]) / self.paths["pdf"][i, k + 1]
                if k > 0:
                    total = total + self._direct(points[k].surface, i, k)
            rows.append(total)
        return torch.cat(rows)

    def _points(self, i: int) -> list[Point]:
        found: list[Point] = []
        for k in range(int(self.paths["points"][i])):
            face, b = self.paths["face"][i, k][None], self.paths["b"][i, k][None]
            if k == 0:
                hits = self._hits._subset(slice(i, i + 1))
            else:
                hits = Hits(self._unfiltered._surfaces, self._hits._view, face, b)
                hits.__dict__["view"] = normalize(found[-1].surface.position - hits.position, dim=1)
            at = on_mesh(hits, int(hits._surfaces.mesh_of_face[face]))
            assert at.mesh.material is not None
            corner = hits._surfaces.corners(face)
            area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(
                dim=1, keepdim=True
            )
            found.append(Point(ShadedPoints.from_hits(hits, at, at.mesh.material), area))
        return found

    @staticmethod
    def _step(here: Point, next: Point) -> Tensor:
        o, d = here.surface, next.surface.position - here.surface.position
        l = normalize(d, dim=1)
        f = o.scattering.evaluate(o.v, o.n, l) * dot(o.n, l) * (1 if o.flat else terminator(o.g, o.n, l))
        return f * next.doubled_area * dot(next.surface.g, l).abs() / dot(d, d)

    def _direct(self, o: ShadedPoints, i: int, k: int) -> Tensor:
        scene = self._hits._surfaces.scene
        total = torch.zeros(1, 3, dtype=F64)
        for light in scene.lights:
            if isinstance(light, SphericalHarmonics):
                total = total + o.scattering.diffuse / torch.pi * light.irradiance(o.n)
        for number, light in enumerate(scene.casting):
            if self.paths["seen"][i, k, number] <= 0:
                continue
            index, uv, density = (self.paths[name][i, k, number][None] for name in ("index", "uv", "light_pdf"))
            points = LightPoints(index, uv, density)
            l = light.incident(points, o.position)
            f = o.scattering.evaluate(o.v, o.n, l) * dot(o.n, l) * (1 if o.flat else terminator(o.g, o.n, l))
            total = total + f * light.arriving(points, o.position)
        return total


@pytest.mark.watched
@pytest.mark.parametrize(("words", "bounces"), diagonal(SCENES, BOUNCES))
def test_values_and_cotangents(words: str, bounces: int) -> None:
    leaves = {name: value.clone().requires_grad_() for name, value in numbers(words).items()}
    w2c = CAMERAS["perspective"].world_to_camera.double().clone().requires_grad_()
    camera = CAMERAS["perspective"].replace(world_to_camera=w2c)
    hits, found = (hits_of(room(words, leaves), camera) for _ in range(2))
    unfiltered = hits_of(room(words.replace("mipmap ", ""), leaves), camera)
    oracle = Oracle(hits, unfiltered, bounces)
    expected, radiance = oracle.radiance(), in_kernel.indirect(found, True, bounces)
    assert int(oracle.paths["points"].max()) == bounces and float(expected.detach().abs().max()) > 0.01
    assert torch.allclose(radiance, expected, rtol=1e-10, atol=1e-12)
    tensors = {**leaves, "w2c": w2c}
    for name, a, b in zip(tensors, cotangents(expected, tensors), cotangents(radiance, tensors), strict=True):
        assert float((a - b).abs().max()) <= 1e-9 * float(a.abs().max()) + 1e-13, name
        assert float(a.abs().max()) > 0 or name not in ("ground", "ground_color", "wall", "wall_color", "w2c"), name


@pytest.mark.watched
@pytest.mark.parametrize(("words", "bounces"), diagonal(SCENES, BOUNCES))
def test_tangents_are_cotangents(words: str, bounces: int) -> None:
    values = {**numbers(words), "w2c": CAMERAS["perspective"].world_to_camera.double()}
    draw = torch.Generator().manual_seed(3)
    tangents = {name: torch.randn(v.shape, dtype=F64, generator=draw) for name, v in values.items()}

    def radiance(given: Leaves) -> Tensor:
        camera = CAMERAS["perspective"].replace(world_to_camera=given["w2c"])
        return in_kernel.indirect(hits_of(room(words, given), camera), True, bounces)

    found, moved = torch.func.jvp(radiance, (values,), (tangents,))[:2]
    bar = torch.randn(found.shape, dtype=F64, generator=draw)
    (grads,) = torch.func.vjp(radiance, values)[1](bar)
    forward = float((bar * moved).sum())
    products = torch.stack([(grads[name] * tangents[name]).sum() for name in values])
    assert abs(forward - float(products.sum())) < 1e-10 * float(products.abs().sum())
