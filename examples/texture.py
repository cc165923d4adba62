"""Find the texture of a known shape from 8 pictures of it, judged by a view that was not among them.

    python examples/texture.py [MESH] [--size 256] [--out texture.png]

The mesh, any file with a texture that load_mesh reads, or a painted stone, is rendered; the fit gets its shape, the cameras
and the pictures.
"""

from __future__ import annotations

import argparse
import math
from typing import Any

import objects

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_texture
from edgegrad.fit.descent.result import Fit


def fit(mesh: eg.Mesh, size: int = 256, texels: int = 256, **options: Any) -> Fit:
    cameras = objects.around(mesh, 8, size)
    pictures = [eg.render(mesh, camera, spp=64, seed=10_000 + k) for k, camera in enumerate(cameras)]
    bare = eg.Mesh(mesh.verts, mesh.faces, uvs=mesh.uvs, uv_faces=mesh.uv_faces)
    given = FitOptions(**{"seed": 0, "steps": 120, "spp": 4} | options)
    return fit_texture(bare, pictures, cameras, texels, options=given)


def held_out(mesh: eg.Mesh, found: eg.Mesh, size: int = 256) -> float:
    """Return the PSNR in dB, of radiance in 0 … 1, in a view between those of the fit."""
    camera = objects.around(mesh, 13, size)[5]
    a, b = (eg.render(m, camera, spp=256, seed=s).clamp(0.0, 1.0) for m, s in ((mesh, 1), (found, 2)))
    return -10.0 * math.log10(float((a - b).square().mean()))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--out", default="texture.png")
    args = parser.parse_args()
    mesh = objects.load(args.mesh)
    found = fit(mesh, args.size)
    found.plot().savefig(args.out)
    print(
        f"PSNR {held_out(mesh, found.mesh, args.size):.1f} dB in a view held out; {found.seconds:.0f} s; {found.reason}"
    )


if __name__ == "__main__":
    main()
