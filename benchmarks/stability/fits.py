"""Ill-conditioned fits: distance against focal length, and 10,000 free vertices, plain and preconditioned."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.fit.laplacian import LaplacianSolver
from edgegrad.render import render
from edgegrad.sampling import Sampling
from edgegrad.scene.mesh import Mesh
from edgegrad.scene.scene import Scene

from ..scenes import background, front_camera, icosphere, smooth_colors

F64 = torch.float64
STEPS = 500
RISE = 5.0  # the loss may rise over one step by this factor, no more
SMOOTHNESS = 20.0  # λ of I + λ L

Say = Callable[[str], Any]


def measure(quick: bool = False, say: Say = lambda text: None) -> list[dict[str, Any]]:
    """Return the loss at each step of each fit. Raises ImportError without cholespy."""
    steps = STEPS // 10 if quick else STEPS
    return [camera_fit(steps, say), *(vertex_fit(steps, preconditioned, say) for preconditioned in (False, True))]


def summary(name: str, losses: list[float], error: tuple[str, float, float]) -> dict[str, Any]:
    """`error`: what it is of, at the start and at the end."""
    loss = np.array(losses)
    return {
        "fit": name, "losses": losses, "finite": bool(np.isfinite(loss).all()),
        "rise": float((loss[1:] / loss[:-1]).max()), "error of": error[0], "error": list(error[1:]),
    }  # fmt: skip


def camera_fit(steps: int = STEPS, say: Say = lambda text: None) -> dict[str, Any]:
    """Fit distance and focal length, which start off by half so that the size in the image is right, by Adam on logarithms."""
    camera, scene = front_camera(48), Scene([icosphere(3)], background())

    def view(distance: Tensor, focal: Tensor) -> Camera:
        M, K = camera.world_to_camera, camera.K
        far = torch.zeros_like(M)
        far[2, 3] = M[2, 3]
        stretch = torch.tensor([[1.0, 1.0, 0.0]] * 2 + [[0.0] * 3], dtype=F64)
        return camera.replace(world_to_camera=M + far * (distance.exp() - 1.0), K=K + K * stretch * (focal.exp() - 1.0))

    with torch.no_grad():
        target = render(scene, camera, spp=1024)
    start = torch.tensor([1.5], dtype=F64).log()[0]
    distance, focal = (start.clone().requires_grad_() for _ in range(2))
    optimizer = torch.optim.Adam([distance, focal], lr=0.01)
    losses = []
    for step in range(steps):
        say(f"camera, step {step}")
        optimizer.zero_grad()
        loss = (render(scene, view(distance, focal), spp=64, seed=step) - target).square().mean()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    return summary("distance and focal length, Adam", losses, ("distance", 0.5, abs(distance.exp().item() - 1.0)))


def vertex_fit(steps: int = STEPS, preconditioned: bool = False, say: Say = lambda text: None) -> dict[str, Any]:
    """Fit a sphere of 10,242 free vertices to a bumpy one that four cameras see.

    Preconditioned: Adam, with one scale for all, on u = (I + λ L) v (Nicolet, Jacobson and Jakob, Large Steps in Inverse
    Rendering of Geometry, 2021), solved by cholespy.
    """
    ball = icosphere(5)
    bumps = 1.0 + 0.12 * torch.sin(
        4.0 * ball.verts @ torch.tensor([[1.0, 0.3], [0.2, -1.1], [0.7, 0.9]], dtype=F64)
    ).sum(1)
    goal = (ball.verts * bumps[:, None]).float()
    mesh = Mesh(ball.verts.float(), ball.faces, colors=smooth_colors(ball.verts).float())
    eyes = 4.0 * torch.tensor([[1.0, 1.0, 1.0], [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0], [-1.0, -1.0, 1.0]]) / 3**0.5
    cameras = Camera.stack([Camera.look_at(eye, torch.zeros(3), (0.2, 0.5, 1.0), 40.0, (48, 48)) for eye in eyes])
    back = background().float()
    with torch.no_grad():
        target = render(Scene([mesh.replace(verts=goal)], back), cameras, spp=256)
    solve = LaplacianSolver(mesh.faces, len(mesh.verts), SMOOTHNESS) if preconditioned else None
    v = mesh.verts.clone()
    u = v if solve is None else solve.to_differential(v)
    mean, square = torch.zeros_like(u), torch.zeros_like(u)
    losses = []
    samples: dict[str, Any] = {"sampling": Sampling(surface=10_000, edges=5_000)}  # of each camera
    rate = 3e-2 if preconditioned else 3e-3
    for step in range(1, steps + 1):
        say(f"vertices{', preconditioned' if preconditioned else ''}, step {step}")
        leaf = v.detach().requires_grad_()
        loss = (
            (render(Scene([mesh.replace(verts=leaf)], back), cameras, spp=4, seed=step, **samples) - target)
            .square()
            .mean()
        )
        (g,) = torch.autograd.grad(loss, leaf)
        losses.append(loss.item())
        if solve is not None:
            g = solve.solve(g)
        # Adam (Kingma and Ba, 2015).
        mean, square = 0.9 * mean + 0.1 * g, 0.999 * square + 0.001 * g.square()
        scale = (square / (1.0 - 0.999**step)).sqrt()
        scale = scale.max() if solve is not None else scale
        u = u - rate * (mean / (1.0 - 0.9**step)) / (scale + 1e-12)
        v = u if solve is None else solve.solve(u)
    name = "10,242 free vertices, " + ("preconditioned Adam" if preconditioned else "Adam")
    start, end = (float((x - goal).norm(dim=1).mean()) for x in (mesh.verts, v))
    return summary(name, losses, ("vertices, mean distance", start, end))
