"""How often fit_pose finds a textured object: random starts, from one picture, and from masks alone.

    python examples/pose.py [MESH] [--case plain|covered|cut-out|unknown|masks] [--starts 100] [--size 256] [--out pose.png]

plain     one picture, the colour behind the object known
covered   a quarter of the object is behind a striped board that the fit does not know
cut-out   the same, with a mask of what is seen of the object
unknown   before a background of noise that is not known, no mask
masks     no colours: masks alone, from 8 views
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
from edgegrad.fit import FitOptions, fit_pose
from edgegrad.fit.pose.result import PoseFit

SIZE = 256
BACKGROUND = torch.tensor([0.1, 0.15, 0.25])
TURN, SHIFT = 30.0, 0.1  # degrees and object sizes: how far a start is off at most
GOOD = {"plain": 0.5, "covered": 1.0, "cut-out": 1.0, "unknown": 1.0, "masks": 0.5}  # degrees


def board(alpha: Tensor, generator: torch.Generator) -> Tensor:
    """Return (H, W, 1): 1 where a half plane, from a random side, covers a quarter of the object."""
    H, W = alpha.shape[:2]
    angle = float(torch.rand((), generator=generator)) * math.tau
    y, x = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    along = (x * math.cos(angle) + y * math.sin(angle))[..., None].float()
    inside = along[alpha > 0.5].sort().values
    return (along > inside[int(0.75 * len(inside))]).float()


def scene(mesh: eg.Mesh, case: str, generator: torch.Generator, size: int = SIZE) -> tuple[eg.Mesh, dict]:
    """Return the mesh in a random rotation, and arguments of fit_pose."""
    low, high = mesh.verts.double().aminmax(dim=0)
    center = (low + high) / 2
    R = random_rotation(generator, math.pi)
    turned = mesh.transformed(R, center - R @ center)
    cameras = objects.around(mesh, 8, size)
    if case == "masks":
        masks = [eg.render_aovs(turned, c, ["alpha"], spp=64, seed=9)["alpha"] for c in cameras]
        plain = eg.Mesh(turned.verts, turned.faces)
        return plain, {"mesh": plain, "images": None, "cameras": cameras, "masks": masks}
    camera = cameras[3]
    seen = eg.render_aovs(turned, camera, ["image", "alpha"], spp=64, seed=9)
    image, alpha = seen["image"], seen["alpha"]
    behind = torch.rand(size, size, 3, generator=generator) if case == "unknown" else BACKGROUND
    picture = image + (1.0 - alpha) * behind
    if case in ("plain", "unknown"):
        known = eg.Scene([turned], None if case == "unknown" else BACKGROUND)
        return turned, {"mesh": known, "images": picture, "cameras": camera}
    cover = board(alpha, generator)
    stripes = torch.where(torch.arange(size)[:, None, None] // (size // 16) % 2 == 0, 0.8, 0.05)
    picture = cover * stripes + (1.0 - cover) * picture
    if case == "cut-out":
        return turned, {"mesh": turned, "images": picture, "cameras": camera, "masks": alpha * (1.0 - cover)}
    return turned, {"mesh": eg.Scene([turned], BACKGROUND), "images": picture, "cameras": camera}


def random_rotation(generator: torch.Generator, most: float) -> Tensor:
    """Return a rotation about a random axis by up to so many radians."""
    axis = torch.randn(3, generator=generator, dtype=torch.float64)
    return roma.rotvec_to_rotmat(most * torch.rand((), generator=generator) * axis / axis.norm())


def trial(mesh: eg.Mesh, case: str, seed: int, size: int = SIZE) -> tuple[float, float, PoseFit]:
    """Return degrees off at the start and at the end, and the fit; the true pose is the identity."""
    generator = torch.Generator().manual_seed(seed)
    turned, given = scene(mesh, case, generator, size)
    low, high = turned.verts.double().aminmax(dim=0)
    center, diagonal = (low + high) / 2, float((high - low).norm())
    start = torch.eye(4, dtype=torch.float64)
    R = random_rotation(generator, math.radians(TURN))
    off = torch.rand(3, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    start[:3, :3], start[:3, 3] = R, center - R @ center + SHIFT * diagonal * off / math.sqrt(3.0)
    fit = fit_pose(init=start, options=FitOptions(seed=seed, progress=False), **given)
    return degrees(R), degrees(fit.R), fit


def degrees(R: Tensor) -> float:
    return math.degrees(float(roma.rotmat_geodesic_distance(R, torch.eye(3, dtype=torch.float64))))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--case", choices=GOOD, default="plain")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--size", type=int, default=SIZE, help="pixels")
    parser.add_argument("--out", default="pose.png")
    args = parser.parse_args()
    mesh, limit = objects.load(args.mesh), GOOD[args.case]
    good = claimed = wrong = 0
    began = time.perf_counter()
    for seed in range(args.starts):
        before, after, fit = trial(mesh, args.case, seed, args.size)
        if seed == 0:
            fit.plot().savefig(args.out)
        good += after <= limit
        claimed += fit.converged
        wrong += fit.converged and after > limit
        print(
            f"{seed:3d}  {before:5.1f}° → {after:7.3f}°  explained {fit.explained:4.0%}  {fit.reason.split(':')[0]}",
            flush=True,
        )
    print(
        f"{args.case}: {good} of {args.starts} within {limit}°; {claimed} said to be converged, {wrong} of them wrongly; "
        f"{(time.perf_counter() - began) / args.starts:.1f} s each"
    )


if __name__ == "__main__":
    main()
