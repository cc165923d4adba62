"""Find where a picture was taken, and with what focal length, from one picture of a known object.

    python examples/focal.py [MESH] [--starts 10] [--size 256] [--out focal.png]

Each start is up to 8° and 8 % of the object's size off, its focal length up to 15 %.
"""

from __future__ import annotations

import argparse
import math

import objects
import roma
import torch

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_camera
from edgegrad.fit.pose.camera_result import CameraFit

BACKGROUND = torch.tensor([0.1, 0.15, 0.25])
TURN, SHIFT, ZOOM = 8.0, 0.08, 0.15  # degrees, object sizes, part of the focal length


def trial(mesh: eg.Mesh, seed: int, size: int = 256) -> tuple[float, float, CameraFit]:
    """Return by how many percent the focal length is off, at the start and at the end, and the fit."""
    g = torch.Generator().manual_seed(seed)
    true = objects.around(mesh, 20, size, distance=0.85)[seed % 20]  # so near that perspective shows
    picture = eg.render(eg.Scene([mesh], BACKGROUND), true, spp=64, seed=10_000)
    low, high = mesh.verts.double().aminmax(dim=0)
    center, diagonal = (low + high) / 2, float((high - low).norm())

    def even(n: int) -> torch.Tensor:
        return torch.rand(n, generator=g, dtype=torch.float64) * 2.0 - 1.0

    R = roma.rotvec_to_rotmat(math.radians(TURN) * even(3) / math.sqrt(3.0))
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3], M[:3, 3] = R, center - R @ center + SHIFT * diagonal * even(3) / math.sqrt(3.0)
    K = true.K.double().clone()
    K[:2, :2] *= 1.0 + ZOOM * float(even(1))
    start = true.to(torch.float64).replace(world_to_camera=true.world_to_camera.double() @ M, K=K)
    fit = fit_camera(eg.Scene([mesh], BACKGROUND), picture, start, options=FitOptions(seed=seed, progress=False))
    before, after = (100.0 * (float(k[0, 0] / true.K[0, 0]) - 1.0) for k in (K, fit.camera.K))
    return before, after, fit


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--starts", type=int, default=10)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--out", default="focal.png")
    args = parser.parse_args()
    mesh, good = objects.load(args.mesh), 0
    for seed in range(args.starts):
        before, after, fit = trial(mesh, seed, args.size)
        if seed == 0:
            fit.plot().savefig(args.out)
        good += abs(after) <= 1.0
        print(f"{seed:3d}  focal length {before:+6.2f} % → {after:+6.3f} %  {fit.reason.split(':')[0]}", flush=True)
    print(f"{good} of {args.starts} focal lengths within 1 %")


if __name__ == "__main__":
    main()
