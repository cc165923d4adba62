"""Scenes with shadows, as functions of one number that moves the caster, the receiver, the light or the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
import trimesh
from lit_scenes import plane, vector
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
CASTER, RECEIVER, LIGHT, CAMERA = "caster", "receiver", "light", "camera"
SHIFT = vector(1.0, 0.3, 0.2)  # of whatever moves
ALONG = vector(1.0, 0.4, 0.0)  # of what stands on the ground


class Moved(NamedTuple):
    """θ times SHIFT for what moves, zeros for all else."""

    what: str
    theta: Tensor

    def by(self, what: str, shift: Tensor = SHIFT) -> Tensor:
        return self.theta * shift if what == self.what else 0 * shift


Lights = Callable[[Moved], object]
Parts = Callable[[Moved], list[eg.Mesh]]


def lit(mesh: eg.Mesh, smooth: bool = False, base: float = 0.25) -> eg.Mesh:
    normals = mesh.vertex_normals() if smooth else None
    return mesh.replace(
        material=eg.Material(base_color=base), normals=normals, colors=torch.ones((len(mesh.verts), 1), dtype=F64)
    )


def grown(mesh: eg.Mesh, m: Moved, shift: Tensor = SHIFT) -> eg.Mesh:
    """It grows from the middle of its foot, and moves: both darken a bright ground, so that little cancels."""
    v = mesh.verts
    foot = torch.cat([v[:, :2].mean(0), v[:, 2:].amin(0)])
    return mesh.replace(verts=v + m.by(CASTER, 0.6 * (v - foot) + 0.3 * shift))


def of(mesh: trimesh.Trimesh) -> eg.Mesh:
    return eg.Mesh(torch.tensor(mesh.vertices.copy(), dtype=F64), torch.tensor(mesh.faces.copy()))


def sphere(level: int, radius: float, center: Tensor) -> eg.Mesh:
    ball = of(trimesh.creation.icosphere(subdivisions=level, radius=radius))
    return ball.transformed(t=center)


def box(center: Tensor, *sides: float) -> eg.Mesh:
    return of(trimesh.creation.box(extents=sides)).transformed(t=center)


def torus() -> eg.Mesh:
    ring = trimesh.creation.torus(0.6, 0.22, major_sections=48, minor_sections=24)
    ring.apply_transform(trimesh.transformations.rotation_matrix(1.0, [1, 0.3, 0.2]))
    return of(ring).transformed(t=vector(0, 0, 0.75))


def terrain(n: int = 24) -> eg.Mesh:
    x = torch.linspace(-1.2, 1.2, n + 1, dtype=F64)
    x, y = torch.meshgrid(x, x, indexing="ij")
    z = 0.22 * (4 * x + 1).sin() * (3.3 * y).cos() + 0.05 * (7 * y + x).sin()
    i = torch.arange(n * (n + 1)).reshape(n, n + 1)[:, :-1].reshape(-1)
    faces = torch.cat([torch.stack([i, i + n + 2, i + 1], 1), torch.stack([i, i + n + 1, i + n + 2], 1)])
    return eg.Mesh(torch.stack([x, y, z], -1).reshape(-1, 3), faces)


def triangle() -> eg.Mesh:
    return eg.Mesh(
        torch.tensor([[0.6, 0, 0], [-0.3, 0.5, 0.1], [-0.3, -0.5, -0.1]], dtype=F64), torch.tensor([[0, 1, 2]])
    )


def emitter_shade() -> eg.Mesh:
    """An open cone around its axis, narrow above."""
    angle = torch.arange(24, dtype=F64) * (2 * math.pi / 24)
    ring = torch.stack([angle.cos(), angle.sin(), 0 * angle], 1)
    verts = torch.cat([0.18 * ring + vector(0, 0, 0.25), 0.34 * ring - vector(0, 0, 0.2)])
    i = torch.arange(24)
    j = (i + 1) % 24
    return eg.Mesh(verts, torch.cat([torch.stack([i, i + 24, j], 1), torch.stack([j, i + 24, j + 24], 1)]))


# -- lights -------------------------------------------------------------------------------------------------------------


EMITTER = vector(1.1, -0.7, 2.4)


def point(m: Moved, at: Tensor = EMITTER) -> object:
    return eg.lights.PointLight(at + m.by(LIGHT), 10.0)


def sun(m: Moved, at: Tensor = EMITTER) -> object:
    return eg.lights.DirectionalLight(-(at + m.by(LIGHT)), 1.5)


def spot(m: Moved) -> object:
    at = EMITTER + m.by(LIGHT)
    return eg.lights.SpotLight(at, vector(-1.1, 0.7, -2.0), 10.0, inner_angle=0.2, outer_angle=0.6)


def panel(m: Moved) -> object:
    return eg.shapes.rectangle(
        vector(0.9, -0.6, 2.4) + m.by(LIGHT),
        vector(0.4, 0, 0.1),
        vector(0, 0.3, 0),
        material=eg.Material(base_color=0.0, emission=8.0),
    )


def bulb(m: Moved) -> object:
    return sphere(2, 0.25, vector(0.9, -0.6, 2.4) + m.by(LIGHT)).replace(
        material=eg.Material(base_color=0.0, emission=12.0)
    )


def sky(m: Moved) -> object:
    return eg.lights.Environment(vector(1.0))


def image_sky(m: Moved) -> object:
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(16.0), indexing="ij")
    return eg.lights.Environment((0.3 + 2.0 * torch.exp(-((y - 2.5) ** 2 + (x - 5) ** 2) / 2)).double()[:, :, None])


# -- surfaces -----------------------------------------------------------------------------------------------------------


def ground(m: Moved) -> eg.Mesh:
    return lit(plane(), base=0.8).transformed(t=m.by(RECEIVER, vector(0.1, 0.2, 1.0)))


def above(mesh: eg.Mesh, smooth: bool = False, shift: Tensor = SHIFT) -> Parts:
    return lambda m: [ground(m), lit(grown(mesh, m, shift), smooth)]


def sphere_on_sphere(m: Moved) -> list[eg.Mesh]:
    big, small = sphere(3, 0.45, vector(0, 0, 0.5)), sphere(2, 0.25, vector(0.25, -0.1, 1.2))
    return [
        ground(Moved(CASTER, m.theta)),
        lit(big, base=0.8).transformed(t=m.by(RECEIVER)),
        lit(grown(small, m)),
    ]


def across_a_border(m: Moved) -> list[eg.Mesh]:
    """Part of the shadow falls next to the receiver."""
    return [
        lit(plane(0.5), base=0.8).transformed(t=m.by(RECEIVER)),
        lit(grown(triangle().transformed(t=vector(0.3, 0.1, 1)), m)),
    ]


def alone(mesh: eg.Mesh, smooth: bool) -> Parts:
    return lambda m: [lit(grown(mesh, m), smooth)]


def warped(mesh: eg.Mesh, smooth: bool) -> Parts:
    """A field of shifts, of which some turn faces; it grows and rises, so that little cancels."""
    x, y, z = mesh.verts.unbind(1)
    field = 0.3 * torch.stack([(3 * y + 1).sin() + 2 * x, (2 * z + x).cos() + 2 * y, (2 * x).sin() + 1.5], 1)
    return lambda m: [ground(m), lit(mesh.replace(verts=mesh.verts + m.by(CASTER, field)), smooth)]


def grazing(m: Moved) -> list[eg.Mesh]:
    """A thin strip that the light and the camera see at a low angle."""
    strip = eg.Mesh(
        torch.tensor([[-2, -0.02, -1.2], [2, -0.02, -1.2], [2, 0.02, 1.2], [-2, 0.02, 1.2]], dtype=F64),
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )
    return [
        lit(strip, base=0.8).transformed(t=m.by(RECEIVER)),
        lit(grown(triangle().transformed(t=vector(0.2, -0.5, 0.3)), m)),
    ]


class Case(NamedTuple):
    parts: Parts
    light: Lights
    moves: str
    crop: bool = False  # far from the caster
    samples: int = 1  # times the usual number, of both sides
    step: float = 0.01  # of the finite difference

    def at(self, theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
        m = Moved(self.moves, theta)
        return eg.Scene(self.parts(m), lights=[self.light(m)]), self.camera(m)

    def camera(self, m: Moved) -> eg.Camera:
        camera = eg.Camera.look_at(eye=(1.2, -3.5, 2.6), target=(0, 0, 0.3), up=(0, 0, 1), fov_y=42, size=(64, 64)).to(
            F64
        )
        shift = torch.cat([m.by(CAMERA), torch.zeros(1, dtype=F64)])
        move = torch.cat([torch.zeros((4, 3), dtype=F64), shift[:, None]], 1)
        camera = camera.replace(world_to_camera=camera.world_to_camera + move)
        if not self.crop:
            return camera
        K = camera.K * torch.tensor([[6.0], [6.0], [1.0]], dtype=F64) - torch.tensor(
            [[0, 0, 130.0], [0, 0, 200], [0, 0, 0]]
        )
        return camera.replace(K=K)


CUBE, BALL = box(vector(0, 0, 0.4), 0.7, 0.6, 0.8), sphere(3, 0.45, vector(0, 0, 0.45))
CASES = {
    **{
        f"{name}, {light.__name__}, {moves} moves": Case(
            above(mesh),
            light,
            moves,
            samples=3 if len(mesh.faces) > 10_000 and (light, moves) == (point, CASTER) else 1,
        )
        for name, mesh in {
            "triangle": triangle().transformed(t=vector(0, 0, 1.0)),
            "sphere of 1,280": sphere(3, 0.4, vector(0, 0, 1.0)),
            "sphere of 81,920": sphere(6, 0.4, vector(0, 0, 1.0)),
        }.items()
        for light in (point, sun)
        for moves in (CASTER, RECEIVER, LIGHT, CAMERA)
    },
    **{
        f"sphere of 1,280, {light.__name__}, {moves} moves": Case(
            above(sphere(3, 0.4, vector(0, 0, 1.0))), light, moves
        )
        for light, moves in ((spot, CASTER), (spot, LIGHT), (panel, LIGHT), (bulb, LIGHT))
    },
    # Few rays see soft shadows change, and what grows and moves cancels: longer steps in another direction.
    **{
        f"sphere of 1,280, {light.__name__}, caster moves": Case(
            above(sphere(3, 0.4, vector(0, 0, 1.0)), shift=-SHIFT), light, CASTER, samples=2, step=0.05
        )
        for light in (panel, bulb)
    },
    **{
        f"sphere of 1,280, {light.__name__}": Case(above(sphere(3, 0.4, vector(0, 0, 1.0))), light, CASTER, samples=4)
        for light in (sky, image_sky)
    },
    **{
        f"sphere on a sphere, {light.__name__}, {moves} moves": Case(
            sphere_on_sphere, light, moves, step=0.02, samples=3 if moves == CASTER else 16
        )
        for light in (point, sun)
        for moves in (CASTER, RECEIVER)
    },
    **{f"across a border, {moves} moves": Case(across_a_border, point, moves) for moves in (CASTER, RECEIVER)},
    **{
        f"torus, {'smooth' if smooth else 'flat'}, {light.__name__}, {moves} moves": Case(
            above(torus(), smooth), light, moves
        )
        for smooth in (False, True)
        for light in (point, sun)
        for moves in (CASTER, LIGHT)
    },
    **{
        f"terrain, {'smooth' if smooth else 'flat'}, {light.__name__} moves": Case(
            alone(terrain(), smooth), lambda m, light=light: light(m, vector(2.0, 0.7, 1.6)), LIGHT
        )
        for smooth in (False, True)
        for light in (point, sun)
    },
    **{f"torus, {light.__name__}, warped": Case(warped(torus(), True), light, CASTER) for light in (point, sun)},
    **{
        f"{name}, {light.__name__}": Case(above(mesh, shift=ALONG), light, CASTER)
        for name, mesh in {
            "box standing": CUBE,
            "sphere touching": BALL,
            "box sunk in": CUBE.transformed(t=vector(0, 0, -0.2)),
        }.items()
        for light in (point, sun, panel)
    },
    **{
        f"light shade, {moves} moves": Case(
            above(emitter_shade().transformed(t=vector(0, 0, 1.1))),
            lambda m: point(m, vector(0.03, 0.02, 1.1)),
            moves,
            step=0.003 if moves == LIGHT else 0.01,
        )
        for moves in (CASTER, LIGHT)
    },
    # It moves along the plane: across it, the border of the shadow has another speed on either side.
    "light nearly in a face's plane": Case(
        above(box(vector(0.1, 0, 1.0), 0.6, 0.6, 0.5)),
        lambda m: eg.lights.PointLight(vector(0.4 + 1e-7, -0.1, 2.4) + m.by(LIGHT, vector(0, 1.0, 0.2)), 10.0),
        LIGHT,
    ),
    **{
        f"thin strip, {moves} moves": Case(grazing, point, moves, step=0.06 if moves == CASTER else 0.01)
        for moves in (CASTER, RECEIVER)
    },
    "far crop": Case(above(sphere(3, 0.4, vector(0, 0, 1.0))), point, CASTER, crop=True),
}
