"""What coincides: edges in the image, surfaces in space. Most of these have a gradient for motions of the whole only: an
edge moved alone would come out on one side and stay hidden on the other, a kink."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import background, cube, front_camera, icosphere, smooth_colors
from .camera import flat, upright, vector
from .case import F64, Group, Problem, everything, rigid
from .scale import tilted_cube

group = Group("coincident")
CAMERA = front_camera(48)


def along_axes(size: int = 48, height: float = 2.4, turned: float = 0.0) -> Camera:
    """Return an orthographic camera exactly along −z, rotated about its axis by so many radians."""
    camera = upright(vector(0.0, 0.0, 4.0), size, size / height)
    c, s = math.cos(turned), math.sin(turned)
    M = camera.world_to_camera.clone()
    M[:2, :2] = torch.tensor([[c, s], [s, -c]], dtype=F64)
    M[:2, 3] = 0.0
    return camera.replace(world_to_camera=M, projection="orthographic")


def one_color(mesh: Mesh) -> Mesh:
    return Mesh(mesh.verts, mesh.faces, face_colors=vector(0.8, 0.3, 0.2).expand(len(mesh.faces), 3))


KINDS: dict[str, Callable[[Mesh], Mesh]] = {"smooth": lambda mesh: mesh, "faces": flat, "plain": one_color}
IN_PLACE = vector(0.0713, -0.0431, 0.0)  # off the pixels' grid


@group.add("ortho-box", "an axis-aligned box, orthographic: front and back edges coincide; smooth colours", "smooth")
@group.add("ortho-box-faces", "the same with a colour for each face", "faces")
@group.add("ortho-box-plain", "the same in one colour", "plain")
@group.add("ortho-box-turned", "the same, turned about the view's axis", "smooth", 0.5)
@group.add("ortho-box-32", "the same in float32", "smooth", 0.0, torch.float32)
def ortho_box(kind: str, turned: float = 0.0, dtype: torch.dtype = F64) -> Problem:
    box = KINDS[kind](cube(0.7).transformed(t=IN_PLACE))
    return rigid(Scene([box], background()).to(dtype), along_axes(turned=turned), centre=IN_PLACE)


@group.add("ortho-prism", "a prism of 64 sides seen along its axis, orthographic")
def ortho_prism() -> Problem:
    n = 64
    angle = 2.0 * math.pi * torch.arange(n, dtype=F64) / n
    ring = torch.stack([0.9 * angle.cos(), 0.7 * angle.sin(), 0.5 + 0.0 * angle], -1) + IN_PLACE
    verts = torch.cat([ring, ring - vector(0.0, 0.0, 1.0), ring[:1] * 0.0 + IN_PLACE + vector(0.0, 0.0, 0.5)])
    i, j = torch.arange(n), (torch.arange(n) + 1) % n
    top = torch.stack([i, j, torch.full((n,), 2 * n)], 1)
    faces = torch.cat([torch.stack([i, i + n, j], 1), torch.stack([j, i + n, j + n], 1), top])
    return rigid(Scene([Mesh(verts, faces, colors=smooth_colors(verts))], background()), along_axes(), centre=IN_PLACE)


@group.add("ortho-two-boxes", "two axis-aligned boxes behind each other, orthographic, outlines the same", False)
@group.add("ortho-two-colours", "the same, each of its own colour", True)
def ortho_two_boxes(colors: bool) -> Problem:
    front = one_color(cube(0.6).transformed(t=IN_PLACE))
    back = front.transformed(t=vector(0.0, 0.0, -2.0))
    if colors:
        back = back.replace(face_colors=vector(0.1, 0.6, 0.9).expand(len(back.faces), 3))
    return rigid(Scene([front, back], background()), along_axes(), centre=IN_PLACE)


@group.add("copies", "two meshes in the same place")
@group.add("copies-3", "three meshes in the same place", 3)
@group.add("copies-32", "two meshes in the same place, float32", 2, torch.float32)
def copies(count: int = 2, dtype: torch.dtype = F64) -> Problem:
    scene = Scene([tilted_cube()], background()).to(dtype)
    return everything(scene, CAMERA, shown=lambda scene: scene.replace(meshes=[*scene.meshes] * count))


@group.add("copies-sphere", "two spheres of 1,280 faces in the same place")
def copies_sphere() -> Problem:
    scene = Scene([icosphere(3).transformed(scale=0.9)], background())
    return everything(scene, CAMERA, shown=lambda scene: scene.replace(meshes=[*scene.meshes] * 2))


@group.add("copies-cut-otherwise", "two boxes in the same place, their sides cut along the other diagonals")
def copies_cut_otherwise() -> Problem:
    box = one_color(tilted_cube())
    quads = box.faces.reshape(6, 2, 3)
    corners = torch.cat([quads[:, 0], quads[:, 1, 2:]], 1)  # (6, 4) around
    other = box.replace(faces=torch.cat([corners[:, [1, 2, 3]], corners[:, [1, 3, 0]]]))
    return rigid(
        Scene([box, other], background()), CAMERA, turn=True, colors=False,
        equal=lambda scene: scene.replace(meshes=scene.meshes[:1]),
    )  # fmt: skip


DEPTH_FIGHT = "which of two surfaces of unlike colours at one depth is seen is not defined"


@group.add("copies-of-colours", "two meshes in the same place, of different colours", limit=DEPTH_FIGHT, most=3.0)
def copies_of_colors() -> Problem:
    """Compared as if the first alone were there."""
    first = one_color(tilted_cube())
    second = first.replace(face_colors=vector(0.1, 0.6, 0.9).expand(12, 3))
    return rigid(
        Scene([first, second], background()), CAMERA, turn=True, colors=False,
        equal=lambda scene: scene.replace(meshes=scene.meshes[:1]),
    )  # fmt: skip


def _sheet(x: tuple[float, float], y: tuple[float, float], color: Tensor) -> Mesh:
    """Return a rectangle in a tilted plane."""
    u, v, o = vector(0.9, 0.2, -0.3), vector(-0.25, 0.85, 0.2), vector(0.02, 0.05, 0.0)
    corners = [(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])]
    verts = torch.stack([o + a * u + b * v for a, b in corners])
    return Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=color.expand(2, 3))


RED, BLUE = vector(0.8, 0.3, 0.2), vector(0.1, 0.5, 0.9)


@group.add("coplanar-overlap", "two sheets in one plane that overlap, of one colour", (-0.3, 0.7))
@group.add("coplanar-flush", "the same, two borders of them on one line", (-0.6, 0.5))
def coplanar(y: tuple[float, float]) -> Problem:
    scene = Scene([_sheet((-0.8, 0.2), (-0.6, 0.5), RED), _sheet((-0.2, 0.9), y, RED)], background())
    return rigid(scene, CAMERA, turn=True, colors=False)


@group.add("coplanar-colours", "two sheets in one plane that overlap, of two colours", limit=DEPTH_FIGHT, most=3.0)
def coplanar_colors() -> Problem:
    """Compared as if the first were in front."""
    lift = vector(0.0, 0.0, 1e-7)
    scene = Scene([_sheet((-0.8, 0.2), (-0.6, 0.5), RED), _sheet((-0.2, 0.9), (-0.3, 0.7), BLUE)], background())

    def equal(scene: Scene) -> Scene:
        first, second = scene.meshes
        return scene.replace(meshes=[first.transformed(t=lift), second])

    return rigid(scene, CAMERA, turn=True, colors=False, equal=equal)


@group.add("coplanar-abut", "two sheets in one plane that meet along a line without shared vertices, of two colours")
def coplanar_abut() -> Problem:
    scene = Scene([_sheet((-0.8, 0.1), (-0.6, 0.5), RED), _sheet((0.1, 0.9), (-0.6, 0.5), BLUE)], background())
    return rigid(scene, CAMERA, turn=True)


def _t_junction(fold: float, color: Callable[[Tensor], dict[str, Tensor]], dtype: torch.dtype) -> Problem:
    """Join a quad left of an edge to two right of it that share half of it each; on the left, the edge is whole."""
    verts = vector(
        -0.8, -0.7, 0.1, 0.05, -0.75, 0.2, 0.15, 0.7, 0.1, -0.75, 0.75, 0.0,  # left
        0.9, -0.65, 0.2 - fold, 0.85, 0.72, 0.1 - fold,  # right
    ).reshape(6, 3)  # fmt: skip
    middle = 0.5 * (verts[1] + verts[2])
    whole = Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 2], [2, 4, 5]]))
    split = Mesh(
        torch.cat([verts, middle[None]]), torch.tensor([[0, 1, 2], [0, 2, 3], [1, 4, 6], [6, 4, 2], [2, 4, 5]])
    )
    whole, split = (Scene([mesh.replace(**color(mesh.verts))], background()).to(dtype) for mesh in (whole, split))
    problem, reference = (rigid(scene, CAMERA, turn=True) for scene in (split, whole))
    motions = {name: problem.parts[name] for name in ("shift", "growth", "turn")}

    def complete(parts: dict[str, Tensor], like: Problem) -> dict[str, Tensor]:
        return {**like.parts, **parts}

    assert reference.exact is not None
    exact = reference.exact
    return Problem(
        motions, lambda parts: problem.make(complete(parts, problem)), lambda parts: exact(complete(parts, reference))
    )


def _smooth(verts: Tensor) -> dict[str, Tensor]:
    slope = torch.tensor([[0.3, -0.2, 0.1], [0.1, 0.25, -0.3], [0.0, 0.1, 0.2]], dtype=F64)
    return {"colors": 0.5 + verts @ slope}  # linear in space: the same however the surface is cut


@group.add("t-junction", "a T-junction in a plane, smooth colours", 0.0, F64)
@group.add("t-junction-32", "the same in float32", 0.0, torch.float32)
@group.add("t-junction-fold", "a T-junction on a fold", 0.6, F64)
@group.add("t-junction-silhouette", "a T-junction on a fold that is a silhouette", 3.0, F64)
@group.add("t-junction-silhouette-32", "the same in float32", 3.0, torch.float32)
def t_junction(fold: float, dtype: torch.dtype) -> Problem:
    return _t_junction(fold, _smooth, dtype)


def _stack(offset: Tensor, camera: Camera, colors: bool, dtype: torch.dtype = F64) -> Problem:
    """Two boxes that share a side."""
    turn = rotation(vector(0.2, 0.6, 0.1))
    paint = flat if colors else one_color
    first = paint(cube(0.35)).transformed(turn, turn @ (-0.5 * offset))
    second = paint(cube(0.35)).transformed(turn, turn @ (0.5 * offset))
    return rigid(Scene([first, second], background()).to(dtype), camera, turn=True)


@group.add("stacked", "two boxes stacked flush, a colour for each face", vector(0.0, 0.7, 0.0), True)
@group.add("stacked-plain", "the same, of one colour", vector(0.0, 0.7, 0.0), False)
@group.add("stacked-32", "the same in float32, a colour for each face", vector(0.0, 0.7, 0.0), True, torch.float32)
@group.add("stacked-shifted", "two boxes stacked, one moved along: two sides in one plane", vector(0.3, 0.7, 0.0), True)
def stacked(offset: Tensor, colors: bool, dtype: torch.dtype = F64) -> Problem:
    return _stack(offset, CAMERA, colors, dtype)


@group.add("standing", "a box that stands on a plate, its bottom in the plate")
def standing() -> Problem:
    plate = flat(cube(0.5)).transformed(scale=1.0)
    plate = plate.replace(verts=plate.verts * vector(2.0, 0.2, 1.6) + vector(0.0, -0.35, 0.0))
    box = flat(cube(0.25)).transformed(t=vector(0.1, 0.0, 0.05))
    turn = rotation(vector(0.35, 0.5, 0.1))
    return rigid(Scene([plate.transformed(turn), box.transformed(turn)], background()), CAMERA, turn=True)


CELL = 0.5  # of lattices: a power of two, so that cubes that touch do so to the last bit
Cells = list[tuple[int, int, int]]


def _cells(x: int, y: int, z: int) -> Cells:
    return [(i, j, k) for i in range(x) for j in range(y) for k in range(z)]


def _lattice(cells: Cells, colors: bool) -> Scene:
    """Cubes that touch, each a mesh of its own, around the origin. Sides that touch have unlike colours: what is hidden
    must not show in the gradient."""
    index = torch.tensor(cells, dtype=F64)
    places = CELL * (index - 0.5 * index.amax(0))
    generator = torch.Generator().manual_seed(0)
    meshes = []
    for place in places:
        sides = torch.rand((6, 3), dtype=F64, generator=generator)
        box = one_color(cube(0.5 * CELL).transformed(t=place).transformed(t=IN_PLACE))
        meshes.append(box.replace(face_colors=sides.repeat_interleave(2, 0)) if colors else box)
    return Scene(meshes, background())


def isometric(size: int = 48, height: float = 2.4) -> Camera:
    return Camera.orthographic((4.0, 4.0, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), height=height, size=(size, size))


def in_side_planes(size: int = 48) -> Camera:
    """Perspective; the eye lies where sides of a lattice of even counts meet: in the planes x and y of IN_PLACE. Their
    lines are kept off the borders of pixels, where the box filter jumps."""
    x, y, _ = IN_PLACE.tolist()
    camera = upright(vector(x, y, 4.0), size, 1.3 * size)
    return camera.replace(K=camera.K + torch.tensor([[0, 0, 0.31], [0, 0, 0.27], [0, 0, 0]], dtype=F64))


@group.add("lattice-behind", "two cubes that touch, one behind the other, straight on", _cells(1, 1, 2), along_axes())
@group.add("lattice-behind-plain", "the same in one colour", _cells(1, 1, 2), along_axes(), False)
@group.add("lattice-straight", "2 × 2 × 2 cubes that touch, straight on", _cells(2, 2, 2), along_axes())
@group.add(
    "lattice-steps",
    "3 × 2 × 2 cubes less three, straight on",
    sorted({*_cells(3, 2, 2)} - {(0, 0, 1), (2, 1, 1), (1, 1, 1)}),
    along_axes(),
)
@group.add("lattice-isometric", "2 × 2 × 2 cubes that touch, isometric", _cells(2, 2, 2), isometric())
@group.add("lattice-isometric-dent", "the same without the cube in front", _cells(2, 2, 2)[:-1], isometric())
@group.add(
    "lattice-perspective", "2 × 2 × 2 cubes that touch, the eye in their side planes", _cells(2, 2, 2), in_side_planes()
)
@group.add("lattice-plate", "a cube on a plate of 3 × 3, from above", [*_cells(3, 3, 1), (1, 1, 1)], along_axes())
def lattice(cells: Cells, camera: Camera, colors: bool = True) -> Problem:
    """Moved as a whole: a cube moved alone has a derivative for each direction."""
    return rigid(_lattice(cells, colors), camera, centre=IN_PLACE)
