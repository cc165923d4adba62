"""Rooms in which light goes to and fro, for tests of bounces."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from lit_scenes import vector
from scenes import icosphere
from torch import Tensor

import edgegrad as eg

F64 = torch.float64
_QUAD = torch.tensor([[0, 1, 2], [0, 2, 3]])


def quad(*corners: tuple[float, float, float], **material: Any) -> eg.Mesh:
    return eg.Mesh(torch.tensor(corners, dtype=F64), _QUAD, material=eg.Material(**material))


def block(low: tuple[float, float, float], high: tuple[float, float, float], **material: Any) -> eg.Mesh:
    """A box between two corners."""
    ends = list(zip(low, high, strict=True))
    verts = torch.tensor([[x, y, z] for x in ends[0] for y in ends[1] for z in ends[2]], dtype=F64)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = torch.tensor([[a, b, c] for a, b, c, _ in quads] + [[a, c, d] for a, _, c, d in quads])
    return eg.Mesh(verts, faces, material=eg.Material(**material))


def emitter(side: float = 0.4, height: float = 1.9, power: float = 6.0) -> eg.Mesh:
    """Square, below the ceiling, that shines down."""
    s = side
    return quad((-s, -s, height), (-s, s, height), (s, s, height), (s, -s, height),
                base_color=0.0, emission=vector(power, 0.9 * power, 0.7 * power), two_sided=False)  # fmt: skip


def box_room(lights: str = "emitter", floor: dict[str, Any] | None = None, **of_block: Any) -> eg.Scene:
    """|x|, |y| < 1, 0 < z < 2, open towards −y, with walls in colours and a block inside."""
    white, red, green = vector(0.75, 0.75, 0.75), vector(0.7, 0.15, 0.1), vector(0.15, 0.6, 0.2)
    meshes = [
        quad((-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0), **(floor or {"base_color": white})),
        quad((-1, 1, 0), (1, 1, 0), (1, 1, 2), (-1, 1, 2), base_color=white),
        quad((-1, -1, 0), (-1, 1, 0), (-1, 1, 2), (-1, -1, 2), base_color=red),
        quad((1, -1, 0), (1, -1, 2), (1, 1, 2), (1, 1, 0), base_color=green),
        block((-0.5, -0.2, 0.2), (0.1, 0.5, 0.9), **({"base_color": white} | of_block)),
    ]
    if lights != "sky":
        meshes.append(quad((-1, -1, 2), (-1, 1, 2), (1, 1, 2), (1, -1, 2), base_color=white))
    given: list[Any] = []
    if lights == "emitter":
        meshes.append(emitter())
    elif lights == "point":
        given.append(eg.lights.PointLight(vector(0.5, -0.3, 1.7), 4.0))
    else:
        given.append(eg.lights.Environment(vector(0.9, 1.0, 1.2)))
    return eg.Scene(meshes, lights=given)


def towards_room(size: int = 32) -> eg.Camera:
    return eg.Camera.look_at((0.0, -3.4, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 1.0), fov_y=38.0, size=(size, size))


# -- a room each for what light can meet ----------------------------------------------------------------------------------


def _with(room: eg.Scene, number: int, **fields: Any) -> eg.Scene:
    """Return the room with one of its meshes changed."""
    meshes = list(room.meshes)
    meshes[number] = meshes[number].replace(**fields)
    return room.replace(meshes=meshes)


def _square_uvs(mesh: eg.Mesh) -> dict[str, Tensor]:
    """Return texture coordinates of a quad whose first side is along u."""
    return {"uvs": torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64), "uv_faces": mesh.faces}


def sky() -> Tensor:
    """(16, 32, 3): brighter above, with a sun of some texels."""
    image = torch.linspace(1.2, 0.3, 16, dtype=F64)[:, None, None] * vector(0.8, 0.9, 1.1) * torch.ones(16, 32, 1)
    image[5:7, 20:22] = 25.0
    return image


def _pattern() -> Tensor:
    """(8, 8, 3) of colours that neighbours do not share."""
    return 0.1 + 0.8 * torch.rand(8, 8, 3, dtype=F64, generator=torch.Generator().manual_seed(0))


def _bumps() -> Tensor:
    """(8, 8, 3): a normal map."""
    slopes = 0.35 * (torch.rand(8, 8, 2, dtype=F64, generator=torch.Generator().manual_seed(0)) * 2 - 1)
    normals = torch.cat([slopes, torch.ones(8, 8, 1, dtype=F64)], 2)
    return 0.5 + 0.5 * torch.nn.functional.normalize(normals, dim=2)


def _ball(radius: float, centre: tuple[float, float, float], subdivisions: int, **material: Any) -> eg.Mesh:
    ball = icosphere(subdivisions)
    return eg.Mesh(radius * ball.verts.to(F64) + vector(*centre), ball.faces, material=eg.Material(**material))


def textured_room() -> eg.Scene:
    room = box_room()
    material = eg.Material(eg.Texture(_pattern()))
    for number in (0, 1):
        room = _with(room, number, material=material, **_square_uvs(room.meshes[number]))
    return room


def bumpy_room() -> eg.Scene:
    room = box_room()
    material = eg.Material(0.7, normal_map=eg.Texture(_bumps()))
    return _with(room, 0, material=material, **_square_uvs(room.meshes[0]))


def room_lit_by(*meshes: eg.Mesh) -> eg.Scene:
    """Meshes in place of the light."""
    room = box_room()
    return room.replace(meshes=[*room.meshes[:-1], *meshes])


def metal_room() -> eg.Scene:
    """A ball of rough metal in place of the block."""
    room = box_room()
    ball = _ball(0.45, (-0.1, 0.1, 0.5), 2, base_color=vector(0.95, 0.8, 0.5), metallic=1.0, roughness=0.4)
    return room.replace(meshes=[*room.meshes[:4], ball, *room.meshes[5:]])


def sheets_room() -> eg.Scene:
    """Two sheets, one of which is black from behind."""
    room = box_room()
    sheets = [
        quad((-0.7, -0.3, 0.3), (-0.1, -0.3, 0.3), (-0.1, 0.3, 1.0), (-0.7, 0.3, 1.0), base_color=0.8),
        quad((0.2, -0.2, 0.4), (0.2, 0.4, 0.4), (0.6, 0.4, 1.1), (0.6, -0.2, 1.1), base_color=0.8, two_sided=False),
    ]
    return room.replace(meshes=[*room.meshes[:4], *sheets, *room.meshes[5:]])


STRIPES = 8


def striped_room(as_quads: bool = False) -> eg.Scene:
    """A screen before the light, of which alpha cuts out every second stripe; or the stripes that are left, as quads."""
    room = box_room()
    screen = quad((-0.6, -0.6, 1.5), (0.6, -0.6, 1.5), (0.6, 0.6, 1.5), (-0.6, 0.6, 1.5), base_color=0.5)
    if as_quads:
        at = [-0.6 + 1.2 * k / STRIPES for k in range(STRIPES + 1)]
        low_high = list(zip(at[::2], at[1::2], strict=False))
        left = [quad((a, -0.6, 1.5), (b, -0.6, 1.5), (b, 0.6, 1.5), (a, 0.6, 1.5), base_color=0.5) for a, b in low_high]
    else:
        # Between two texels, of 1 and 0, it falls below a half at their border.
        alpha = (1.0 - torch.arange(STRIPES, dtype=F64) % 2).expand(2, STRIPES)
        left = [screen.replace(alpha=alpha, **_square_uvs(screen))]
    return room.replace(meshes=[*room.meshes, *left])


ROOMS: dict[str, Callable[[], eg.Scene]] = {
    "emitter": box_room,
    "glossy block": lambda: box_room(roughness=0.3),
    "sky": lambda: box_room("sky"),
    "sky through an opening": lambda: box_room("point").replace(lights=[eg.lights.Environment(sky())]),
    "point": lambda: box_room("point"),
    "spot": lambda: box_room("point").replace(
        lights=[
            eg.lights.SpotLight(vector(0.5, -0.3, 1.9), vector(-0.4, 0.3, -1.0), 8.0, inner_angle=0.3, outer_angle=0.7)
        ]
    ),
    "sun": lambda: box_room("sky").replace(lights=[eg.lights.DirectionalLight(vector(0.3, 0.5, -1.0), 3.0)]),
    "textured walls": textured_room,
    "normal map": bumpy_room,
    "small light": lambda: room_lit_by(_ball(0.05, (0.3, -0.2, 1.6), 1, base_color=0.0, emission=120.0)),
    "large light": lambda: room_lit_by(_ball(0.35, (0.3, -0.2, 1.4), 2, base_color=0.5, emission=2.0)),
    "metal ball": metal_room,
    "two sheets": sheets_room,
    "alpha-tested": striped_room,
}


def without_alpha(name: str) -> eg.Scene:
    """Return the same room for renderers that know no alpha-tested faces."""
    return striped_room(as_quads=True) if name == "alpha-tested" else ROOMS[name]()
