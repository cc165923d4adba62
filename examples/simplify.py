"""A mesh of few faces that looks like one of many: simplified, moved until its pictures agree, and given a baked texture.

    python examples/simplify.py [MESH] [--faces 300] [--steps 100] [--out simple.glb]

It needs fast-simplification (`pip install fast-simplification`). It prints the mean difference of pictures from new sides, in
percent.
"""

from __future__ import annotations

import argparse
from typing import NamedTuple

import fast_simplification
import objects
import torch
from shape import lit, stone

import edgegrad as eg
from edgegrad.fit import FitOptions, Refinement, fit_shape

SIZE = 128


class Differences(NamedTuple):
    """Mean differences of pictures, in percent of white."""

    simplified: float
    baked: float  # with a texture
    fitted: float  # and moved before


def simplified(mesh: eg.Mesh, faces: int) -> eg.Mesh:
    verts, triangles = fast_simplification.simplify(
        mesh.verts.numpy(), mesh.faces.int().numpy(), target_reduction=1 - faces / len(mesh.faces)
    )
    return eg.Mesh(torch.from_numpy(verts).float(), torch.from_numpy(triangles).long())


def textured(mesh: eg.Mesh, source: eg.Mesh, texels: int = 256) -> eg.Mesh:
    mesh = eg.textures.unwrap(mesh, size=texels)
    return mesh.replace(texture=eg.textures.bake(mesh, source, texels))


def simplify(mesh: eg.Mesh, faces: int = 300, steps: int = 100) -> tuple[eg.Mesh, Differences]:
    """Return the mesh found, and how far pictures of three stages are off."""
    mesh = lit(mesh)
    cameras = objects.around(mesh, 16, SIZE)
    images = [eg.render(mesh, camera, spp=64, seed=k) for k, camera in enumerate(cameras)]
    masks = [eg.render_aovs(mesh, camera, ["alpha"], spp=64)["alpha"] for camera in cameras]
    new = objects.around(mesh, 7, SIZE)
    wanted = [eg.render(mesh, camera, spp=64, seed=99) for camera in new]

    def difference(other: eg.Mesh) -> float:
        off = [
            (eg.render(other, camera, spp=64, seed=98) - image).abs().mean()
            for camera, image in zip(new, wanted, strict=True)
        ]
        return 100 * float(torch.stack(off).mean())

    simple = simplified(mesh, faces)
    fit = fit_shape(
        simple,
        images,
        cameras,
        masks=masks,
        appearance=lit,
        refinement=Refinement(levels=1, lr=0.002, smoothness=1.0),
        options=FitOptions(seed=0, steps=steps, spp=4),
    )
    assert fit.mesh is not None
    found = textured(fit.mesh, mesh)
    return found, Differences(difference(lit(simple)), difference(textured(simple, mesh)), difference(found))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="?")
    parser.add_argument("--faces", type=int, default=300)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--out")
    options = parser.parse_args()
    given = stone(5) if options.mesh is None else eg.load_mesh(options.mesh, materials=False)
    result, off = simplify(eg.Mesh(given.verts.float(), given.faces), options.faces, options.steps)
    print(f"simplified {off.simplified:.2f} %   with a texture {off.baked:.2f} %   fitted before {off.fitted:.2f} %")
    if options.out:
        eg.save_mesh(options.out, result)
