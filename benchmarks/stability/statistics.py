"""Bias of the gradient, tails of its samples, and bias of a squared loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from oracles.exact import exact_image
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.camera.poses import rotation
from edgegrad.optional import require
from edgegrad.render import render
from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ..scenes import (
    background,
    cube,
    front_camera,
    icosphere,
    occluded_triangle,
    one_triangle,
    random_slivers,
    smooth_colors,
)
from .cases import CASES
from .cases.case import Problem, everything
from .cases.glossy import GLOSSY
from .cases.light import LIT
from .cases.measure import Effort, Running, differences, exact, sample
from .painted import PAINTED

F64 = torch.float64
ALPHA = 0.01  # chance of any false alarm in a whole run, by Holm
SEEDS, SINGLES = 256, 2048
SAMPLES = {"sampling": Sampling(surface=2_000, edges=2_000), "spp": 16}
SPP = (1, 4, 16, 64, 256)

Say = Callable[[str], Any]


def measure(quick: bool = False, say: Say = lambda text: None) -> dict[str, Any]:
    """Return the three tables. Raises ImportError without SciPy."""
    return {"unbiased": unbiased(quick, say), "tails": tails(quick, say), "squared loss": squared_loss(quick, say)}


# -- unbiased ---------------------------------------------------------------------------------------------------------


def scenes() -> dict[str, Callable[[], Problem]]:
    camera = front_camera(48)
    chosen = (
        "soup", "fan-5", "inside", "camera-plane", "pixels", "orthographic", "ortho-box-faces", "ortho-two-boxes", "stacked",
    )  # fmt: skip
    return {
        "one triangle": lambda: everything(one_triangle(), camera),
        "occluded triangle": lambda: everything(occluded_triangle(), camera),
        "40 slivers": lambda: everything(Scene([random_slivers(40, 1, camera)], background()), camera),
        "sphere": lambda: everything(Scene([icosphere(2)], background()), camera),
        **{name: CASES[name].build for name in chosen},
        **{name: partial(build, camera) for name, build in PAINTED.items()},
    }


def unbiased(quick: bool = False, say: Say = lambda text: None) -> dict[str, Any]:
    """Mean over seeds against the exact integrals, for every component of every part and 16 random sums of pixels; of lit scenes
    against finite differences, for every component of what moves.

    z = (mean − exact) / standard error of the mean is Student's t; that of finite differences is in it. All of all scenes are
    tested together by Holm's method, whatever their dependence: with probability ALPHA or less a run without bias has a
    rejection at all.
    """
    stats = require("scipy.stats", "edgegrad[fit]", "the test of unbiasedness")
    seeds = SEEDS // 4 if quick else SEEDS
    rows, all_p = [], []
    lit = LIT | GLOSSY
    for name, build in (scenes() | lit).items():
        say(name)
        z, freedom, deviation, reference = (lit_components if name in lit else components)(build(), seeds)
        p = 2.0 * stats.t.sf(z.abs().numpy(), freedom.numpy())
        all_p.append(torch.from_numpy(p))
        rows.append({
            "scene": name, "components": len(z), "largest": float(z.abs().max()), "beyond": int((z.abs() > 3.0).sum()),
            "expected": 2.0 * float(stats.t.sf(3.0, freedom.numpy()).sum()), "deviation": deviation,
            "reference": reference,
        })  # fmt: skip
    rejected = holm(torch.cat(all_p), ALPHA)
    count = 0
    for row in rows:
        row["rejected"] = int(rejected[count : count + row["components"]].sum())
        count += row["components"]
    return {"seeds": seeds, "alpha": ALPHA, "components": count, "rejected": int(rejected.sum()), "rows": rows}


class Components(NamedTuple):
    z: Tensor  # of every component that varies
    freedom: Tensor  # degrees of freedom of each
    deviation: float  # of the gradient from a single seed, relative
    reference: float  # the standard error of what it is compared with, relative


def components(problem: Problem, seeds: int) -> Components:
    assert problem.exact is not None
    image, grads = exact(problem, problem.exact)
    signs = torch.randn((16, image.numel()), dtype=F64, generator=torch.Generator().manual_seed(0))
    wanted = torch.cat([signs @ image.reshape(-1), *(g.reshape(-1) for g in grads.values())])
    running = Running()
    for seed in range(seeds):
        one, found = sample(problem, seed, **SAMPLES)
        running.add(
            torch.cat([signs @ one.detach().double().reshape(-1), *(g.double().reshape(-1) for g in found.values())])
        )
    error = (running.squares / (seeds - 1) / seeds).sqrt()
    off = running.mean - wanted
    # What does not vary is right but for the rounding of the input's type.
    fixed = error <= 1e-9 * wanted.abs().max()
    assert bool((off[fixed].abs() <= 1e-5 * wanted.abs().max()).all()), "a component without noise is off"
    z = (off / error)[~fixed]
    deviation = float((error[16:].norm() * math.sqrt(seeds)) / wanted[16:].norm())
    return Components(z, torch.full_like(z, seeds - 1), deviation, 0.0)


def lit_components(problem: Problem, seeds: int) -> Components:
    """Compare parts with finite differences; both sides have noise, with the degrees of freedom of Welch (1947)."""
    others = max(4, seeds // 8)
    effort = Effort(difference_seeds=(others,))
    adjoint = problem.cotangent(torch.empty(0))
    runs = [differences(problem, adjoint, name, 1.0, effort) for name in problem.parts]
    running = Running()
    for seed in range(seeds):
        _, found = sample(problem, seed, **SAMPLES)
        running.add(torch.cat([g.double().reshape(-1) for g in found.values()]))
    wanted, squares = (torch.cat([getattr(run, n) for run in runs]) for n in ("mean", "squares"))
    own, other = (
        running.squares / (seeds - 1) / seeds,
        squares / (others - 1) / others,
    )
    error, off = (own + other).sqrt(), running.mean - wanted
    varies = error > 0  # not the place of a light that has none
    assert not bool(off[~varies].any()), "a component without noise is off"
    freedom = (own + other) ** 2 / (own**2 / (seeds - 1) + other**2 / (others - 1))
    size = float(wanted.norm())
    return Components(
        (off / error)[varies], freedom[varies], float(own.sum().sqrt() * math.sqrt(seeds)) / size,
        float(other.sum().sqrt()) / size,
    )  # fmt: skip


def holm(p: Tensor, alpha: float) -> Tensor:
    """Return which hypotheses are rejected (Holm, A simple sequentially rejective multiple test procedure, 1979)."""
    order = torch.argsort(p)
    steps = p[order] <= alpha / torch.arange(len(p), 0, -1)
    steps = steps.to(torch.int).cumprod(0).bool()  # stops at the first that stays
    rejected = torch.zeros(len(p), dtype=torch.bool)
    rejected[order] = steps
    return rejected


# -- tails ------------------------------------------------------------------------------------------------------------


def _plane_camera() -> Camera:
    """Return a camera half a unit above a plane, looking 2° down along it."""
    return Camera.look_at((0.0, 0.05, 0.0), (0.0, -0.3, -10.0), (0.1, 1.0, 0.0), 40.0, (48, 48)).to(F64)


def _grid(n: int, size: float) -> Mesh:
    """Return a sheet of 2 n² faces in y = 0."""
    x = torch.linspace(-size, size, n + 1, dtype=F64)
    z, y = torch.meshgrid(x - 1.2 * size, x, indexing="ij")
    verts = torch.stack([y, 0.01 * torch.sin(5.0 * y + 3.0 * z), z], -1).reshape(-1, 3)
    a = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1)
    faces = torch.cat([torch.stack([a, a + 1, a + n + 1], 1), torch.stack([a + 1, a + n + 2, a + n + 1], 1)])
    return Mesh(verts, faces, colors=smooth_colors(verts))


def tail_scenes() -> dict[str, tuple[Scene, Camera]]:
    front = front_camera(48)
    plane = CASES["camera-plane"].build()
    speck = icosphere(5).transformed(scale=0.25)
    box = cube(0.6).transformed(rotation(torch.tensor([0.3, 0.4, 0.1], dtype=F64)))
    return {
        "one large triangle": (one_triangle(), front),
        "grazing triangles: a sheet seen at 0 to 3°": (Scene([_grid(24, 4.0)], background()), _plane_camera()),
        "sub-pixel triangles: a sphere of 20,480 faces, 9 px wide": (Scene([speck], background()), front),
        "slivers": (Scene([random_slivers(40, 1, front)], background()), front),
        "silhouettes near the camera plane": plane.make(plane.parts),
        "box with smooth colours": (Scene([box], background()), front),
    }  # fmt: skip


def tails(quick: bool = False, say: Say = lambda text: None) -> list[dict[str, Any]]:
    """Single samples of the gradient of the vertices, one at a time: how much of the sum the largest one has."""
    count = SINGLES // 8 if quick else SINGLES
    rows = []
    for name, (scene, camera) in tail_scenes().items():
        say(name)
        interior, boundary = [], []
        sums = [torch.zeros(()), torch.zeros(())]
        for seed in range(count):
            inside = _vertices(scene, camera, seed, visibility=False)
            both = _vertices(scene, camera, seed)
            for k, (norms, value) in enumerate(((interior, inside), (boundary, both - inside))):
                norms.append(value.norm())
                sums[k] = sums[k] + value
        rows.append({"scene": name, "samples": count} | {
            part: _tail(torch.stack(norms), total) for part, norms, total in zip(
                ("interior", "boundary"), (interior, boundary), sums, strict=True
            )
        })  # fmt: skip
    return rows


def _vertices(scene: Scene, camera: Camera, seed: int, **options: Any) -> Tensor:
    leaves = [mesh.verts.clone().requires_grad_() for mesh in scene.meshes]
    meshes = [mesh.replace(verts=v) for mesh, v in zip(scene.meshes, leaves, strict=True)]
    image = render(
        scene.replace(meshes=meshes), camera, spp=4, sampling=Sampling(seed=seed, surface=1, edges=1), **options
    )
    adjoint = Problem({}, lambda parts: (scene, camera), None).cotangent(image)
    grads = torch.autograd.grad(image, leaves, adjoint, materialize_grads=True)
    return torch.cat([g.reshape(-1) for g in grads])


def _tail(norms: Tensor, total: Tensor) -> dict[str, float] | None:
    """share: of the largest sample in the sum of all sizes; times: how many mean ones it is; squares: its share in the sum
    of squares, which is in the variance. None where there are no samples."""
    sum_ = float(norms.sum())
    if sum_ == 0.0:
        return None
    squares = norms.square()
    largest = float(norms.max())
    return {
        "share": largest / sum_, "times": largest * len(norms) / sum_, "squares": float(squares.max() / squares.sum()),
        "deviation": float((squares.mean() - (total / len(norms)).square().sum()).clamp(min=0).sqrt())
        / float(total.norm() / len(norms)),
    }  # fmt: skip


# -- squared loss -----------------------------------------------------------------------------------------------------


def squared_loss(quick: bool = False, say: Say = lambda text: None) -> dict[str, Any]:
    """Σ (I − T)²: its value is off by the variance of the image; its gradient for what moves is not, since it has samples
    of its own; that for the background is, since it is that of the image as it was made."""
    camera, scene = front_camera(32), occluded_triangle()
    target = exact_image(scene.transformed(t=torch.tensor([0.06, -0.04, 0.0], dtype=F64)), camera)
    problem = everything(scene, camera, camera_too=False, names=(" behind", " in front"))
    assert problem.exact is not None
    leaves = {name: value.clone().requires_grad_() for name, value in problem.parts.items()}
    loss = (problem.exact(leaves) - target).square().sum()
    wanted = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values())), strict=True))
    seeds = 64 if quick else 1024
    rows = []
    for spp in SPP:
        say(f"squared loss, {spp} samples a pixel")
        value, grads = Running(), {name: Running() for name in wanted}
        for seed in range(seeds):
            leaves = {name: part.clone().requires_grad_() for name, part in problem.parts.items()}
            image = render(*problem.make(leaves), spp=spp, seed=seed, **problem.options)
            one = (image - target).square().sum()
            value.add(one)
            for name, gradient in zip(grads, torch.autograd.grad(one, list(leaves.values())), strict=True):
                grads[name].add(gradient)
        row: dict[str, Any] = {"spp": spp}
        for name, run, correct in [("loss", value, loss.detach()), *((n, grads[n], wanted[n]) for n in wanted)]:
            found, size = run.estimate(), float(correct.norm())
            row[name] = {"bias": float((found.mean - correct).norm()) / size, "noise": found.error / size}
        rows.append(row)
    return {"seeds": seeds, "rows": rows}
