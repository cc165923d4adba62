"""Scenes that show light that other surfaces scatter, what moves in them, and how images of that light alone change.

A change over [−h, h] is compared with the mean of the derivative there (Gauss and Legendre, three points), so that h may be large
and the difference quiet.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from finite_differences import Case, Estimate, estimate
from room_scenes import F64
from sampling_options import with_sampling
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel
from edgegrad.light.radiance import CLOSER_STEPS
from edgegrad.points.image_context import ImageContext
from edgegrad.scene.lights import Light

Places = Sequence[Sequence[float]] | Tensor
GAUSS = ((-math.sqrt(0.6), 5 / 18), (0.0, 8 / 18), (math.sqrt(0.6), 5 / 18))
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
SIZE = 32
QUAD = [[0, 1, 2], [0, 2, 3]]
BOX = [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6],
       [1, 3, 5], [3, 7, 5]]  # fmt: skip


class BounceScene(NamedTuple):
    """Meshes by name, of one channel, and a camera that sees them."""

    meshes: dict[str, eg.Mesh]
    camera: eg.Camera
    lights: tuple[Light, ...] = ()

    def moving(self, name: str, by: Sequence[float], vertex: int | None = None) -> Case:
        """Return the scene as a mesh, or one of its vertices, moves by θ times a direction."""

        def case(theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
            mesh = self.meshes[name]
            direction = torch.zeros_like(mesh.verts)
            direction[slice(None) if vertex is None else vertex] = torch.tensor(by, dtype=F64)
            moved = self.meshes | {name: mesh.replace(verts=mesh.verts + theta * direction)}
            return eg.Scene(list(moved.values()), lights=list(self.lights)), self.camera

        return case


def mesh(verts: Places, faces: list[list[int]], albedo: float | list[float], emission: float = 0.0) -> eg.Mesh:
    """Return a mesh with albedos of its faces; one that emits does so from its front."""
    colors = torch.as_tensor(albedo, dtype=F64).expand(len(faces)).reshape(-1, 1).clone()
    shines: dict[str, Any] = {"emission": torch.tensor([emission], dtype=F64), "two_sided": False} if emission else {}
    material = eg.Material(**shines)
    return eg.Mesh(torch.as_tensor(verts, dtype=F64), torch.tensor(faces), face_colors=colors, material=material)


def block(
    centre: Sequence[float], half: Sequence[float], turn: float, tilt: float = 0.0, albedo: float = 0.6
) -> eg.Mesh:
    corners = torch.tensor([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], dtype=F64)
    a, b = math.cos(turn), math.sin(turn)
    around_y = torch.tensor([[a, 0, -b], [0, 1, 0], [b, 0, a]], dtype=F64)
    a, b = math.cos(tilt), math.sin(tilt)
    around_x = torch.tensor([[1, 0, 0], [0, a, -b], [0, b, a]], dtype=F64)
    placed = (corners * torch.tensor(half, dtype=F64)) @ around_y.T @ around_x.T + torch.tensor(centre, dtype=F64)
    return mesh(placed, BOX, albedo)


def room() -> eg.Mesh:
    """[−1, 1]³, open towards +z, welded: floor, back, ceiling, and walls to the left and to the right."""
    corners = [[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)]
    faces = [
        [0, 4, 1],
        [1, 4, 5],
        [0, 1, 2],
        [1, 3, 2],
        [2, 3, 6],
        [3, 7, 6],
        [0, 2, 4],
        [2, 6, 4],
        [1, 5, 3],
        [3, 5, 7],
    ]
    return mesh(corners, faces, [0.7] * 6 + [0.8] * 2 + [0.25] * 2)


def panel(centre: Sequence[float], half: tuple[float, float], down: bool = True) -> eg.Mesh:
    """A light that shines down or up."""
    (x, y, z), (p, q) = centre, half
    corners = [[x - p, y, z - q], [x + p, y, z - q], [x + p, y, z + q], [x - p, y, z + q]]
    return mesh(corners, QUAD if down else [[0, 2, 1], [0, 3, 2]], 0.0, 8.0)


def seen_from(eye: Sequence[float], target: Sequence[float], tangent: float) -> eg.Camera:
    """`tangent`: of half of the field of view."""
    degrees = 2 * math.degrees(math.atan(tangent))
    return eg.Camera.look_at(eye, target, (0.0, 1.0, 0.01), degrees, (SIZE, SIZE)).to(F64)


def before_room() -> eg.Camera:
    return seen_from((0.1, 0.2, 3.6), (0.0, -0.1, 0.0), 0.42)


def cornell() -> BounceScene:
    """A room with a light and a block that floats."""
    floating = block((0.15, -0.35, 0.1), (0.3, 0.35, 0.3), 0.4, 0.15)
    return BounceScene(
        {"room": room(), "emitter": panel((0.1, 0.97, 0), (0.3, 0.25)), "block": floating}, before_room()
    )


def standing() -> BounceScene:
    """The block stands on the floor."""
    on_floor = block((0.15, -0.65, 0.1), (0.3, 0.35, 0.3), 0.4)
    return BounceScene(
        {"room": room(), "emitter": panel((0.1, 0.97, 0), (0.3, 0.25)), "block": on_floor}, before_room()
    )


def emitter_upwards() -> BounceScene:
    """The light shines at the ceiling alone, of which a shelf shadows a part; floor and block are lit by the bounce."""
    return BounceScene(
        {
            "room": room(),
            "emitter": panel((-0.2, 0.3, 0), (0.25, 0.25), down=False),
            "shelf": block((0.25, 0.55, 0.05), (0.25, 0.03, 0.3), 0.5, 0.1, albedo=0.5),
            "block": block((0.15, -0.45, 0.1), (0.3, 0.25, 0.3), 0.4, 0.15),
        },
        before_room(),
    )


def under_sky() -> BounceScene:
    """A block over the ground, under a sky that is even. Nothing comes between two points of these surfaces."""
    ground = [[-2.2, -0.6, -2.2], [-2.2, -0.6, 2.2], [2.2, -0.6, 2.2], [2.2, -0.6, -2.2]]
    floating = block((0.1, 0.25, 0), (0.5, 0.4, 0.45), 0.5, 0.2, albedo=0.7)
    camera = seen_from((0.6, 1.6, 4.0), (0.0, 0.0, 0.0), 0.4)
    sky = eg.lights.Environment(torch.ones(1, dtype=F64), visible=False)
    return BounceScene({"block": floating, "ground": mesh(ground, QUAD, 0.6)}, camera, (sky,))


def plates() -> BounceScene:
    """A plate on the left is lit by a light, one on the right is seen and lit by the first alone, a strip is between them."""
    left = [[-1, -0.8, -0.8], [-1, 0.8, -0.8], [-1, 0.8, 0.8], [-1, -0.8, 0.8]]
    right = [[1, -1.2, -1.2], [1, -1.2, 1.2], [1, 1.2, 1.2], [1, 1.2, -1.2]]
    strip = [[0.1, -0.5, -0.2], [0.15, 0.6, -0.25], [0.1, 0.55, 0.2], [0.05, -0.5, 0.25]]
    emitter = [[-0.2, 1.2, -0.4], [-0.2, 1.2, 0.4], [-0.4, 1.6, 0.4], [-0.4, 1.6, -0.4]]
    meshes = {
        "left": mesh(left, QUAD, 0.9),
        "right": mesh(right, QUAD, 0.8),
        "strip": mesh(strip, QUAD, 0.0),
        "emitter": mesh(emitter, QUAD, 0.0, 12.0),
    }
    return BounceScene(meshes, seen_from((-1.2, 0.9, 3.4), (0.6, 0, 0), 0.36))


def open_plates() -> BounceScene:
    """Return the same scene without the strip: no secondary edge moves."""
    found = plates()
    return found._replace(meshes={name: mesh for name, mesh in found.meshes.items() if name != "strip"})


def ball() -> BounceScene:
    """A sphere of 1,280 faces in the room."""
    sphere = icosphere(3)
    verts = 0.4 * sphere.verts.to(F64) + torch.tensor([0.15, -0.35, 0.1], dtype=F64)
    round_ = eg.Mesh(verts, sphere.faces, material=eg.Material(torch.tensor([0.6], dtype=F64)))
    return BounceScene({"room": room(), "emitter": panel((0.1, 0.97, 0), (0.3, 0.25)), "ball": round_}, before_room())


def sunk() -> BounceScene:
    """The block is sunk into the floor, and leans."""
    found = cornell()
    return found._replace(meshes=found.meshes | {"block": block((0.15, -0.85, 0.1), (0.3, 0.35, 0.3), 0.4, 0.15)})


def shelf() -> BounceScene:
    """A shelf is stuck through a wall, and a light shines at the ceiling."""
    board, emitter = (
        block((-0.9, -0.1, 0.1), (0.5, 0.05, 0.5), 0.2, 0.1),
        panel((-0.3, 0.3, 0), (0.3, 0.25), down=False),
    )
    return BounceScene({"room": room(), "emitter": emitter, "shelf": board}, before_room())


def leaf() -> BounceScene:
    """A sheet in the room of which alpha masks all but a leaf."""
    corners = torch.tensor([[-0.4, -0.6, 0.4], [0.6, -0.65, 0.35], [0.6, 0.05, -0.4], [-0.4, 0.0, -0.35]], dtype=F64)
    at = (torch.arange(6, dtype=F64) + 0.5) / 6
    away = ((at[:, None] - 0.52) ** 2 + (at[None, :] - 0.45) ** 2).sqrt()
    alpha = (1.2 - 2.0 * away * (1 + 0.3 * torch.sin(7 * at[None, :]))).clamp(0.05, 0.95)
    uvs, faces = torch.tensor([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64), torch.tensor(QUAD)
    own = eg.Mesh(
        corners, faces, uvs=uvs, uv_faces=faces, alpha=alpha, material=eg.Material(torch.tensor([0.6], dtype=F64))
    )
    return BounceScene({"room": room(), "emitter": panel((0.1, 0.97, 0), (0.3, 0.25)), "leaf": own}, before_room())


def texels() -> BounceScene:
    """The block has texels of which the nearest is taken."""
    found = cornell()
    own = found.meshes["block"]
    texture = eg.Texture(torch.rand(4, 4, 1, dtype=F64, generator=torch.Generator().manual_seed(1)), filter="nearest")
    uvs = 1.5 * own.verts[:, :2]
    own = own.replace(face_colors=None, uvs=uvs, uv_faces=own.faces, material=eg.Material(texture))
    return found._replace(meshes=found.meshes | {"block": own})


# A mesh that moves, its direction, and the vertex that alone does.
Motion = tuple[str, tuple[float, float, float]] | tuple[str, tuple[float, float, float], int]
ASKEW = (1.0, 0.5, -0.3)
SCENES: dict[str, tuple[Callable[[], BounceScene], dict[str, Motion]]] = {
    "cornell": (
        cornell,
        {
            "block x": ("block", X),
            "block y": ("block", Y),
            "block vertex": ("block", ASKEW, 7),
            "light x": ("emitter", X),
        },
    ),
    "standing": (standing, {"block x": ("block", X), "block z": ("block", Z)}),
    "light upwards": (emitter_upwards, {"block x": ("block", X), "shelf x": ("shelf", X), "light x": ("emitter", X)}),
    "under sky": (
        under_sky,
        {"block y": ("block", Y), "block vertex": ("block", ASKEW, 7), "ground y": ("ground", Y)},
    ),
    "plates": (
        plates,
        {
            "strip y": ("strip", Y),
            "strip z": ("strip", Z),
            "right x": ("right", X),
            "right vertex": ("right", (1.0, 0.3, 0.2), 2),
            "left x": ("left", X),
            "left y": ("left", Y),
            "light y": ("emitter", Y),
        },
    ),
    "open plates": (
        open_plates,
        {"right vertex": ("right", (1.0, 0.3, 0.2), 2), "left y": ("left", Y), "light y": ("emitter", Y)},
    ),
    "texels": (texels, {"block x": ("block", X)}),
    "sunk": (sunk, {"block x": ("block", X), "block y": ("block", Y)}),
    "shelf": (shelf, {"shelf x": ("shelf", X)}),
    "leaf": (leaf, {"leaf y": ("leaf", Y)}),
    "ball": (ball, {"ball x": ("ball", X), "ball y": ("ball", Y)}),
}


def case_of(scene: str, motion: str) -> Case:
    make, motions = SCENES[scene]
    name, by, *vertex = motions[motion]
    return make().moving(name, by, *vertex)


@functools.cache
def adjoint() -> Tensor:
    """(SIZE, SIZE) by which the pixels of an image count."""
    at = (torch.arange(SIZE, dtype=F64) + 0.5) / SIZE
    x, y = at[None, :], at.flip(0)[:, None]
    return 0.6 + 0.35 * torch.cos(2.1 * x + 3.3 * y + 0.4) + 0.2 * torch.sin(5 * x - 2 * y)


def indirect_loss(scene: eg.Scene, camera: eg.Camera, spp: int, seed: int, bounces: int) -> float:
    """The weighted mean of an image of what light gives that is scattered more than once, a path for each sample."""
    frame = ImageContext(scene, make_request(scene, camera, spp, seed))
    total = 0.0
    with torch.no_grad():
        for _, found in frame.sampler.pixel_hits(1 << 17, spp):
            seeds = frame.seeds_of_pixels("image", found.pixel, spp)
            hits = frame.fixed_hits(found.face, found.b, found.x, seeds)
            L = in_kernel.indirect(hits, True, bounces)[:, 0]
            total += float((adjoint().reshape(-1)[found.pixel] * found.weight * L.double()).sum())
    return total / SIZE**2


def indirect_change(case: Case, h: float, spp: int, seeds: int, bounces: int = 2) -> Estimate:
    """(loss(h) − loss(−h)) / 2h, by images alone."""
    values = []
    for seed in range(seeds):
        high, low = (indirect_loss(*case(torch.tensor(x, dtype=F64)), spp, seed, bounces) for x in (h, -h))
        values.append((high - low) / (2 * h))
    return estimate(values)


def indirect_gradient(case: Case, h: float, seeds: int, bounces: int = 2, **options: Any) -> Estimate:
    """Its mean derivative over [−h, h]: what further bounces add to the gradient of direct light, which the same samples have."""
    values = [0.0] * seeds
    for seed in range(seeds):
        for at, share in GAUSS:
            for sign, n in ((1, bounces), (-1, 1)):
                theta = torch.tensor(at * h, dtype=F64, requires_grad=True)
                spacing = 1.0 if n > 1 else 1 / CLOSER_STEPS  # of the same samples
                image = eg.render(
                    *case(theta),
                    1,
                    1000 + seed,
                    bounces=n,
                    **with_sampling(options, discontinuity_spacing=spacing),
                )
                (slope,) = torch.autograd.grad((adjoint()[:, :, None] * image).sum() / SIZE**2, theta)
                values[seed] += sign * share * float(slope)
    return estimate(values)
