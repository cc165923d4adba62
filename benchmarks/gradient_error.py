"""Relative error of the per-vertex gradient against the number of samples: 81,920-face icosphere, smooth colours, 256².

Run:  python benchmarks/gradient_error.py [--seeds 4]

The error is ‖g − g*‖ / ‖g*‖ over all vertices, root mean square over seeds; g* is a converged run with seeds of its own, 128
times the default surface samples and 512 times the default edge samples. Interior and boundary are told apart by
visibility=False. All errors are relative to the whole gradient; the time is that of the backward pass, the median over seeds.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import torch
from tqdm import tqdm

import edgegrad as eg

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from scenes import default_samples, icosphere, smooth_adjoint


def gradient(mesh: eg.Mesh, camera: eg.Camera, adjoint: torch.Tensor, **options: object) -> tuple[torch.Tensor, float]:
    """∂(image · adjoint)/∂verts (V, 3) and the seconds of the backward pass; the image itself does not matter."""
    verts = mesh.verts.detach().clone().requires_grad_()
    image = eg.render(mesh.replace(verts=verts), camera, spp=1, **options)  # type: ignore[arg-type]
    begin = time.perf_counter()
    image.backward(adjoint)
    assert verts.grad is not None
    return verts.grad.double(), time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=4)
    seeds = parser.parse_args().seeds
    mesh = icosphere(6)
    mesh = mesh.replace(verts=mesh.verts.float(), colors=mesh.colors.float())
    camera = eg.Camera.look_at((0.9, 0.7, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (256, 256))
    adjoint = smooth_adjoint(256, 256, 3).float()

    n_surface, n_edge = default_samples(mesh, camera, adjoint)
    print(f"default samples: {n_surface:,} on surfaces, {n_edge:,} at edges; {torch.get_num_threads()} threads")
    reference_interior, _ = gradient(
        mesh, camera, adjoint, visibility=False, surface_samples=128 * n_surface, grad_seed=991
    )
    reference, _ = gradient(mesh, camera, adjoint, surface_samples=64, edge_samples=512 * n_edge, grad_seed=992)
    interior_64, _ = gradient(mesh, camera, adjoint, visibility=False, surface_samples=64, grad_seed=992)
    reference_boundary = reference - interior_64
    whole = reference_interior + reference_boundary

    def report(name: str, target: torch.Tensor, correct: torch.Tensor | None = None, **options: object) -> None:
        errors, times = [], []
        for seed in range(seeds):
            g, seconds = gradient(mesh, camera, adjoint, grad_seed=seed, **options)
            if correct is not None:
                g = g - gradient(mesh, camera, adjoint, grad_seed=seed, visibility=False, surface_samples=64)[0]
            errors.append(((g - target).norm() / whole.norm()).item())
            times.append(seconds)
        error = (sum(e * e for e in errors) / seeds) ** 0.5
        tqdm.write(f"{name:42s} {100 * error:7.3f} %   {1e3 * sorted(times)[seeds // 2]:7.1f} ms")

    report("both, default samples", whole)
    for factor in (0.25, 1, 4, 16):
        report(
            f"interior, {int(factor * n_surface):9,d} surface samples",
            reference_interior,
            visibility=False,
            surface_samples=int(factor * n_surface),
        )
    for factor in (0.25, 1, 4, 16):
        report(
            f"boundary, {int(factor * n_edge):9,d} edge samples",
            reference_boundary,
            reference,
            surface_samples=64,
            edge_samples=int(factor * n_edge),
        )


if __name__ == "__main__":
    main()
