"""Images and gradients of six scenes, to be compared bit by bit before and after a change that is to change no result.

python tests/same_bits.py FILE.npz            writes them
python tests/same_bits.py FILE.npz --compare  fails where one differs from what is in the file
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg

Arrays = dict[str, Tensor]
SIZE = (40, 48)


def camera() -> eg.Camera:
    camera = eg.Camera.look_at((0.3, 0.5, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, SIZE)
    return camera.replace(
        world_to_camera=camera.world_to_camera.clone().requires_grad_(), K=camera.K.clone().requires_grad_()
    )


def grid(n: int = 6, height: float = 0.3) -> tuple[Tensor, Tensor]:
    """Vertices and faces of a wavy sheet, with texture coordinates in its x and y."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, n), torch.linspace(-1, 1, n), indexing="ij")
    verts = torch.stack([x, y, height * torch.sin(3 * x) * torch.cos(2 * y)], -1).reshape(-1, 3)
    corner = (torch.arange(n - 1)[:, None] * n + torch.arange(n - 1)).reshape(-1)
    faces = torch.cat(
        [torch.stack([corner, corner + 1, corner + n], 1), torch.stack([corner + 1, corner + n + 1, corner + n], 1)]
    )
    return verts, faces


def leaf(tensor: Tensor) -> Tensor:
    return tensor.clone().requires_grad_()


def colors(count: int, channels: int = 3, dtype: torch.dtype = torch.float32) -> Tensor:
    generator = torch.Generator().manual_seed(5)
    return torch.rand((count, channels), generator=generator, dtype=dtype)


def gradients(image: Tensor, **leaves: Tensor) -> Arrays:
    weight = torch.sin(torch.arange(image.numel(), dtype=torch.float64)).reshape(image.shape).to(image)
    found = torch.autograd.grad((image * weight).sum(), list(leaves.values()), allow_unused=True)
    return {"image": image.detach(), **{n: g for n, g in zip(leaves, found, strict=True) if g is not None}}


def colored() -> Arrays:
    """Vertex colours in double, silhouettes, and a face that passes through the sheet."""
    verts, faces = grid()
    verts, color = leaf(verts.double()), leaf(colors(len(verts), dtype=torch.float64))
    blade = torch.tensor([[-0.6, -0.5, -0.5], [0.7, -0.2, 0.6], [0.0, 0.9, 0.2]], dtype=torch.float64)
    other = eg.Mesh(blade, torch.tensor([[0, 1, 2]]), face_colors=colors(1, dtype=torch.float64))
    view = camera().to(torch.float64)
    image = eg.render(eg.Scene([eg.Mesh(verts, faces, colors=color), other]), view, spp=8, seed=3)
    return gradients(image, verts=verts, colors=color)


def textured() -> Arrays:
    """Nearest texels, a cut-out and a lens that distorts."""
    verts, faces = grid()
    uvs = leaf((verts[:, :2] + 1) / 2)
    verts, texture = leaf(verts), leaf(colors(64, 1).reshape(8, 8, 1))
    alpha = colors(64, 1).reshape(8, 8)
    mesh = eg.Mesh(verts, faces, texture=texture, uvs=uvs, uv_faces=faces, alpha=alpha, filter="nearest", wrap="repeat")
    view = camera().replace(distortion=leaf(torch.tensor([0.05, -0.02, 0.001, 0.002])))
    image = eg.render(eg.Scene(mesh, background=torch.tensor([0.2])), view, spp=8, seed=4)
    leaves = {"verts": verts, "texture": texture, "uvs": uvs, "K": view.K, "distortion": view.distortion}
    return gradients(image, **leaves)


def lit() -> Arrays:
    """A material under a lamp, a square and an environment, with shadows."""
    verts, faces = grid()
    verts, base, rough = leaf(verts), leaf(colors(len(verts))), leaf(torch.tensor(0.4))
    blocker = torch.tensor([[-0.4, -0.3, 0.8], [0.4, -0.3, 0.9], [0.0, 0.4, 0.8]])
    material = eg.Material(base_color=base, roughness=rough, metallic=0.3)
    meshes = [
        eg.Mesh(verts, faces, material=material, normals=eg.vertex_normals(verts, faces)),
        eg.Mesh(blocker, torch.tensor([[0, 1, 2]]), material=eg.Material()),
    ]
    position = leaf(torch.tensor([0.5, 1.5, 2.5]))
    sky = leaf(colors(8 * 16).reshape(8, 16, 3))
    edges = torch.tensor([[-1.0, 1.0, 2.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.2]])
    square = eg.AreaLight.rectangle(*edges, radiance=3.0)
    lights = [eg.PointLight(position, 4.0), square, eg.Environment(sky)]
    view = camera()
    image = eg.render(eg.Scene(meshes, lights=lights), view, spp=8, seed=5)
    leaves = {"verts": verts, "base": base, "rough": rough, "position": position, "sky": sky}
    return gradients(image, **leaves, pose=view.world_to_camera)


def shaded() -> Arrays:
    """A shader of the user's, with edges between its colours."""
    verts, faces = grid()
    verts = leaf(verts)

    def stripes(hits: eg.Hits) -> Tensor:
        wave = torch.sin(7 * hits.position[:, :1]) * hits.normal[:, 1:2]
        return torch.cat([wave, wave.square(), hits.position[:, 2:]], 1)

    view = camera()
    image = eg.render(eg.Scene(eg.Mesh(verts, faces)), view, spp=8, seed=6, shader=stripes)
    return gradients(image, verts=verts, pose=view.world_to_camera)


def channels() -> Arrays:
    """Depth, normals, alpha and positions of a batch of two cameras, one of them turned."""
    verts, faces = grid()
    verts = leaf(verts)
    first = camera()
    turned = torch.eye(4)
    turned[0, 0] = turned[1, 1] = math.cos(0.2)
    turned[1, 0] = math.sin(0.2)
    turned[0, 1] = -math.sin(0.2)
    batch = eg.Camera.stack([first, first.replace(world_to_camera=turned @ first.world_to_camera)])
    mesh = eg.Mesh(verts, faces, colors=colors(len(verts)))
    found = eg.render_aovs(mesh, batch, ("image", "alpha", "depth", "normal", "position"), spp=4, seed=7)
    return gradients(torch.cat(list(found.values()), -1), verts=verts, pose=first.world_to_camera)


def directional() -> Arrays:
    """The image's derivative along a direction, and the derivative by places on the screen."""
    verts, faces = grid()
    mesh = eg.Mesh(verts, faces, colors=colors(len(verts)))
    moved = eg.Mesh(torch.sin(5 * verts), faces, colors=torch.zeros(len(verts), 3))
    view = camera().detach()
    weight = torch.cos(torch.arange(SIZE[0] * SIZE[1] * 3, dtype=torch.float32)).reshape(*SIZE, 3)
    screen = eg.screen_gradient(mesh, view, weight, spp=8, seed=8)
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(mesh.verts, moved.verts)
        image = eg.render(mesh.replace(verts=dual), view, spp=8, seed=8)
        primal, tangent = torch.autograd.forward_ad.unpack_dual(image)
    assert tangent is not None
    return {"screen": screen, "image": primal, "tangent": tangent}


SCENES: tuple[Callable[[], Arrays], ...] = (colored, textured, lit, shaded, channels, directional)


def measured() -> dict[str, np.ndarray]:
    return {f"{scene.__name__} {n}": t.detach().numpy() for scene in SCENES for n, t in scene().items()}


def main(file: str, compare: bool) -> int:
    found = measured()
    if not compare:
        np.savez(file, **found)  # pyright: ignore[reportArgumentType]
        print(f"{len(found)} arrays of {len(SCENES)} scenes written to {file}")
        return 0
    with np.load(file) as kept:
        names = sorted(set(kept.files) | set(found))
        different = [n for n in names if n not in found or n not in kept or kept[n].tobytes() != found[n].tobytes()]
    for name in different:
        print(f"differs: {name}")
    print(f"{len(names) - len(different)} of {len(names)} arrays are equal bit by bit")
    return bool(different)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], "--compare" in sys.argv[2:]))
