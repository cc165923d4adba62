"""Lit scenes: lights of any distance and power, on and in what they light, rough and smooth surfaces, casters in contact."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import torch
from oracles.lit_image import lit_image
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.sampling import Sampling
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import DirectionalLight, Light, PointLight, SpotLight
from edgegrad.scene.material import Material
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene
from edgegrad.shapes import rectangle

from ...scenes import cube, icosphere
from .camera import ORIGIN, vector
from .case import F64, Group, Parts, Problem, View

group = Group("light")

MakeLight = Callable[
    [Tensor, Tensor], "Light | Mesh"
]  # from where it is and how bright: 1, or what that is differentiated by
LIGHT_AT = vector(1.1, -0.7, 2.4)
EYE = vector(1.2, -3.5, 2.6)
BASE = vector(0.8, 0.6, 0.4)
ANY = {  # what moves, and along which directions (n, 3)
    "caster": torch.stack([vector(1.0, 0.3, 0.2), vector(-0.2, 0.9, 0.5)]),
    "receiver": vector(0.1, 0.2, 1.0)[None],
    "light": torch.stack([vector(1.0, 0.3, 0.2), vector(-0.3, 1.0, -0.4)]),
    "camera": torch.stack([vector(1.0, 0.2, 0.3), vector(-0.1, 0.9, 0.6)]),
}
# At borders a tenth of the noise that the default leaves in a picture of 32², which is made for speed.
MANY_EDGES = {"sampling": Sampling(lights=4, edges=10_000)}
STANDING = {**ANY, "caster": torch.stack([vector(1.0, 0.4, 0.0), vector(-0.3, 1.0, 0.0)]), "receiver": None}


def point(power: float = 10.0) -> MakeLight:
    return lambda at, level: PointLight(at, power * level)


def panel(power: float = 8.0, two_sided: bool = True) -> MakeLight:
    u, v = vector(0.4, 0.0, 0.1), vector(0.0, 0.3, 0.0)
    return lambda at, level: rectangle(
        at, u, v, material=Material(base_color=0.0, emission=power * level, two_sided=two_sided)
    )


def ground(size: float = 4.0) -> Mesh:
    verts = size * torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    return Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def box(x: float, y: float, z: float, centre: Tensor, turn: Tensor | None = None) -> Mesh:
    """Return a box with these half sides."""
    mesh = cube(1.0)
    verts = mesh.verts * vector(x, y, z)
    return Mesh(verts if turn is None else verts @ rotation(turn).mT, mesh.faces).transformed(t=centre)


def floating() -> Mesh:
    return box(0.35, 0.3, 0.2, vector(0.0, 0.0, 0.9), vector(0.3, 0.2, 0.1))


def view(eye: Tensor = EYE, target: Tensor = ORIGIN, fov: float = 42.0, size: int = 32) -> Camera:
    return Camera.look_at(eye, target + vector(0, 0, 0.3), vector(0.0, 0.0, 1.0), fov, (size, size)).to(F64)


def adjoint(size: int = 32) -> Tensor:
    """Return a smooth adjoint image of one sign, with which shadow boundaries do not cancel."""
    y, x = torch.meshgrid(torch.arange(size) / size, torch.arange(size) / size, indexing="ij")
    return (
        (1.0 + 0.8 * torch.sin(5.0 * x + 2.0 * y - 2.2) + 0.1 * torch.cos(7.0 * y))
        .double()[..., None]
        .expand(-1, -1, 3)
    )


def stage(
    make_light: MakeLight,
    at: Tensor = LIGHT_AT,
    caster: Mesh | None = None,
    receiver: Mesh | None = None,
    camera: Camera | None = None,
    moves: Mapping[str, Tensor | None] = ANY,
    level: float = 1.0,
    far: float = 1.0,
    unit: float = 1.0,
    place: Tensor = ORIGIN,
    others: tuple[Mesh, ...] = (),
    material: Mapping[str, float] | None = None,
    equal: Mesh | None = None,
    dtype: torch.dtype = F64,
    step: float | Mapping[str, float] = 0.015,
    **fields: Any,
) -> Problem:
    """A caster over a receiver under a light; each moves along some directions, and so does the camera.

    far     by so much the light moves farther than the others
    unit    what is one unit here in the scene, in which that stands at `place`
    others  more meshes of the scene
    equal   a caster that casts the same shadow, of which finite differences are taken
    """
    caster, receiver, camera = caster or floating(), receiver or ground(), camera or view()
    parts: Parts = {name: torch.zeros(len(along), dtype=F64) for name, along in moves.items() if along is not None}
    parts |= {"brightness": torch.tensor([level], dtype=F64), "base colour": BASE}
    parts |= {name: torch.tensor([value], dtype=F64) for name, value in (material or {}).items()}

    def shift(parts: Parts, name: str) -> Tensor:
        along = moves.get(name)
        return torch.zeros(3, dtype=F64) if along is None else parts[name] @ along

    def build(parts: Parts, caster: Mesh) -> View:
        look = Material(base_color=parts["base colour"], **{name: parts[name] for name in material or {}})  # type: ignore[arg-type]
        meshes = []
        for name, mesh in (("receiver", receiver), ("caster", caster)):
            there = mesh.transformed(t=shift(parts, name)).transformed(scale=unit).transformed(t=place)
            meshes.append(there.replace(material=look))
        light = make_light(unit * (at + far * shift(parts, "light")) + place, parts["brightness"])
        M = camera.world_to_camera
        moved = M[:3, 3] * unit - M[:3, :3] @ place + unit * shift(parts, "camera")
        M = torch.cat([torch.cat([M[:3, :3], moved[:, None]], 1), M[3:]])
        scene = Scene([*meshes, *(mesh.replace(material=look) for mesh in others)], lights=[light])
        return scene.to(dtype), camera.replace(world_to_camera=M)

    def alike(parts: Parts) -> View:
        return build(parts, equal or caster)

    steps = {name: 0.1 * max(level, 1.0) if name == "brightness" else 0.05 for name in parts}
    steps |= {name: 0.005 * value for name, value in (material or {}).items() if value > 0}
    steps |= {name: step[name] if isinstance(step, Mapping) else step for name in moves if name in parts}
    settings: dict[str, Any] = {
        "finer": 16, "options": {"sampling": Sampling(lights=4)}, "adjoint": adjoint(),
        "image": lambda scene, camera: lit_image(scene, camera, 6, 8), **fields,
    }  # fmt: skip
    return Problem(
        parts, lambda parts: build(parts, caster), None, "finite differences", steps=steps, equal=alike,
        **settings,
    )  # fmt: skip


@group.add(
    "light-1e-3", "a point light, its caster and its view at 1e-3 of the size of a plane and a box beside them", 1e-3
)
def near(unit: float) -> Problem:
    other = box(0.4, 0.3, 0.5, vector(-0.9, 0.6, 0.5))
    return stage(
        point(10.0 * unit**2), receiver=ground(2.0 / unit), unit=unit, place=vector(0.3, 0.2, 0.0), others=(other,)
    )


@group.add("light-1e5", "a point light 1e5 times the scene's size away", 1e5)
def distant(distance: float) -> Problem:
    at = LIGHT_AT / LIGHT_AT.norm() * distance
    return stage(point(distance**2), at, far=distance)


@group.add("dim", "an intensity of 1e-8, float32", 1e-8)
@group.add("bright", "an intensity of 1e8, float32", 1e8)
def intensity(power: float) -> Problem:
    return stage(point(power), dtype=torch.float32, zero=1e-9 * power)


@group.add("zero-point", "a point light of intensity zero", point())
@group.add("zero-panel", "a panel that emits nothing", panel())
@group.add("zero-sky", "a black environment", lambda at, level: Environment(level * torch.ones(1), visible=False))
def dark(make_light: MakeLight) -> Problem:
    return stage(make_light, level=0.0)


@group.add("on-face", "a point light exactly on a side of a box; both move along it")
def on_face() -> Problem:
    along = torch.stack([vector(0.0, 1.0, 0.3), vector(0.0, -0.2, 1.0)])
    moves = {**ANY, "caster": along, "light": along}
    # The side stays where it is, so the box alone casts the same shadow.
    return stage(
        point(4.0), vector(0.25, -0.1, 0.75), box(0.5, 0.45, 0.4, vector(-0.25, 0.0, 0.7)), moves=moves, step=0.005,
        zero=0.005,
    )  # fmt: skip


@group.add("in-plane", "a point light exactly in the plane of a box's side; both move along it")
def in_plane() -> Problem:
    along = torch.stack([vector(0.0, 1.0, 0.3), vector(0.0, -0.2, 1.0)])
    return stage(
        point(), vector(0.25, -0.1, 2.4), box(0.25, 0.3, 0.2, vector(0.0, 0.0, 0.8)),
        moves={**ANY, "caster": along, "light": along},
    )  # fmt: skip


@group.add("in-mesh", "a point light inside of a closed box, seen from outside: no light comes out")
def in_mesh() -> Problem:
    # Rays to its very edges, as floats have them, meet a face from behind.
    return stage(point(), vector(0.02, 0.03, 0.85), zero=0.01)


@group.add("in-room", "light, camera and caster inside of a closed box")
def in_room() -> Problem:
    return stage(
        point(),
        vector(0.9, -0.6, 2.3),
        floating(),
        box(2.0, 4.0, 1.5, vector(0.0, 0.0, 1.5)),
        moves={**ANY, "receiver": None},
    )


@group.add("behind-camera", "a point light behind the camera", more=4)
def behind() -> Problem:
    return stage(point(60.0), 1.9 * EYE + vector(1.5, 0.0, 1.0))


@group.add("spot-rim", "a spot light whose rim falls off over 0.05 rad")
def spot() -> Problem:
    axis = vector(-1.1, 0.7, -2.1)

    def make_light(at: Tensor, level: Tensor) -> SpotLight:
        return SpotLight(at, axis, 10.0 * level, inner_angle=0.22, outer_angle=0.27)

    # As the camera comes nearer the rim grows: where it only shifts, nearly all cancels.
    moves = {**ANY, "receiver": None, "camera": -EYE[None] / EYE.norm()}
    return stage(make_light, moves=moves, options={"sampling": Sampling(surface=100_000)})


@group.add("sun-low", "a sun 3° above the plane", more=2)
def low_sun() -> Problem:
    # The tip of the shadow moves nineteen times as far as the box rises: short steps, of finer images.
    return stage(
        lambda at, level: DirectionalLight(-at, 5.0 * level), vector(0.8, -0.6, math.tan(math.radians(3.0))),
        box(0.4, 0.4, 0.12, vector(0.0, 0.0, 0.2)), finer=64, options=MANY_EDGES,
        step={"caster": 0.01, "receiver": 0.004, "light": 0.01, "camera": 0.01},
    )  # fmt: skip


@group.add("rough-1", "roughness 1", 1.0, 0.0)
@group.add(
    "rough-0.01", "roughness 0.0101, beside the least there is: the highlight is narrower than a pixel", 0.0101, 0.0
)
@group.add("rough-metal", "roughness 1, all metal", 1.0, 1.0, more=12)
def rough(roughness: float, metallic: float) -> Problem:
    # Differences for a caster of metal fall by 3 % from a step of 0.015 to half of it, and by less than 1 % from there.
    step = {**dict.fromkeys(ANY, 0.015), "caster": 0.0075 if metallic else 0.015}
    return stage(point(), material={"roughness": roughness, "metallic": metallic}, step=step)


@group.add("opposed", "interpolated normals that oppose the faces of a sphere", more=4)
def opposed() -> Problem:
    ball = icosphere(2).transformed(scale=0.4).transformed(t=vector(0.0, 0.0, 0.8))
    ball = Mesh(ball.verts, ball.faces)
    return stage(point(), caster=ball.replace(normals=-ball.vertex_normals()))


@group.add("million", "a caster of 3.1 M faces", slow=True)
def million() -> Problem:
    """Each side of the box in fine squares; the float64 of the vertices keeps them flat."""
    many = {"sampling": Sampling(edges=300_000, surface=200_000)}
    return stage(point(), caster=_fine(floating(), 9), equal=floating(), options=many)


def _fine(mesh: Mesh, halvings: int) -> Mesh:
    verts, faces = mesh.verts, mesh.faces.long()
    for _ in range(halvings):
        edges = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).sort(1).values
        unique, row = torch.unique(edges, dim=0, return_inverse=True)
        ab, bc, ca = (row + len(verts)).reshape(3, -1)
        a, b, c = faces.unbind(1)
        verts = torch.cat([verts, verts[unique].mean(1)])
        faces = torch.cat([torch.stack(t, 1) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return Mesh(verts, faces)


@group.add("lit-standing", "a box that stands on the plane, under a point light", point())
@group.add("lit-standing-panel", "a box that stands on the plane, under a panel", panel())
def standing(make_light: MakeLight) -> Problem:
    return stage(make_light, caster=box(0.35, 0.3, 0.4, vector(0.0, 0.0, 0.4), vector(0.0, 0.0, 0.3)), moves=STANDING)


@group.add("lit-touching", "a sphere that touches the plane in a vertex", more=4)
def touching() -> Problem:
    ball = icosphere(2)
    ball = Mesh(ball.verts, ball.faces).transformed(scale=0.45)
    ball = ball.transformed(t=vector(0.0, 0.0, -float(ball.verts[:, 2].min())))
    return stage(point(), caster=ball, moves=STANDING, options=MANY_EDGES)


@group.add("panel-1e-3", "a panel of 1e-3 of the scene's size")
def small_panel() -> Problem:
    u, v = vector(4e-4, 0.0, 1e-4), vector(0.0, 3e-4, 0.0)
    return stage(lambda at, level: rectangle(at, u, v, material=Material(base_color=0.0, emission=8e6 * level)))


@group.add("sky-bright", "an environment with a texel 1e6 times as bright as the others")
def bright_sky() -> Problem:
    image = torch.full((8, 16, 1), 1e-3, dtype=F64)
    image[4, 14] = 1e3  # about where the light is
    many = {"sampling": Sampling(lights=4, edges=50_000, surface=50_000)}
    moves = {**ANY, "light": None, "caster": None}  # of the caster nearly all cancels
    return stage(
        lambda at, level: Environment(level * image, visible=False), moves=moves, options=many, spp=256, step=0.03,
        image=lambda scene, camera: lit_image(scene, camera, 4, 24),
    )  # fmt: skip


# -- of the test of unbiasedness ----------------------------------------------------------------------------------------


def torus(major: float = 0.55, minor: float = 0.22, around: int = 32, across: int = 16) -> Mesh:
    """Return a tilted torus with interpolated normals above the plane."""
    u, v = (2 * math.pi * torch.arange(n, dtype=F64) / n for n in (around, across))
    u, v = torch.meshgrid(u, v, indexing="ij")
    radius = major + minor * v.cos()
    verts = torch.stack([radius * u.cos(), radius * u.sin(), minor * v.sin()], -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(around), torch.arange(across), indexing="ij")

    def index(di: int, dj: int) -> Tensor:
        return ((i + di) % around * across + (j + dj) % across).reshape(-1)

    a, b, c, d = index(0, 0), index(1, 0), index(1, 1), index(0, 1)
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    verts = verts @ rotation(vector(0.9, 0.3, 0.0)).mT + vector(0.0, 0.0, 0.75)
    return Mesh(verts, faces, normals=Mesh(verts, faces).vertex_normals())


def _sun(at: Tensor, level: Tensor) -> DirectionalLight:
    return DirectionalLight(-at, 1.5 * level)


def _spot(at: Tensor, level: Tensor) -> SpotLight:
    return SpotLight(at, vector(-1.1, 0.7, -2.0), 10.0 * level, inner_angle=0.2, outer_angle=0.6)


def _sky(at: Tensor, level: Tensor) -> Environment:
    y, x = torch.meshgrid(torch.arange(8.0), torch.arange(16.0), indexing="ij")
    image = (0.3 + 2.0 * torch.exp(-((y - 2.5) ** 2 + (x - 5) ** 2) / 2)).double()[:, :, None]
    return Environment(level * image, visible=False)


def _closely(make_light: MakeLight, **fields: Any) -> Callable[[], Problem]:
    """Return a stage whose steps are so short that the error of finite differences is below their noise."""
    return lambda: stage(make_light, step=0.004, **fields)


LIT: dict[str, Callable[[], Problem]] = {
    "lit, point": _closely(point()),
    "lit, spot": _closely(_spot),
    "lit, sun": _closely(_sun),
    "lit, panel": _closely(panel()),
    "lit, environment": _closely(_sky),
    "lit, torus that shadows itself": _closely(point(), caster=torus()),
}
