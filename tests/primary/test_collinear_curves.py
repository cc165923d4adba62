"""Many curves on one line of the image: the time and memory that they take grow in proportion, and gradients stay right."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest
import torch
from scenes import front_camera, icosphere
from torch import Tensor

import edgegrad as eg

F64 = torch.float64


def edge_on_grid(n: int) -> tuple[eg.Mesh, eg.Camera]:
    """2 n² faces, each with a colour, seen from a millionth above their plane: some 3 n² curves less than 10⁻⁴ px apart."""
    x = torch.linspace(-1.0, 1.0, n + 1, dtype=F64)
    across, away = torch.meshgrid(x, x, indexing="ij")
    verts = torch.stack([across, 0 * across, away], -1).reshape(-1, 3)
    corner = torch.arange(n * (n + 1)).reshape(n, n + 1)[:, :-1].reshape(-1, 1)
    faces = (corner + torch.tensor([0, 1, n + 1, 1, n + 2, n + 1])).reshape(-1, 3)
    middle = verts[faces].mean(1)
    colors = 0.6 + 0.3 * torch.sin(torch.stack([2 * middle[:, 0], 3 * middle[:, 2], middle.sum(1)], 1))
    camera = eg.Camera.look_at((0.1, 1e-6, 3.5), (0.1, 1e-6, 0.0), (0.0, 1.0, 0.0), 60.0, (64, 64))
    return eg.Mesh(verts, faces, face_colors=colors), camera.to(F64)


def backward(mesh: eg.Mesh, camera: eg.Camera, seed: int = 0, edge_samples: int | None = None) -> Tensor:
    verts = mesh.verts.clone().requires_grad_()
    image = eg.render(mesh.replace(verts=verts), camera, spp=1, seed=seed, sampling=eg.Sampling(edges=edge_samples))
    (grad,) = torch.autograd.grad(image.sum(), verts)
    return grad


@pytest.mark.parametrize("n", [1, 64])
def test_grid_seen_edge_on(n: int) -> None:
    """Nothing hides anything, so that the sum of the image is that of areas times colours. 8,192 faces once took a second
    and 130 MB, 131,072 of them 107 s and 6.3 GB."""
    mesh, camera = edge_on_grid(n)
    verts = mesh.verts.clone().requires_grad_()
    a, b, c = camera.project(verts)[mesh.faces].unbind(1)
    area = 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]).abs()
    assert mesh.face_colors is not None
    (exact,) = torch.autograd.grad((area * mesh.face_colors.sum(1)).sum(), verts)

    before = peak_memory()
    grads = torch.stack([backward(mesh, camera, seed, 16_384) for seed in range(6)])
    assert peak_memory() - before < 60e6  # 42 MB with the sanitizers
    # Up and down: the whole, a turn about the line of sight, one about the line across, and a wave.
    x, _, z = mesh.verts.unbind(1)
    motions = torch.stack([torch.ones_like(x), x, z, torch.sin(3 * x + 2 * z)], 1)
    found, expected = grads[..., 1] @ motions, exact[:, 1] @ motions
    mean, error, size = found.mean(0), found.std(0) / len(found) ** 0.5, expected.abs().max()
    assert bool((error < 0.01 * size).all()), (mean, error, expected)
    assert bool(((mean - expected).abs() < 5 * error + 0.002 * size).all()), (mean, error, expected)


def peak_memory() -> float:
    """Bytes, of this process since it was last asked."""
    status, clear = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    if not clear.exists():
        return 0.0
    found = re.search(r"VmHWM:\s+(\d+)", status.read_text())
    clear.write_text("5")
    assert found is not None
    return 1024.0 * int(found[1])


@pytest.mark.slow
def test_time_of_copies_grows_with_their_number() -> None:
    """Not with its square, which for ten times as many would be a hundred times as long. Time of the processor, of many
    samples a curve and many curves on a line."""
    sphere, camera = icosphere(2), front_camera(64)
    flat = eg.Mesh(sphere.verts, sphere.faces, face_colors=torch.ones(len(sphere.faces), 3, dtype=F64))

    def seconds(copies: int) -> float:
        meshes = [flat.replace(verts=flat.verts.clone().requires_grad_()) for _ in range(copies)]
        taken = []
        for seed in range(3):
            image = eg.render(
                eg.Scene(meshes), camera, spp=1, seed=seed, sampling=eg.Sampling(edges=500 * copies)
            ).sum()
            began = time.process_time()
            torch.autograd.grad(image, [mesh.verts for mesh in meshes])
            taken.append(time.process_time() - began)
        return min(taken)

    few, many = seconds(20), seconds(200)
    assert many < 30 * few, (few, many)
