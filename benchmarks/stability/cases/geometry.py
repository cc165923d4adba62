"""Geometry: what files of meshes bring, and what edge sampling finds hard."""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from oracles.cut_apart import cut_apart
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import background, cube, front_camera, icosphere, smooth_colors, soup, unproject
from .camera import flat, vector
from .case import F64, Group, Parts, Problem, everything
from .scale import tilted_cube

group = Group("geometry")
CAMERA = front_camera(48)


def on_screen(pixels: list[list[float]], depth: list[float], faces: list[list[int]], **fields: Any) -> Mesh:
    """Return a mesh whose vertices have these pixels and depths for CAMERA."""
    verts = unproject(CAMERA, torch.tensor(pixels, dtype=F64), torch.tensor(depth, dtype=F64))
    return Mesh(verts, torch.tensor(faces), **fields)


def of_faces(*colors: tuple[float, float, float]) -> Tensor:
    return torch.tensor(colors, dtype=F64)


@group.add("sliver-long", "a sliver of aspect 1e6, 0.2 px wide, that crosses the image", 2e5, 0.2, False)
@group.add("sliver-long-smooth", "the same with smooth colours", 2e5, 0.2, True)
@group.add("sliver-thin", "a sliver of aspect 1e6 inside the image: 40 px by 4e-5 px", 40.0, 4e-5, False)
@group.add("sliver-thin-smooth", "the same with smooth colours", 40.0, 4e-5, True)
def sliver(length: float, width: float, smooth: bool) -> Problem:
    """The camera is no part: its gradient is the difference of two sides, each 1e6 times as large."""
    angle = 0.4
    along = 0.5 * length * vector(math.cos(angle), math.sin(angle))
    across = 0.5 * width * vector(-math.sin(angle), math.cos(angle))
    middle = vector(23.3, 25.1)
    pixels = torch.stack([middle - along - across, middle - along + across, middle + along])
    verts = unproject(CAMERA, pixels, vector(3.9, 3.9, 4.2))
    look: dict[str, Any] = {"colors": smooth_colors(verts)} if smooth else {"face_colors": of_faces((0.9, 0.3, 0.1))}
    mesh = Mesh(verts, torch.tensor([[0, 1, 2]]), **look)
    return everything(Scene([mesh], background()), CAMERA, camera_too=False, faint=True)


def _with_faces(scene: Scene, faces: list[list[int]]) -> Scene:
    (mesh,) = scene.meshes
    return scene.replace(meshes=[mesh.replace(faces=torch.cat([mesh.faces, torch.tensor(faces)]))])


@group.add("repeated-index", "faces that name a vertex twice or three times")
def repeated_index() -> Problem:
    scene = Scene([tilted_cube()], background())
    return everything(
        scene, CAMERA, shown=lambda scene: _with_faces(scene, [[0, 0, 3], [1, 5, 1], [7, 7, 7], [2, 6, 6]])
    )


@group.add("zero-area", "faces of zero area: corners in the same place, and three on a line")
def zero_area() -> Problem:
    """Four more vertices in the middle of a cube's edges and corners; no face that is seen uses them."""

    def shown(scene: Scene) -> Scene:
        (mesh,) = scene.meshes
        v, c = mesh.verts, mesh.colors
        assert c is not None
        more = torch.stack([0.5 * (v[0] + v[1]), 0.25 * v[4] + 0.75 * v[5], v[7], v[2]])
        mesh = Mesh(torch.cat([v, more]), mesh.faces, colors=torch.cat([c, c[:4]]))
        return _with_faces(scene.replace(meshes=[mesh]), [[0, 8, 1], [4, 9, 5], [7, 10, 3], [11, 2, 2], [10, 7, 7]])

    return everything(Scene([tilted_cube()], background()), CAMERA, shown=shown)


@group.add("duplicate-faces", "every face listed twice")
def duplicate_faces() -> Problem:
    def shown(scene: Scene) -> Scene:
        (mesh,) = scene.meshes
        return scene.replace(meshes=[mesh.replace(faces=torch.cat([mesh.faces, mesh.faces[:, [1, 2, 0]]]))])

    return everything(Scene([tilted_cube()], background()), CAMERA, shown=shown)


@group.add("duplicate-reversed", "every face listed twice, the copy with its back to the front")
def duplicate_reversed() -> Problem:
    def shown(scene: Scene) -> Scene:
        (mesh,) = scene.meshes
        return scene.replace(meshes=[mesh.replace(faces=torch.cat([mesh.faces, mesh.faces[:, [0, 2, 1]]]))])

    return everything(Scene([tilted_cube()], background()), CAMERA, shown=shown)


@group.add("fan-3", "3 faces on an edge", 3)
@group.add("fan-5", "5 faces on an edge", 5)
@group.add("fan-8", "8 faces on an edge", 8)
def fan(count: int) -> Problem:
    a, b = vector(0.05, -0.7, 0.1), vector(-0.1, 0.75, -0.05)
    angles = torch.linspace(0.4, 0.4 + 2.0 * math.pi * (1.0 - 1.0 / count), count, dtype=F64)
    tips = torch.stack([0.8 * angles.cos(), 0.1 * angles.sin(), 0.8 * angles.sin()], -1)
    faces = torch.tensor([[0, 1, 2 + i] if i % 2 else [1, 0, 2 + i] for i in range(count)])
    mesh = Mesh(torch.cat([torch.stack([a, b]), tips]), faces, face_colors=smooth_colors(7.0 * tips))
    return everything(Scene([mesh], background()), CAMERA)


@group.add("soup", "triangle soup, float32", torch.float32)
@group.add("soup-64", "triangle soup, float64", torch.float64)
def triangle_soup(dtype: torch.dtype) -> Problem:
    def shown(scene: Scene) -> Scene:
        return scene.replace(meshes=[soup(scene.meshes[0])])

    return everything(Scene([icosphere(2).transformed(scale=0.9)], background()).to(dtype), CAMERA, shown=shown)


@group.add("open-border", "open borders: half a sphere and single triangles cut out of it")
def open_border() -> Problem:
    ball = icosphere(2).transformed(scale=0.9)
    middles = ball.verts[ball.faces.long()].mean(1)
    kept = (middles @ vector(0.5, 0.6, -0.4) < 0.1) & (torch.arange(len(middles)) % 9 != 0)
    return everything(Scene([ball.replace(faces=ball.faces[kept])], background()), CAMERA)


@group.add("huge-triangle", "one triangle that covers 100 screens, its edge in view")
def huge_triangle() -> Problem:
    pixels = [[-450.0, -480.0], [520.0, 300.0], [-330.0, 610.0]]
    mesh = on_screen(
        pixels, [2.0, 7.0, 5.0], [[0, 1, 2]], colors=of_faces((0.9, 0.1, 0.3), (0.2, 0.8, 0.5), (0.4, 0.3, 0.9))
    )
    return everything(Scene([mesh], background()), CAMERA)


@group.add("million-in-a-pixel", "a sphere of 1.3 M faces inside one pixel", slow=True)
def million_in_a_pixel() -> Problem:
    """The sphere has one colour and is seen as an ellipse, whose area is known."""
    ball = icosphere(8)
    size, focal = (5, 5), 40.0
    camera = front_camera(48).replace(
        K=torch.tensor([[focal, 0.0, 2.5], [0.0, focal, 2.5], [0.0, 0.0, 1.0]], dtype=F64), size=size
    )
    M = camera.world_to_camera
    # 0.6 px wide, inside one pixel: all of its motion shows in its size.
    centre = (vector(1.0 * 4.0 / focal, -0.9 * 4.0 / focal, 4.0) - M[:3, 3]) @ M[:3, :3]
    radius = vector(0.3 * 4.0 / focal)
    adjoint = torch.zeros((*size, 3), dtype=F64)
    adjoint[1, 3] = vector(1.0, -0.7, 0.4)
    parts = {"centre": centre, "radius": radius, "colour": of_faces((0.9, 0.5, 0.2))}

    def make(parts: Parts) -> tuple[Scene, Camera]:
        mesh = Mesh(
            parts["centre"] + parts["radius"] * ball.verts,
            ball.faces,
            face_colors=parts["colour"].expand(len(ball.faces), 3),
        )
        return Scene([mesh], background()), camera

    def exact(parts: Parts) -> Tensor:
        q = M[:3, :3] @ parts["centre"] + M[:3, 3]
        # The cone of rays that touch the sphere, half angle β about an axis at θ from the view, cut by Z = 1.
        cos2 = q[2].square() / q.square().sum()
        sin2 = parts["radius"].square().sum() / q.square().sum()
        area = focal**2 * math.pi * sin2 * (1.0 - sin2).sqrt() * (cos2 - sin2) ** -1.5
        image = background().expand(*size, 3).clone()
        image[1, 3] = area * parts["colour"][0] + (1.0 - area) * background()
        return image

    return Problem(parts, make, exact, "area of an ellipse", adjoint=adjoint, spp=1024)


@group.add("tiny-edge", "an edge shorter than 1e-6 px")
def tiny_edge() -> Problem:
    pixels = [[8.2, 9.1], [40.3, 12.4], [31.7, 41.2], [31.7 - 4e-7, 41.2 + 3e-7]]
    colors = of_faces((0.9, 0.1, 0.3), (0.2, 0.8, 0.5), (0.4, 0.3, 0.9), (0.4, 0.3, 0.9))
    mesh = on_screen(pixels, [3.6, 4.2, 3.9, 3.9], [[0, 1, 2], [0, 2, 3]], colors=colors)
    return everything(Scene([mesh], background()), CAMERA)


@group.add("crossing-edges", "two edges that cross in the image at the same depth")
def crossing_edges() -> Problem:
    """An edge of one triangle touches an edge of the other in a point, and both fold away from there."""
    first = on_screen([[4.0, 20.0], [44.0, 28.0], [20.0, 44.0]], [4.0, 4.0, 4.6], [[0, 1, 2]])
    # The point at half of the first's edge, seen at (24, 24), is at half of the other's.
    touch = first.verts[:2].mean(0)
    arm = unproject(CAMERA, torch.tensor([[20.0, 6.0]], dtype=F64), vector(4.0))[0] - touch
    tip = unproject(CAMERA, torch.tensor([[44.0, 14.0]], dtype=F64), vector(3.5))[0]
    other = Mesh(torch.stack([touch + arm, touch - arm, tip]), torch.tensor([[0, 1, 2]]))
    first = first.replace(face_colors=of_faces((0.9, 0.2, 0.1)))
    other = other.replace(face_colors=of_faces((0.1, 0.7, 0.9)))
    return everything(Scene([first, other], background()), CAMERA)


@group.add("unused-vertices", "vertices used by no face, up to 1e12 times the scene away")
def unused_vertices() -> Problem:
    def shown(scene: Scene) -> Scene:
        (mesh,) = scene.meshes
        assert mesh.colors is not None
        far = torch.tensor([[0.0, 0.0, 0.0], [1e12, -1e12, 1e12], [3e4, 2e5, -1e6]], dtype=F64)
        colors = torch.cat([mesh.colors, torch.full((3, 3), 1e6, dtype=F64)])
        return scene.replace(meshes=[Mesh(torch.cat([far, mesh.verts]), mesh.faces + 3, colors=colors.roll(3, 0))])

    return everything(Scene([tilted_cube()], background()), CAMERA, shown=shown)


def _noise(count: int) -> Tensor:
    return torch.randn((count, 3), dtype=F64, generator=torch.Generator().manual_seed(0))


def _crossing() -> tuple[Mesh, Mesh]:
    """No two faces in one plane: the exact image cuts faces by whole planes."""
    box = cube(0.45).transformed(rotation(vector(0.5, 0.2, 0.1)))
    box = box.replace(verts=box.verts + 0.04 * _noise(len(box.verts)))
    return flat(box), flat(box.transformed(rotation(vector(-0.3, 0.8, 0.5)), vector(0.35, 0.2, 0.15)))


@group.add("through-each-other", "two boxes that pass through each other")
@group.add("through-each-other-orthographic", "the same in an orthographic view", "orthographic")
def through_each_other(projection: Literal["perspective", "orthographic"] = "perspective") -> Problem:
    return everything(Scene(list(_crossing()), background()), front_camera(48, projection), equal=cut_apart)


@group.add("spikes", "a sphere of 1,280 faces whose vertices are moved in and out by normal noise of 10 %")
def spikes() -> Problem:
    ball = icosphere(3).transformed(scale=0.9)
    verts = ball.verts * (1.0 + 0.1 * _noise(len(ball.verts))[:, :1])
    return everything(Scene([ball.replace(verts=verts)], background()), CAMERA)


@group.add(
    "tangled",
    "a sphere of 1,280 faces, random colours, whose vertices are moved anywhere by normal noise of 10 %",
    slow=True,
)
def tangled() -> Problem:
    """The sphere looks like one in the first steps of a shape fit. It moves as a whole; the reference are differences."""
    ball = icosphere(3).transformed(scale=0.9)
    verts = ball.verts + 0.09 * _noise(len(ball.verts))
    ball = ball.replace(colors=torch.rand(len(verts), 3, generator=torch.Generator().manual_seed(0), dtype=F64))
    parts = {"shift": torch.zeros(3, dtype=F64), "growth": torch.zeros(1, dtype=F64)}

    def make(parts: Parts) -> tuple[Scene, Camera]:
        return Scene([ball.replace(verts=verts * (1.0 + parts["growth"]) + parts["shift"])], background()), CAMERA

    return Problem(parts, make, None, "finite differences", steps=dict.fromkeys(parts, 0.004))
