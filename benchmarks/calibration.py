"""How exactly calibrate() and fit_camera() find lenses, and whether they know it: errors, their deviations, and processor time.

    python -m benchmarks.calibration [--cases 3] [--pictures 5] [--size 256] [--threads 1] [--plot calibration.png]

A painted stone is seen from several sides through a lens with k1, k2, p1, p2 = −0.15, 0.05, 0.001, −0.001 and a principal point
that is some 2 % of the image aside. Each start is up to 6° and 5 % of the stone's size off, with a focal length that is 6 % too
long, the principal point in the middle and no distortion. The first rows are of calibrate(), the others of fit_camera() with the
first picture.
"""

from __future__ import annotations

import argparse
import math
import time

import objects
import roma
import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, calibrate, fit_camera
from edgegrad.fit.pose.camera_result import CameraFit

BACKGROUND = torch.tensor([0.1, 0.15, 0.25])
LENS = torch.tensor([-0.15, 0.05, 0.001, -0.001], dtype=torch.float64)
TURN, SHIFT, ZOOM = 6.0, 0.05, 1.06  # degrees, sizes of the stone, and the focal length's factor
ASIDE = 0.12  # sizes of the stone, from the middle of a picture


def case(mesh: eg.Mesh, seed: int, pictures: int, size: int) -> tuple[list[eg.Camera], list[eg.Camera], list[Tensor]]:
    """True cameras, where a fit starts, and the pictures."""
    g = torch.Generator().manual_seed(seed)

    def even(n: int) -> Tensor:
        return torch.rand(n, generator=g, dtype=torch.float64) * 2.0 - 1.0

    low, high = mesh.verts.double().aminmax(dim=0)
    center, diagonal = (low + high) / 2, float((high - low).norm())
    true, start = [], []
    for k, view in enumerate(objects.around(mesh, pictures, size, distance=1.0)):
        plain = view.to(torch.float64)
        K, aside = plain.K.clone(), torch.eye(4, dtype=torch.float64)
        K[:2, 2] += size * torch.tensor([0.012, -0.016], dtype=torch.float64)
        angle = 2.0 * k + seed
        aside[:2, 3] = ASIDE * diagonal * torch.tensor([math.cos(angle), math.sin(angle)])
        W = aside @ plain.world_to_camera
        true.append(plain.replace(K=K, distortion=LENS, world_to_camera=W))
        off = torch.eye(4, dtype=torch.float64)
        off[:3, :3] = R = roma.rotvec_to_rotmat(math.radians(TURN) * even(3) / math.sqrt(3.0))
        off[:3, 3] = center - R @ center + SHIFT * diagonal * even(3) / math.sqrt(3.0)
        guess = plain.K * torch.tensor([[ZOOM, 1.0, 1.0], [1.0, ZOOM, 1.0], [1.0, 1.0, 1.0]], dtype=torch.float64)
        start.append(plain.replace(K=guess, world_to_camera=W @ off))
    scene = eg.Scene([mesh], BACKGROUND)
    shot = [eg.render(scene, view, spp=64, seed=10_000 + 100 * seed + k) for k, view in enumerate(true)]
    return true, start, shot


def row(fit: CameraFit, true: eg.Camera, seconds: float, reason: str) -> list[float]:
    """Prints a line, and gives errors over their deviations."""
    known = fit.uncertainty
    assert known is not None
    focal = float(fit.camera.K[0, 0] / true.K[0, 0]) - 1.0
    center = (fit.camera.K - true.K)[:2, 2]
    bend = fit.camera.coefficients - LENS
    ratios = [focal / known.focal, *(center / known.principal).tolist(), *(bend / known.distortion).tolist()]
    print(
        f"focal {100 * focal:+.4f} ± {100 * known.focal:.4f} %  centre {float(center.abs().max()):.4f} ± "
        f"{float(known.principal.max()):.4f} px  k1 {float(bend[0]):+.5f} ± {float(known.distortion[0]):.5f}  k2 "
        f"{float(bend[1]):+.5f} ± {float(known.distortion[1]):.5f}  error / σ up to {max(map(abs, ratios)):.1f}  "
        f"{seconds:.0f} s  {reason.split(':')[0]}",
        flush=True,
    )
    return ratios


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", type=int, default=3)
    parser.add_argument("--pictures", type=int, default=5)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--plot")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    mesh = objects.pebble()
    cases = [case(mesh, seed, args.pictures, args.size) for seed in range(args.cases)]
    ratios: list[float] = []
    for seed, (true, start, shot) in enumerate(cases):
        began = time.process_time()
        fit = calibrate(eg.Scene([mesh], BACKGROUND), shot, start, options=FitOptions(seed=seed, progress=False))
        ratios += row(fit, true[0], time.process_time() - began, fit.reason)
        if args.plot and seed == 0:
            fit.plot().savefig(args.plot)
    print(f"median of |error| / σ: {float(torch.tensor(ratios).abs().median()):.2f}")
    ratios = []
    for seed, (true, start, shot) in enumerate(cases):
        began = time.process_time()
        found = fit_camera(
            eg.Scene([mesh], BACKGROUND),
            shot[0],
            start[0],
            principal=True,
            distortion=4,
            options=FitOptions(seed=seed, progress=False),
        )
        ratios += row(found, true[0], time.process_time() - began, found.reason)
    print(f"median of |error| / σ: {float(torch.tensor(ratios).abs().median()):.2f}")


if __name__ == "__main__":
    main()
