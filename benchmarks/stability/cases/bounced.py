"""Indirect light in scenes whose image is known: through a hole, in closed rooms, off a mirror, past a block on the lit floor,
past a million faces.

The radiance L of a sunlit plate is the same everywhere and in all directions, so the irradiance of another surface by it is

    E(y) = L ∫ cos θ dω over the part of the plate that y sees,

which has a closed form for polygons (Lambert 1760) and spheres. Objects between are black. Pixels are integrals of E by
Gauss–Legendre quadrature: nothing is drawn at random.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.sampling import Sampling
from edgegrad.scene.lights import DirectionalLight, PointLight
from edgegrad.scene.material import Material
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import cube, icosphere
from .camera import vector
from .case import F64, Group, Parts, Problem, View

group = Group("bounces")

QUAD = torch.tensor([[0, 1, 2], [0, 2, 3]])
SIDES = torch.tensor([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])  # of cube()
WALL, FLOOR = vector(0.8, 0.6, 0.4), vector(0.5, 0.7, 0.9)  # base colours of what is seen, and of what lights it


# -- irradiance ------------------------------------------------------------------------------------------------


def gauss(fine: int) -> tuple[Tensor, Tensor]:
    """Return Gauss–Legendre points in [0, 1] and their weights, which sum to 1."""
    at, share = (torch.from_numpy(x) / 2 for x in np.polynomial.legendre.leggauss(fine))
    return at + 0.5, share


def seen(camera: Camera, place: Tensor, normal: Tensor, fine: int = 4) -> tuple[Tensor, Tensor]:
    """Return points (H · W · fine², 3) of a plane that fills the view, fine² a pixel, and their weights (fine²,)."""
    H, W = camera.size
    at, share = gauss(fine)
    y, x = ((torch.arange(n)[:, None] + at).reshape(-1) for n in (H, W))
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    places = places.reshape(H, fine, W, fine, 2).transpose(1, 2).reshape(-1, 2)
    ray = torch.linalg.solve(camera.K, torch.cat([places, torch.ones_like(places[:, :1])], 1).mT).mT
    ray, eye = ray @ camera.world_to_camera[:3, :3], camera.eye
    return eye + ((place - eye) @ normal / (ray @ normal))[:, None] * ray, (share[:, None] * share).reshape(-1)


def pixels(camera: Camera, radiance: Tensor, weights: Tensor) -> Tensor:
    """Return the image (H, W, C) from the radiance (N, C) of such points."""
    return (radiance.reshape(*camera.size, len(weights), -1) * weights[:, None]).sum(2)


def cosines(y: Tensor, n: Tensor, polygon: Tensor) -> Tensor:
    """Return ∫ cos θ dω (N,) over plane polygons (K, 3) or (N, K, 3) above the horizon of y (N, 3), whose normal is n (3,).

    It is half the sum of the angles of the sides, each times the cosine of its plane. Corners may repeat.
    """
    u = normalize(polygon - y[:, None], dim=-1)
    v = u.roll(-1, 1)
    across = torch.linalg.cross(u, v)
    squared = (across * across).sum(-1)
    sine = torch.where(squared > 1e-28, squared, 1.0).sqrt()
    ratio = torch.where(squared > 1e-28, torch.atan2(sine, (u * v).sum(-1)) / sine, 1.0)
    return 0.5 * (ratio * (across @ n)).sum(1).abs()


def clipped(y: Tensor, polygon: Tensor, window: Tensor) -> tuple[Tensor, Tensor]:
    """Return the part (N, 16 K, 3) of a convex polygon (K, 3) that points y (N, 3) see in front of another one (4, 3).

    Corners of the part repeat. The second result (N,) tells whether there is any. The polygon is clipped (Sutherland and Hodgman
    1974) by the planes through y and the sides of the window.
    """
    found, some = polygon.expand(len(y), *polygon.shape), torch.ones(len(y), dtype=torch.bool)
    for a, b in zip(window, window.roll(-1, 0), strict=True):
        plane = torch.linalg.cross(a - y, b - y)
        plane = plane * (plane * (window.mean(0) - y)).sum(1, keepdim=True).sign()
        side = ((found - y[:, None]) * plane[:, None]).sum(-1)
        next_side, inside = side.roll(-1, 1), side >= 0
        crosses = inside != (next_side >= 0)
        share = side / torch.where(crosses, side - next_side, 1.0)
        crossing = found + torch.where(crosses, share, 0.0)[..., None] * (found.roll(-1, 1) - found)
        corners, there = torch.stack([found, crossing], 2).flatten(1, 2), torch.stack([inside, crosses], 2).flatten(1)
        # What is not there takes the corner before it.
        row = torch.where(there, torch.arange(there.shape[1]), -1).cummax(1).values
        row = torch.where(row < 0, row[:, -1:], row)
        some, row = some & (row[:, 0] >= 0), row.clamp(min=0)
        found = corners.gather(1, row[..., None].expand(-1, -1, 3))
    return found, some


# -- scenes -------------------------------------------------------------------------------------------------------------


def plate(corners: list[list[float]], color: Tensor, **look: Any) -> Mesh:
    return Mesh(torch.tensor(corners, dtype=F64), QUAD, material=Material(color, **look))


def black(verts: Tensor, faces: Tensor) -> Mesh:
    return Mesh(verts, faces, colors=torch.zeros_like(verts))


def view(eye: Tensor, target: Tensor, fov: float, size: int) -> Camera:
    return Camera.look_at(eye, target, vector(0.0, 0.1, 1.0), fov, (size, size)).to(F64)


def problem(parts: Parts, make: Any, exact: Any, size: int = 8, **fields: Any) -> Problem:
    """Return a problem whose loss is nearly the mean of the image."""
    y, x = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")
    weights = (1.0 + 0.3 * torch.sin(3.0 * x + 2.0 * y)).double()[..., None].expand(-1, -1, 3)
    return Problem(parts, make, exact, "closed form", adjoint=weights, **fields)


ROOMS = 1.5, 1.0  # the length of each, and half of their width and height
LIGHT_AT = vector(0.3, 0.7, 0.8)  # what it sends through the hole itself ends on black walls


def hole(half: float, roughness: float | None, size: int, fine: int, spp: int, samples: dict[str, Any]) -> Problem:
    """Two closed rooms, black but for the walls at their far ends, and a wall between them with a square hole. A point light in
    one lights its far wall; the camera sees the other's."""
    length, width = ROOMS
    ring = torch.tensor([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]], dtype=F64)
    around = [[x, y, z] for x in (-length, length) for y, z in (width * ring).tolist()]
    sides = torch.tensor(
        [[i, (i + 1) % 4, 4 + (i + 1) % 4] for i in range(4)] + [[i, 4 + (i + 1) % 4, 4 + i] for i in range(4)]
    )
    walls = [[[x, y, z] for y, z in (width * ring).tolist()] for x in (-length, length)]
    camera = view(vector(-0.1, 0.0, 0.1), vector(-length, 0.05, 0.0), 40.0 if roughness is None else 24.0, size)
    parts: Parts = {
        "hole": torch.zeros((4, 2), dtype=F64), "light": LIGHT_AT, "brightness": vector(10.0),
        "colour of the lit wall": FLOOR, "colour of the seen wall": WALL,
    }  # fmt: skip

    def opening(parts: Parts) -> Tensor:
        across = half * ring + parts["hole"] + vector(0.1, 0.05)
        return torch.cat([torch.zeros_like(across[:, :1]), across], 1)

    def make(parts: Parts) -> View:
        look = {} if roughness is None else {"metallic": 1.0, "roughness": roughness}
        seen_wall = plate(walls[0], parts["colour of the seen wall"], **look)
        border = torch.cat([torch.zeros((4, 1), dtype=F64), width * ring], 1)
        between = black(torch.cat([border, opening(parts)]), sides)
        meshes = [seen_wall, plate(walls[1], parts["colour of the lit wall"]), between]
        meshes.append(black(torch.tensor(around, dtype=F64), sides))
        return Scene(meshes, lights=[PointLight(parts["light"], parts["brightness"])]), camera

    def exact(parts: Parts) -> Tensor:
        normal = vector(1.0, 0.0, 0.0)
        y, weights = seen(camera, vector(-length, 0.0, 0.0), normal, 3)
        at, share = gauss(fine)
        a, b, c, d = opening(parts)
        s, t = (x.reshape(-1, 1) for x in torch.meshgrid(at, at, indexing="ij"))
        p = (1 - t) * ((1 - s) * a + s * b) + t * ((1 - s) * d + s * c)
        along, across = (1 - t) * (b - a) + t * (c - d), (1 - s) * (d - a) + s * (c - b)
        area = torch.linalg.cross(along, across).norm(dim=1) * (share[:, None] * share).reshape(-1)
        away = p - y[:, None]
        squared = (away * away).sum(-1)
        l = away / squared[..., None].sqrt()
        there = y[:, None] + 2 * length / away[..., :1] * away  # on the lit wall
        to_light = parts["light"] - there
        distance = to_light.norm(dim=-1)
        sent = parts["brightness"] * -to_light[..., 0] / distance**3 / math.pi
        got = sent * l[..., 0] ** 2 / squared * area  # cos at y, cos at the hole
        v = normalize(camera.eye - y, dim=1)
        scattered = _scattered(got, parts["colour of the seen wall"], roughness, v, l)
        return pixels(camera, scattered * parts["colour of the lit wall"], weights)

    return problem(parts, make, exact, size, spp=spp, options={"bounces": 2, **samples})


def _scattered(got: Tensor, color: Tensor, roughness: float | None, v: Tensor, l: Tensor) -> Tensor:
    """Return ∑ f got (N, 3) in the plane x = 0, by Lambert or as a metal of glTF 2.0, appendix B. v (N, 3), l and got (N, M)."""
    if roughness is None:
        return got.sum(1, keepdim=True) * color / math.pi
    h = normalize(v[:, None] + l, dim=-1)
    alpha2 = roughness**4
    D = alpha2 / (math.pi * (h[..., 0] ** 2 * (alpha2 - 1) + 1) ** 2)

    def smith(c: Tensor) -> Tensor:
        return ((1 + alpha2 * (1 / c**2 - 1)).sqrt() - 1) / 2

    nl, nv = l[..., 0], v[:, :1]
    f = got * D / ((1 + smith(nl) + smith(nv)) * 4 * nl * nv)
    grazing = (1 - (v[:, None] * h).sum(-1)) ** 5
    return (f * (1 - grazing)).sum(1, keepdim=True) * color + (f * grazing).sum(1, keepdim=True)


@group.add("keyhole", "two closed rooms; light comes through a hole of 0.6 % of the wall between them", seeds=32)
def keyhole() -> Problem:
    return hole(0.08, None, 1, 6, 150_000, {"sampling": Sampling(surface=300_000, edges=100_000)})


@group.add("bounced-mirror", "a mirror-like wall, roughness 0.2, that shows another through a hole", 0.2, seeds=32)
def mirror(roughness: float) -> Problem:
    return hole(0.2, roughness, 8, 28, 1024, {"sampling": Sampling(surface=10_000, edges=150_000)})


@group.add("integrating-sphere", "a light inside of a closed ball of albedo 0.9, 8 bounces", seeds=32)
def inside() -> Problem:
    """What a ball scatters once comes back evenly: after k bounces the irradiance is ρᵏ times the mean of the first."""
    bounces, ball, camera = 8, icosphere(4), view(vector(0.2, -0.1, 0.0), vector(-1.0, 0.3, 0.2), 60.0, 8)
    parts = {
        "light": vector(0.3, 0.1, 0.2), "brightness": vector(3.0), "albedo": vector(0.9, 0.8, 0.5),
        "radius": torch.ones(1, dtype=F64),
    }  # fmt: skip

    def make(parts: Parts) -> View:
        mesh = Mesh(ball.verts * parts["radius"], ball.faces, material=Material(parts["albedo"]))
        return Scene([mesh], lights=[PointLight(parts["light"], parts["brightness"])]), camera

    def exact(parts: Parts) -> Tensor:
        on_plane, weights = seen(camera, vector(-1.0, 0.0, 0.0), vector(1.0, 0.0, 0.0))
        eye, R = camera.eye, parts["radius"]
        ray = normalize(on_plane - eye, dim=1)
        along = ray @ eye
        y = eye + (-along + (along**2 + R**2 - eye @ eye).sqrt())[:, None] * ray
        to_light = parts["light"] - y
        first = (to_light * -y).sum(1, keepdim=True) / R / to_light.norm(dim=1, keepdim=True) ** 3
        rho = parts["albedo"]
        further = sum(rho**k for k in range(1, bounces)) / R**2
        return pixels(camera, parts["brightness"] * rho / math.pi * (first + further), weights)

    samples = {"sampling": Sampling(surface=10_000, edges=1_000)}
    return problem(parts, make, exact, spp=64, options={"bounces": bounces, **samples})


@group.add(
    "albedo-1",
    "a closed ball of albedo 1 (green 0.9, blue 0.5) around a block, all of which shines, 16 bounces",
    16,
    seeds=32,
)
def furnace(bounces: int) -> Problem:
    """All shines and scatters alike, so everywhere there is a point's own light times 1 + ρ + … + ρⁿ."""
    parts = {"albedo": vector(1.0, 0.9, 0.5), "emission": vector(0.06, 0.12, 0.5)}
    samples = {"sampling": Sampling(surface=10_000, edges=1)}
    return _furnace(parts, bounces, spp=1024, options={"bounces": bounces, **samples})


@group.add("all-cancels", "the same with 4 bounces: as the block moves all terms of the gradient cancel", 4, seeds=32)
def cancelling(bounces: int) -> Problem:
    """The block moves in two directions. Relative to the whole brightness, 15 % would be left without secondary edges."""
    parts = {"albedo": vector(1.0), "emission": vector(0.2), "block": torch.zeros(2, dtype=F64)}
    samples = {"sampling": Sampling(surface=20_000, edges=8_000)}
    return _furnace(parts, bounces, spp=256, options={"bounces": bounces, **samples})


def _furnace(parts: Parts, bounces: int, **fields: Any) -> Problem:
    """Seen as one pixel."""
    room, block = icosphere(1).transformed(scale=1.5), cube(0.3)
    camera = view(vector(0.6, -0.3, 0.5), vector(1.4, 0.0, 0.4), 60.0, 1)

    def make(parts: Parts) -> View:
        look = Material(parts["albedo"], emission=parts["emission"])
        moved = block.verts @ rotation(vector(0.2, 0.1, 0.4)).mT + vector(0.7, 0.0, 0.0)
        if "block" in parts:
            moved = moved + 0.6 * torch.cat([parts["block"], torch.zeros(1, dtype=F64)])
        return Scene([Mesh(room.verts, room.faces, material=look), Mesh(moved, block.faces, material=look)]), camera

    def exact(parts: Parts) -> Tensor:
        radiance = parts["emission"] * sum(parts["albedo"] ** k for k in range(bounces + 1))
        return radiance.expand(1, 1, 3)

    return Problem(parts, make, exact, "closed form", adjoint=vector(1.0, 0.0, 0.0)[None, None], **fields)


@group.add(
    "bounced-standing",
    "a black block that stands on a sunlit floor, of which the camera sees what it sends to a wall",
    seeds=32,
)
def standing() -> Problem:
    floor = [[-1.5, -1.5, 0.0], [1.5, -1.5, 0.0], [1.5, 1.5, 0.0], [-1.5, 1.5, 0.0]]
    wall = [[-1.2, 0.0, 0.2], [-1.2, 0.0, 2.4], [1.2, 0.0, 2.4], [1.2, 0.0, 0.2]]
    camera = view(vector(0.2, -0.9, 1.5), vector(0.0, -2.5, 1.2), 42.0, 8)
    turn, block = rotation(vector(0.0, 0.0, 0.3)), cube(1.0)
    normal = vector(0.0, 1.0, 0.0)
    parts = {
        "block": torch.zeros(2, dtype=F64), "block's height": vector(0.5), "wall": vector(-2.5), "sun": vector(1.0, 0.2),
        "brightness": vector(4.0), "colour of the floor": FLOOR, "colour of the wall": WALL,
    }  # fmt: skip

    def box(parts: Parts) -> Tensor:
        at = torch.cat([parts["block"], parts["block's height"] / 2])
        return block.verts * torch.cat([vector(0.4, 0.3), parts["block's height"] / 2]) @ turn.mT + at

    def make(parts: Parts) -> View:
        meshes = [
            plate(floor, parts["colour of the floor"]),
            plate(wall, parts["colour of the wall"]).transformed(t=normal * parts["wall"]),
        ]
        sun = DirectionalLight(torch.cat([parts["sun"], vector(-1.0)]), parts["brightness"])
        return Scene([*meshes, black(box(parts), block.faces)], lights=[sun]), camera

    def exact(parts: Parts) -> Tensor:
        """Integrate over the floor without the block and its shadow, less where the block hides the shadow."""
        y, weights = seen(camera, normal * parts["wall"], normal)
        ground = torch.tensor(floor, dtype=F64)
        got = cosines(y, normal, ground)
        travels = torch.cat([parts["sun"], vector(-1.0)])
        corners = box(parts)[SIDES]
        outward = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
        shadow = [
            side + side[:, 2:] * travels for side, m in zip(corners, outward, strict=True) if bool(m @ travels < 0)
        ]
        got = got - sum(cosines(y, normal, dark) for dark in shadow)
        for side, m in zip(corners, outward, strict=True):
            front = (y - side[0]) @ m > 0
            for window, sign in ((ground, -1.0), *((dark, 1.0) for dark in shadow)):
                part, some = clipped(y, side, window)
                got = got + sign * torch.where(front & some, cosines(y, normal, part), 0.0)
        sent = parts["brightness"] / travels.norm() * parts["colour of the floor"] / math.pi
        return pixels(camera, got[:, None] * sent * parts["colour of the wall"] / math.pi, weights)

    samples = {"sampling": Sampling(surface=20_000, edges=200_000)}
    return problem(parts, make, exact, spp=1024, options={"bounces": 2, **samples})


@group.add(
    "bounced-million",
    "a black ball of 1.3 M faces and its shadow, between a sunlit plate and one that this lights",
    8,
    slow=True,
    seeds=8,
)
def million(subdivisions: int) -> Problem:
    ball = icosphere(subdivisions)
    sends = [[2.0, -2.3, -3.3], [2.0, 2.3, -3.3], [2.0, 2.3, 2.3], [2.0, -2.3, 2.3]]
    gets = [[-2.0, -0.6, -0.6], [-2.0, -0.6, 0.6], [-2.0, 0.6, 0.6], [-2.0, 0.6, -0.6]]
    camera = view(vector(-1.2, 0.0, 0.05), vector(-2.0, 0.0, 0.0), 60.0, 8)
    normal, travels, place = vector(1.0, 0.0, 0.0), vector(1.0, 0.0, -1.0), vector(-0.7, 0.0, 0.0)
    parts = {
        "ball": torch.zeros(1, dtype=F64), "radius": vector(0.35), "brightness": vector(4.0),
        "colour of the lit plate": FLOOR, "colour of the seen plate": WALL,
    }  # fmt: skip

    def centre(parts: Parts) -> Tensor:
        return place + parts["ball"] * vector(1.0, 0.2, 0.1)

    def make(parts: Parts) -> View:
        meshes = [plate(sends, parts["colour of the lit plate"]), plate(gets, parts["colour of the seen plate"])]
        meshes.append(black(ball.verts * parts["radius"] + centre(parts), ball.faces))
        return Scene(meshes, lights=[DirectionalLight(travels, parts["brightness"])]), camera

    def exact(parts: Parts) -> Tensor:
        """Integrate over the plate without the ball, (R / d)² π cos θ, and without the shadow, which the ball never hides."""
        y, weights = seen(camera, vector(-2.0, 0.0, 0.0), normal)
        away = centre(parts) - y
        angle = 2 * math.pi * torch.arange(256, dtype=F64)[:, None] / 256
        R = parts["radius"] * math.sqrt(math.pi / 128 / math.sin(math.pi / 128))  # of a circle as large as this polygon
        rim = centre(parts) + R * (
            angle.cos() * vector(0.0, 1.0, 0.0) + angle.sin() * normalize(vector(1.0, 0.0, 1.0), dim=0)
        )
        shadow = rim + (2.0 - rim[:, :1]) * travels
        got = cosines(y, normal, torch.tensor(sends, dtype=F64)) - cosines(y, normal, shadow)
        got = got - math.pi * parts["radius"] ** 2 * (away @ normal) / away.norm(dim=1) ** 3
        sent = parts["brightness"] / travels.norm() * parts["colour of the lit plate"] / math.pi
        return pixels(camera, got[:, None] * sent * parts["colour of the seen plate"] / math.pi, weights)

    samples = {"sampling": Sampling(surface=20_000, edges=200_000)}
    return problem(parts, make, exact, spp=2048, options={"bounces": 2, **samples})
