"""A sphere becomes a scan: its shape from 16 pictures, from coarse to fine, in coordinates in which steps are smooth.

    python examples/shape.py [MESH] [--views 16] [--size 256] [--given pictures] [--out shape.png]

The mesh, any file that load_mesh reads, or a knobbly stone, is seen under a soft light, whose colour at a point depends on its
normal alone; the fit knows this light, the cameras, pictures and masks. Or it gets masks alone (--given masks), and depths
(--given depths), or depths as a sensor gives them (--given sensor): with noise of 0.2 % of the diagonal, a tenth of the pixels
missing, and at the contour mixed with a wall behind; its masks are whole pixels. Printed is the Chamfer distance: the mean
distance of points on one surface to the other, both ways.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import objects
import torch
import torch.nn.functional as F
import trimesh
from scipy.spatial import cKDTree

import edgegrad as eg
from edgegrad.fit import FitOptions, Refinement, fit_shape
from edgegrad.fit.descent.result import Fit

# Radiance by the normal: constant, and a colour for each axis. Vertex colours, so no light has to be sampled.
EVEN = 0.5
LIGHT = torch.tensor([[0.30, 0.10, 0.02], [0.05, 0.25, 0.10], [0.12, 0.02, 0.30]])


def lit(mesh: eg.Mesh) -> eg.Mesh:
    normals = F.normalize(mesh.vertex_normals(), dim=1)
    return mesh.replace(colors=EVEN + normals @ LIGHT.to(normals))


def stone(subdivisions: int = 6) -> eg.Mesh:
    """Return 81,920 faces with bumps of two sizes."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    n = torch.tensor(ball.vertices)
    g = torch.Generator().manual_seed(1)
    r = torch.ones(len(n), dtype=torch.float64)
    for waves, height in ((3.0, 0.12), (9.0, 0.02)):
        r += height * torch.sin(waves * n @ torch.randn(3, 5, generator=g).double() + torch.arange(5)).sum(1)
    return eg.Mesh((r[:, None] * n).float(), torch.tensor(ball.faces))


NOISE, MISSING, WALL = 0.002, 0.1, 2.2  # of the sensor; noise and the wall's depth in diagonals


def fit(
    mesh: eg.Mesh, views: int = 16, size: int = 256, given: str = "pictures", levels: int = 3, **options: Any
) -> Fit:
    """Start from a sphere around the middle of the mesh's box, 0.35 of its diagonal in radius."""
    cameras = objects.around(mesh, views, size, distance=1.35)
    seen = [
        eg.render_aovs(lit(mesh), c, ["image", "alpha", "depth"], spp=64, seed=10_000 + k)
        for k, c in enumerate(cameras)
    ]
    low, high = mesh.verts.aminmax(dim=0)
    diagonal = float((high - low).norm())
    start = eg.shapes.sphere((low + high) / 2, 0.35 * diagonal, subdivisions=3)
    own = FitOptions(**{"seed": 0, "steps": 150, "spp": 4} | options)
    shared: dict[str, Any] = {"cameras": cameras, "refinement": Refinement(levels), "options": own}
    images, masks = ([found[name] for found in seen] for name in ("image", "alpha"))
    if given == "pictures":
        return fit_shape(start, images, masks=masks, appearance=lit, **shared)
    if given == "masks":
        return fit_shape(start, None, masks=masks, **shared)
    if given == "depths":
        depths = [torch.where(found["alpha"] > 0.999, found["depth"], 0.0) for found in seen]
        return fit_shape(start, None, masks=masks, depths=depths, **shared)
    depths = sensed(seen, diagonal)
    return fit_shape(start, None, masks=[(mask > 0.5).float() for mask in masks], depths=depths, **shared)


def sensed(seen: list[dict[str, torch.Tensor]], diagonal: float) -> list[torch.Tensor]:
    """Return depths as a sensor gives them."""
    g = torch.Generator().manual_seed(3)
    depths = []
    for found in seen:
        depth = found["depth"] + (1.0 - found["alpha"]) * WALL * diagonal
        depth = depth + NOISE * diagonal * torch.randn(depth.shape, generator=g)
        depth = torch.where(torch.rand(depth.shape, generator=g) < MISSING, torch.nan, depth)
        depths.append(torch.where(found["alpha"] > 0.02, depth, 0.0))
    return depths


def chamfer(a: eg.Mesh, b: eg.Mesh, count: int = 100_000) -> float:
    """Return percent of the diagonal of b's box."""

    def points(mesh: eg.Mesh) -> Any:
        surface = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
        return trimesh.sample.sample_surface(surface, count, seed=0)[0]

    p, q = points(a), points(b)
    low, high = b.verts.aminmax(dim=0)
    apart = 0.5 * (cKDTree(q).query(p)[0].mean() + cKDTree(p).query(q)[0].mean())
    return 100.0 * float(apart) / float((high - low).norm())


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--views", type=int, default=16)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--given", choices=("pictures", "masks", "depths", "sensor"), default="pictures")
    parser.add_argument("--out", default="shape.png")
    args = parser.parse_args()
    mesh = stone() if args.mesh is None else eg.load_mesh(args.mesh, materials=False)
    mesh = eg.Mesh(mesh.verts.float(), mesh.faces)
    wall, work = time.perf_counter(), time.process_time()
    found = fit(mesh, args.views, args.size, args.given)
    wall, work = time.perf_counter() - wall, time.process_time() - work
    found.plot().savefig(args.out)
    print(
        f"{len(mesh.faces)} faces, found with {len(found.mesh.faces)}: Chamfer distance {chamfer(found.mesh, mesh):.2f} % of the "
        f"diagonal; {wall:.0f} s, {work:.0f} s of processor time; {found.reason}"
    )


if __name__ == "__main__":
    main()
