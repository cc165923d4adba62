"""The methods that the reports compare: edgegrad and its two terms, finite differences, and the peers that are installed.

All give the gradient of image · adjoint for the vertices, or for a rigid motion of the whole scene, and the seconds it took.
"""

from __future__ import annotations

import importlib.metadata
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.kernel.operators import backward_kernel, forward_kernel
from edgegrad.kernel.request import make_request
from edgegrad.render import render
from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from .. import mitsuba
from ..scenes import ReportScene
from ..supersampling import supersampled

VERSION = importlib.metadata.version("edgegrad")
FORWARD_SPP = 16  # of the image in a whole step; the gradient does not depend on it, as the loss is linear
# Of a central difference, in pixels to each side. Its error grows with the square of the step, its noise falls with it.
STEP_PIXELS = 0.5
FACTORS = (1 / 16, 1 / 4, 1, 4, 16, 64)  # times edgegrad's default samples
SPP = (1, 4, 16, 64, 256)
METRICS = ("vertex", "translation", "rotation")


@dataclass(frozen=True)
class Gradient:
    """A gradient and the seconds it took. A pose has no gradient for vertices, a vertex step none for the pose."""

    seconds: float
    vertex: Tensor | None = None  # (V, 3) float64
    translation: Tensor | None = None  # (3,)
    rotation: Tensor | None = None  # (3,) about the axes through the centroid, per radian

    def metrics(self) -> dict[str, Tensor]:
        named = {"vertex": self.vertex, "translation": self.translation, "rotation": self.rotation}
        return {name: value for name, value in named.items() if value is not None}


class Method(Protocol):
    name: str
    part: str  # of the gradient that it estimates: "whole", "interior" or "boundary"
    version: str
    budgets: tuple[float, ...]

    @property
    def compile_seconds(self) -> float:
        """Spent so far on compilation, which is not in the seconds of a gradient."""
        ...

    def label(self, budget: float) -> str:
        """Return the budget in words."""
        ...

    def gradient(self, budget: float, seed: int) -> Gradient:
        """At the scene's own vertices. A seed gives the same gradient again, save rounding."""
        ...


def rigid(scene: ReportScene, vertex: Tensor) -> dict[str, Tensor]:
    """Return the gradients for vertices (V, 3), and for translation (3,) and rotation (3,) of all of them."""
    arm = scene.verts - scene.center
    return {"vertex": vertex, "translation": vertex.sum(0), "rotation": torch.linalg.cross(arm, vertex).sum(0)}


def differentiate(scene: ReportScene, **options: object) -> tuple[Tensor, float, float]:
    """Return edgegrad's gradient (V, 3) float64, the seconds of update and image, and those of the backward pass."""
    leaves = [mesh.verts.detach().clone().requires_grad_() for mesh in scene.moving]
    begin = time.perf_counter()
    meshes = [mesh.replace(verts=verts) for mesh, verts in zip(scene.moving, leaves, strict=True)]
    meshes += scene.scene.meshes[len(meshes) :]
    image = render(scene.scene.replace(meshes=meshes), scene.camera, bounces=scene.bounces, **options)  # type: ignore[arg-type]
    middle = time.perf_counter()
    image.backward(scene.adjoint)
    end = time.perf_counter()
    # A leaf without a gradient: nothing of it is in view and nothing of it varies.
    grads = [torch.zeros_like(verts) if verts.grad is None else verts.grad for verts in leaves]
    return torch.cat([grad.double() for grad in grads]), middle - begin, end - middle


def default_samples(scene: Scene | Mesh, camera: Camera, adjoint: Tensor) -> tuple[int, int]:
    """Return the default numbers of surface samples and edge samples for the gradient of vertices."""
    request = make_request(scene, camera, FORWARD_SPP)
    _, hits, _ = forward_kernel(request)
    _, (profile,) = backward_kernel(adjoint.to(hits.coverage.dtype)[None], hits, request, ["verts"])
    return int(profile["surface_samples"]), int(profile["edge_samples"])


class Edgegrad:
    """edgegrad, both terms or one. A budget is a factor on the default samples.

    Both are timed as a step of an optimisation: update after the vertices moved, image, backward. One term is timed as
    its backward pass alone.
    """

    version = f"edgegrad {VERSION}"
    budgets: tuple[float, ...] = FACTORS
    compile_seconds = 0.0

    def __init__(self, scene: ReportScene, part: str = "whole") -> None:
        self.name = "edgegrad" if part == "whole" else part
        self.part = part
        self._scene = scene
        self.samples = default_samples(scene.scene, scene.camera, scene.adjoint)
        # Vertices elsewhere by a thousandth, so that the next call cannot take what the kernel keeps of the last one.
        self._elsewhere = scene.moved((scene.verts * 1.001).float())

    def label(self, budget: float) -> str:
        return f"× {budget:g}" if budget >= 1 else f"÷ {1 / budget:g}"

    def counts(self, budget: float) -> tuple[int, int]:
        """Return surface samples and edge samples of a budget; the kernel takes at least one."""
        surface, edge = (max(1, round(budget * count)) for count in self.samples)
        return surface, edge

    def gradient(self, budget: float, seed: int) -> Gradient:
        surface, edge = self.counts(budget)
        with torch.no_grad():
            render(self._elsewhere, self._scene.camera, spp=1)
        # The same image for all: what it saw says where the kernel puts its samples.
        options: dict[str, Any] = {"spp": FORWARD_SPP, "seed": seed}
        if self.part == "whole":
            vertex, forward, backward = differentiate(self._scene, sampling=Sampling(surface, edge), **options)
            return Gradient(forward + backward, **rigid(self._scene, vertex))
        if self.part == "interior":
            vertex, _, seconds = differentiate(self._scene, visibility=False, sampling=Sampling(surface), **options)
            return Gradient(seconds, **rigid(self._scene, vertex))
        # The boundary alone is the difference to an interior from the same samples.
        options["sampling"] = Sampling(64, edge)
        both, _, seconds = differentiate(self._scene, **options)
        interior, _, _ = differentiate(self._scene, visibility=False, **options)
        return Gradient(seconds, **rigid(self._scene, both - interior))


class FiniteDifferences:
    """Central differences of the forward renderer with common random numbers: both sides see the same sample points.
    A budget is samples a pixel. For the pose, 6 parameters and 12 images; for vertices, 3 V parameters and 6 V images.
    """

    part = "whole"
    version = f"edgegrad {VERSION}, step {STEP_PIXELS:g} px"
    budgets: tuple[float, ...] = SPP
    compile_seconds = 0.0

    def __init__(self, scene: ReportScene, of_vertices: bool = False) -> None:
        self.name = "finite-differences-vertices" if of_vertices else "finite-differences"
        self._scene, self._of_vertices = scene, of_vertices
        self._verts, self._center = scene.verts, scene.center
        # World units and radians that move what is farthest out by STEP_PIXELS in the image.
        self._shift = STEP_PIXELS / pixels_per_unit(scene)
        self._angle = self._shift / float((self._verts - self._center).norm(dim=1).max())

    def label(self, budget: float) -> str:
        return f"{budget:g} spp"

    def gradient(self, budget: float, seed: int) -> Gradient:
        begin = time.perf_counter()
        if self._of_vertices:
            unit = torch.eye(self._verts.numel(), dtype=torch.float64).reshape(-1, *self._verts.shape)
            slopes = [self._slope(lambda h, d=d: self._verts + h * d, self._shift, budget, seed) for d in unit]
            vertex = torch.tensor(slopes, dtype=torch.float64).reshape(-1, 3)
            return Gradient(time.perf_counter() - begin, vertex=vertex)
        axes = torch.eye(3, dtype=torch.float64)
        shifts = [self._slope(lambda h, a=a: self._verts + h * a, self._shift, budget, seed) for a in axes]
        turns = [self._slope(lambda h, a=a: self._turned(h * a), self._angle, budget, seed) for a in axes]
        translation, rotation = (torch.tensor(slopes, dtype=torch.float64) for slopes in (shifts, turns))
        return Gradient(time.perf_counter() - begin, translation=translation, rotation=rotation)

    def _slope(self, verts: Callable[[float], Tensor], step: float, spp: float, seed: int) -> float:
        high, low = (self._loss(verts(h), round(spp), seed) for h in (step, -step))
        return (high - low) / (2.0 * step)

    def _loss(self, verts: Tensor, spp: int, seed: int) -> float:
        with torch.no_grad():
            scene = self._scene.moved(verts)
            times = round(spp**0.5) if scene.is_lit else 1
            options = {"spp": round(spp / times**2), "seed": seed, "bounces": self._scene.bounces}
            image = supersampled(scene, self._scene.camera, times, **options)
        return float((image * self._scene.adjoint.double()).sum())

    def _turned(self, vector: Tensor) -> Tensor:
        """The vertices turned about the centroid by |vector| radians; copies of one vertex stay equal to the last bit."""
        axis = torch.linalg.cross(torch.eye(3, dtype=torch.float64), vector.expand(3, 3))
        R, arm = torch.linalg.matrix_exp(-axis.T), self._verts - self._center
        return self._center + (arm[:, None, :] * R).sum(-1)


class Peer:
    """An integrator of another renderer, both terms at as many samples a pixel; timed as a whole step."""

    part = "whole"
    budgets: tuple[float, ...] = SPP

    def __init__(self, scene: ReportScene, name: str, guiding: bool = False) -> None:
        self.name, self._scene = name + (GUIDED if guiding else ""), scene
        self.version = f"mitsuba {mitsuba.available()}"
        self._peer = mitsuba.Mitsuba(
            scene.scene,
            scene.camera,
            scene.adjoint,
            name,
            guiding=guiding,
            objects=scene.objects,
            bounces=scene.bounces,
        )

    @classmethod
    def all(cls, scene: ReportScene, name: str) -> list[Peer]:
        """Return one peer, and for lit scenes one more with guided samples of shadow boundaries."""
        return [cls(scene, name, guiding) for guiding in ((False, True) if scene.scene.is_lit else (False,))]

    @property
    def compile_seconds(self) -> float:
        return self._peer.compile_seconds

    def label(self, budget: float) -> str:
        return f"{budget:g} spp"

    def gradient(self, budget: float, seed: int) -> Gradient:
        parts, seconds = self._peer.gradient(budget, seed, primal_spp=FORWARD_SPP)
        return Gradient(seconds, **rigid(self._scene, torch.cat(parts)))


def pixels_per_unit(scene: ReportScene) -> float:
    """Return by how many pixels the centroid moves in the image, for one unit across the view."""
    focal = float(scene.camera.K[0, 0])
    if scene.camera.projection == "orthographic":
        return focal
    row = scene.camera.world_to_camera[2].double()
    return focal / max(float(row[:3] @ scene.center + row[3]), 1e-30)


PEERS = ("direct_projective", "prb_projective")
GUIDED = "-guided"


def _term(scene: ReportScene, part: str) -> list[Edgegrad]:
    """Raises ValueError."""
    if scene.scene.is_lit:
        raise ValueError(
            "a lit scene's samples are shaded ahead of the backward pass, where its terms are not timed apart"
        )
    return [Edgegrad(scene, part)]


METHODS: dict[str, Callable[[ReportScene], Sequence[Method]]] = {
    "edgegrad": lambda scene: [Edgegrad(scene)],
    "interior": lambda scene: _term(scene, "interior"),
    "boundary": lambda scene: _term(scene, "boundary"),
    # 6 V images are too many but for a single triangle.
    "finite-differences": lambda scene: [
        FiniteDifferences(scene, of_vertices) for of_vertices in ((False, True) if len(scene.verts) <= 3 else (False,))
    ],
    "direct_projective": lambda scene: Peer.all(scene, "direct_projective"),
    "prb_projective": lambda scene: Peer.all(scene, "prb_projective"),
}


def missing(name: str) -> str | None:
    """Return what a method lacks on this machine and how to get it, or None."""
    if name in PEERS and mitsuba.available() is None:
        return "Mitsuba is not installed or finds no LLVM; pip install 'edgegrad[peers]'"
    return None
