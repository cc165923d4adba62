"""A case of the stability report: a scene, what may move in it, and the image it should have."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import torch
from oracles.exact import corner_colors, exact_image
from oracles.reference import render as twin
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ...scenes import smooth_adjoint

F64 = torch.float64
Parts = dict[str, Tensor]
View = tuple[Scene, Camera]
KINDS = ("colors", "face_colors", "corner_colors")  # of colours


@dataclass(frozen=True, eq=False)
class Problem:
    """A scene with its moving parts, and its reference. The loss is image · adjoint.

    parts      where the gradient is taken; that of each is compared relative to its own size
    make       parts ↦ (scene, camera)
    exact      parts ↦ the image (H, W, C) without sampling, differentiable; None where only finite differences can decide
    image      (scene, camera) ↦ the image without sampling, where there are finite differences
    equal      parts ↦ (scene, camera) with the same image, of which they are taken; `make` when None
    steps      of those, one for each part
    finer      so many times as many pixels each way, of which they take the mean (supersampling.py)
    zero       of the adjoint's norm: what a reference may be by rounding that is zero
    reference  in words
    """

    parts: Parts
    make: Callable[[Parts], View]
    exact: Callable[[Parts], Tensor] | None
    reference: str = "exact integrals"
    steps: dict[str, float] = field(default_factory=dict)
    image: Callable[[Scene, Camera], Tensor] = lambda scene, camera: twin(scene, camera, grid=16)
    equal: Callable[[Parts], View] | None = None
    finer: int = 1
    zero: float = 1e-9
    adjoint: Tensor | None = None  # (H, W, C), smooth_adjoint when None
    faint: bool = False  # the image's error is relative to all of it, not to what the scene adds to its background
    spp: int = 64
    options: dict[str, Any] = field(default_factory=lambda: {"sampling": Sampling(surface=20_000, edges=20_000)})

    def cotangent(self, image: Tensor) -> Tensor:
        return smooth_adjoint(*image.shape) if self.adjoint is None else self.adjoint


@dataclass(frozen=True)
class Case:
    """A row of the report."""

    group: str
    name: str
    extreme: str  # what is extreme about it, in words
    build: Callable[[], Problem]
    limit: str = ""  # why it cannot be right, where that is known
    most: float = 0.0  # relative error that a limit may show before it counts as wrong
    slow: bool = False
    more: int = 1  # times the seeds, where the gradient of a part is small next to its noise
    seeds: int = 512  # no more than these, where each takes long


class Group:
    """The cases of one kind: `add` as a decorator."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.cases: list[Case] = []
        self._last: tuple[Callable[..., Problem], int] | None = None

    def add(self, name: str, extreme: str, *arguments: Any, **fields: Any) -> Callable[[Callable[..., Problem]], Any]:
        """Return a decorator; its function, called with `arguments`, builds the problem of a case."""

        def register(build: Callable[..., Problem]) -> Callable[..., Problem]:
            # Decorators of one function come from the last to the first.
            if self._last is None or self._last[0] is not build:
                self._last = build, len(self.cases)
            self.cases.insert(self._last[1], Case(self.name, name, extreme, lambda: build(*arguments), **fields))
            return build

        return register


# -- what may move ----------------------------------------------------------------------------------------------------


def camera_parts(camera: Camera) -> tuple[Parts, Callable[[Parts], Camera]]:
    """Return as parts the camera's own motion q ↦ exp(turn) q + shift, and the numbers of K."""
    M, K = camera.world_to_camera.double(), camera.K.double()
    zeros = torch.zeros(3, dtype=F64)
    parts = {
        "camera turn": zeros, "camera shift": zeros.clone(), "focal length": K[[0, 1], [0, 1]],
        "skew": K[:1, 1], "principal point": K[:2, 2],
    }  # fmt: skip

    def make(parts: Parts) -> Camera:
        R = rotation(parts["camera turn"])
        upper = torch.cat([R @ M[:3, :3], (R @ M[:3, 3] + parts["camera shift"])[:, None]], 1)
        (fx, fy), (skew,), (cx, cy) = parts["focal length"], parts["skew"], parts["principal point"]
        zero = torch.zeros_like(fx)
        matrix = torch.stack([torch.stack([fx, skew, cx]), torch.stack([zero, fy, cy]), K[2]])
        return camera.replace(world_to_camera=torch.cat([upper, M[3:]]), K=matrix)

    return parts, make


def everything(
    scene: Scene,
    camera: Camera,
    shown: Callable[[Scene], Scene] = lambda scene: scene,
    equal: Callable[[Scene], Scene] = lambda scene: scene,
    names: Sequence[str] | None = None,
    colors: bool = True,
    camera_too: bool = True,
    **fields: Any,
) -> Problem:
    """All vertices, colours, background and camera of a scene are parts, as far as nothing else is said.

    shown  what is rendered, from the scene: the same surface in an extreme form
    equal  what the exact integrals are taken of: the same surface in a form that they can take
    names  of the meshes
    """
    names = names or ([""] if len(scene.meshes) == 1 else [f" {i}" for i in range(len(scene.meshes))])
    parts: Parts = {}
    for name, mesh in zip(names, scene.meshes, strict=True):
        parts[f"vertices{name}"] = mesh.verts
        for kind in KINDS if colors else ():
            if (value := getattr(mesh, kind)) is not None:
                parts[f"colours{name}"] = value
    if scene.background is not None:
        parts["background"] = scene.background
    view, look = camera_parts(camera)
    parts |= view if camera_too else {}

    def build(parts: Parts) -> View:
        meshes = []
        for name, mesh in zip(names, scene.meshes, strict=True):
            fields = {"verts": parts[f"vertices{name}"]}
            for kind in KINDS if colors else ():
                if getattr(mesh, kind) is not None:
                    fields[kind] = parts[f"colours{name}"]
            meshes.append(mesh.replace(**fields))
        return Scene(meshes, parts.get("background")), look(parts) if camera_too else camera

    return _problem(parts, build, shown, equal, **fields)


def rigid(
    scene: Scene,
    camera: Camera,
    shown: Callable[[Scene], Scene] = lambda scene: scene,
    equal: Callable[[Scene], Scene] = lambda scene: scene,
    directions: Tensor | None = None,
    centre: Tensor | None = None,
    turn: bool = False,
    colors: bool = True,
    **fields: Any,
) -> Problem:
    """The parts are motions of the whole scene, along `directions` (N, 3), larger about `centre` and turned about the origin,
    and its colours, unless two faces in the same place share what is seen of them.

    For scenes whose gradient for single vertices does not exist, as where edges coincide in the image: moved, one of them
    would come out on one side and stay hidden on the other.
    """
    directions = torch.eye(3, dtype=F64) if directions is None else directions
    centre = torch.zeros(3, dtype=F64) if centre is None else centre
    size = torch.cat([mesh.verts for mesh in scene.meshes]).double().sub(centre).norm(dim=1).max()
    parts = {"shift": torch.zeros(len(directions), dtype=F64), "growth": torch.zeros(1, dtype=F64)}
    if turn:
        parts["turn"] = torch.zeros(3, dtype=F64)
    for i, mesh in enumerate(scene.meshes if colors else ()):
        for kind in ("colors", "face_colors"):
            if (value := getattr(mesh, kind)) is not None:
                parts[f"colours {i}"] = value

    def build(parts: Parts) -> View:
        meshes = []
        R = rotation(parts["turn"]) if turn else torch.eye(3, dtype=F64)
        for i, mesh in enumerate(scene.meshes):
            arm = (mesh.verts.double() - centre) * (1.0 + parts["growth"] / size)
            arm = (arm[:, None, :] * R).sum(-1)  # row by row, so that equal vertices stay equal
            moved = (centre + arm + parts["shift"] @ directions).to(mesh.verts.dtype)
            kind = "colors" if mesh.colors is not None else "face_colors"
            look = {kind: parts[f"colours {i}"]} if f"colours {i}" in parts else {}
            meshes.append(mesh.replace(verts=moved, **look))
        return scene.replace(meshes=meshes), camera

    return _problem(parts, build, shown, equal, **fields)


def _problem(
    parts: Parts,
    build: Callable[[Parts], View],
    shown: Callable[[Scene], Scene],
    equal: Callable[[Scene], Scene],
    **fields: Any,
) -> Problem:
    def make(parts: Parts) -> View:
        scene, camera = build(parts)
        return shown(scene), camera

    def exact(parts: Parts) -> Tensor:
        scene, camera = build(parts)
        return exact_image(in_view(equal(scene), camera), camera)

    return Problem(parts, make, exact, **fields)


# -- for the exact integrals ------------------------------------------------------------------------------------------


def in_view(scene: Scene, camera: Camera) -> Scene:
    """Return the scene with faces that reach behind the camera clipped to its view; the image is the same.

    The planes are those through the eye and the image's border, grown by half an image to each side, and stand still; what
    they cut is out of the image, and new corners stay on their edges, so gradients are those of the whole faces.
    """
    M, K = camera.world_to_camera.detach().double(), camera.K.detach().double()
    if camera.projection == "orthographic":
        return scene
    depth = torch.cat([mesh.verts.detach().double() @ M[2, :3] + M[2, 3] for mesh in scene.meshes])
    if bool((depth > 0).all()):
        return scene
    H, W = camera.size
    low, high = torch.tensor([-0.5 * W, -0.5 * H]), torch.tensor([1.5 * W, 1.5 * H])
    rows = torch.cat([K[:2] - low[:, None] * K[2], high[:, None] * K[2] - K[:2]])  # ≥ 0 in view
    planes = torch.cat([rows @ M[:3, :3], rows @ M[:3, 3:]], 1)
    parts = [_clip(mesh, planes, scene.channels) for mesh in scene.meshes]
    return scene.replace(meshes=[part for part in parts if part is not None])


def _clip(mesh: Mesh, planes: Tensor, channels: int) -> Mesh | None:
    faces = mesh.faces.long()
    triangles = []
    for corners, values in zip(mesh.verts.double()[faces], corner_colors(mesh, channels), strict=True):
        polygon = list(torch.cat([corners, values], 1))
        for plane in planes:
            polygon = _halve(polygon, plane)
        triangles += [torch.stack([polygon[0], a, b]) for a, b in pairwise(polygon[1:])]
    if not triangles:
        return None
    found = torch.stack(triangles)  # (T, 3, 3 + C)
    index = torch.arange(3 * len(found)).reshape(-1, 3)
    verts, values = found[..., :3].reshape(-1, 3), found[..., 3:]
    if mesh.colors is None and mesh.corner_colors is None:
        return Mesh(verts, index, face_colors=values[:, 0])
    return Mesh(verts, index, corner_colors=values)


def _halve(polygon: list[Tensor], plane: Tensor) -> list[Tensor]:
    """Return the part of a polygon on the positive side of a plane (4,)."""
    kept = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        da, db = ((p[:3].detach() @ plane[:3] + plane[3]).item() for p in (a, b))
        if da >= 0:
            kept.append(a)
        if da * db < 0:
            # From the same end for both faces of an edge, so that they meet in the same bits.
            p, q = (a, b) if a[:3].tolist() < b[:3].tolist() else (b, a)
            dp, dq = (e[:3] @ plane[:3] + plane[3] for e in (p, q))
            kept.append(p + dp / (dp - dq) * (q - p))
    return kept
