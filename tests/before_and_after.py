"""Images and gradients of 25 scenes, to be compared bit by bit before and after a change that is to change no result.

python tests/before_and_after.py FILE.npz            writes them
python tests/before_and_after.py FILE.npz --compare  fails where one differs from what is in the file
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr
from edgegrad import fit

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
    """Nearest texels, an alpha-tested face and a lens that distorts."""
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
    """A material under a light, a square and an environment, with shadows."""
    verts, faces = grid()
    verts, base, rough = leaf(verts), leaf(colors(len(verts))), leaf(torch.tensor(0.4))
    blocker = torch.tensor([[-0.4, -0.3, 0.8], [0.4, -0.3, 0.9], [0.0, 0.4, 0.8]])
    material = eg.Material(base_color=base, roughness=rough, metallic=0.3)
    meshes = [
        eg.Mesh(verts, faces, material=material, normals=eg.Mesh(verts, faces).vertex_normals()),
        eg.Mesh(blocker, torch.tensor([[0, 1, 2]]), material=eg.Material()),
    ]
    position = leaf(torch.tensor([0.5, 1.5, 2.5]))
    sky = leaf(colors(8 * 16).reshape(8, 16, 3))
    edges = torch.tensor([[-1.0, 1.0, 2.0], [0.5, 0.0, 0.0], [0.0, 0.5, 0.2]])
    square = eg.shapes.rectangle(*edges, material=eg.Material(base_color=0.0, emission=3.0))
    lights = [eg.lights.PointLight(position, 4.0), square, eg.lights.Environment(sky)]
    view = camera()
    image = eg.render(eg.Scene(meshes, lights=lights), view, spp=8, seed=5)
    leaves = {"verts": verts, "base": base, "rough": rough, "position": position, "sky": sky}
    return gradients(image, **leaves, pose=view.world_to_camera)


def shaded() -> Arrays:
    """A shader of the user's, with edges between its colours."""
    verts, faces = grid()
    verts = leaf(verts)

    def stripes(hits: eg.points.Hits) -> Tensor:
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


def through(**fields: Any) -> Callable[[], Arrays]:
    """The coloured sheet through another camera than a pinhole."""

    def scene() -> Arrays:
        verts, faces = grid()
        verts = leaf(verts)
        view: eg.Camera = fields["make"]()
        view = view.replace(world_to_camera=leaf(view.world_to_camera))
        mesh = eg.Mesh(verts, faces, face_colors=colors(len(faces)))
        image = eg.render(mesh, view, spp=4, seed=9, filter=fields.get("filter", "box"))
        return gradients(image, verts=verts, pose=view.world_to_camera)

    return scene


def orthographic() -> eg.Camera:
    return eg.Camera.orthographic((0.3, 0.5, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.4, SIZE)


def fisheye(angle: float) -> eg.Camera:
    matrix = camera().detach().world_to_camera
    focal = 24.0 / math.radians(angle)
    K = torch.tensor([[focal, 0.0, SIZE[1] / 2], [0.0, focal, SIZE[0] / 2], [0.0, 0.0, 1.0]])
    return eg.Camera.fisheye(matrix[:3, :3], matrix[:3, 3], K, SIZE, torch.tensor([0.02, -0.01, 0.003, -0.001]))


def panorama() -> eg.Camera:
    return eg.Camera.panorama(camera().detach().world_to_camera, SIZE)


def under(lights: Callable[[], Sequence[Any]], options: dict[str, Any], **look: Any) -> Callable[[], Arrays]:
    """A sheet below a triangle with materials, both moving, under other lights."""

    def scene() -> Arrays:
        verts, faces = grid()
        verts, base, rough = leaf(verts), leaf(colors(len(verts))), leaf(torch.tensor(0.3))
        caster = leaf(torch.tensor([[-0.4, -0.3, 0.6], [0.5, -0.3, 0.9], [0.0, 0.6, 0.7]]))
        alpha = None if "alpha_mode" not in look else colors(64, 1).reshape(8, 8)
        flat = eg.Mesh(
            verts, faces, material=eg.Material(base, 0.6, rough), normals=eg.Mesh(verts, faces).vertex_normals()
        )
        uvs = torch.tensor([[0.1, 0.1], [0.9, 0.2], [0.4, 0.8]])
        over = eg.Mesh(
            caster, torch.tensor([[0, 1, 2]]), uvs=uvs, uv_faces=torch.tensor([[0, 1, 2]]), alpha=alpha,
            material=eg.Material(0.6, 0.0, 0.5, alpha_mode=look.get("alpha_mode", "MASK")),
        )  # fmt: skip
        view = camera()
        image = eg.render(eg.Scene([flat, over], lights=lights()), view, spp=4, seed=10, **options)
        leaves = {"verts": verts, "caster": caster, "base": base, "rough": rough}
        return gradients(image, **leaves, pose=view.world_to_camera)

    return scene


def point() -> list[Any]:
    return [eg.lights.PointLight(torch.tensor([0.5, 1.5, 2.5]), 4.0)]


def cone_and_sun() -> list[Any]:
    down = torch.tensor([-0.1, -0.5, -1.0])
    cone = eg.lights.SpotLight(torch.tensor([0.2, 0.6, 2.0]), down, 5.0, inner_angle=0.2, outer_angle=0.5)
    return [cone, eg.lights.DirectionalLight(torch.tensor([0.4, -0.6, -1.0]), 1.5)]


def shining_mesh() -> list[Any]:
    corners = torch.tensor([[-0.8, 1.0, 1.8], [0.9, 1.1, 1.5], [0.1, 0.2, 2.4], [0.3, 1.6, 2.2]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    return [eg.Mesh(corners, faces, material=eg.Material(0.0, emission=4.0))]


def sky() -> list[Any]:
    return [eg.lights.Environment(colors(8 * 16).reshape(8, 16, 3)), eg.lights.SphericalHarmonics(colors(9) / 3)]


def minified() -> Arrays:
    """Mipmaps, a normal map and a texture with corners whose colours differ, in double."""
    verts, faces = grid()
    verts = leaf(verts.double())
    uvs = leaf(6 * (verts.detach()[:, :2] + 1))
    texture = leaf(colors(32 * 32, dtype=torch.float64).reshape(32, 32, 3))
    bumps = eg.Texture(
        colors(64, dtype=torch.float64).reshape(8, 8, 3) * 0.3 + torch.tensor([0.35, 0.35, 0.7]).double()
    )
    material = eg.Material(eg.Texture(texture, filter="mipmap"), 0.2, 0.5, normal_map=bumps)
    mesh = eg.Mesh(verts, faces, uvs=uvs, uv_faces=faces, material=material)
    light = eg.lights.DirectionalLight(torch.tensor([0.2, -0.3, -1.0], dtype=torch.float64), 2.0)
    image = eg.render(eg.Scene(mesh, lights=[light]), camera().to(torch.float64), spp=4, seed=11)
    return gradients(image, verts=verts, texture=texture, uvs=uvs)


def stepping() -> Arrays:
    """A shader that declares where its colours jump, and looks up light and shadows itself."""
    verts, faces = grid()
    verts, edge = leaf(verts), leaf(torch.tensor(0.1))

    def shade(hits: eg.points.Hits) -> Tensor:
        light = hits.lights[0]
        points = hits.light_points(light)
        arriving = light.arriving(points, hits.position) * hits.visible_from(light, points).reshape(-1, 1)
        stripe = hits.where(hits.position[:, 0] - edge, torch.tensor(0.2), torch.tensor(0.9))
        return stripe.reshape(-1, 1) * arriving.reshape(len(hits), -1)

    view = camera()
    caster = torch.tensor([[-0.4, -0.3, 0.6], [0.5, -0.3, 0.9], [0.0, 0.6, 0.7]])
    meshes = [eg.Mesh(verts, faces), eg.Mesh(caster, torch.tensor([[0, 1, 2]]))]
    image = eg.render(eg.Scene(meshes, lights=point()), view, spp=4, seed=12, shader=shade)
    return gradients(image, verts=verts, edge=edge, pose=view.world_to_camera)


def lit_directional() -> Arrays:
    """The derivative of a lit image along a direction of the vertices, with shadows and two bounces."""
    verts, faces = grid()
    sheet = eg.Mesh(verts, faces, material=eg.Material(0.7))
    caster = torch.tensor([[-0.4, -0.3, 0.6], [0.5, -0.3, 0.9], [0.0, 0.6, 0.7]])
    with torch.autograd.forward_ad.dual_level():
        dual = torch.autograd.forward_ad.make_dual(caster, torch.cos(caster))
        scene = eg.Scene([sheet, eg.Mesh(dual, torch.tensor([[0, 1, 2]]), material=eg.Material(0.5))], lights=point())
        primal, tangent = torch.autograd.forward_ad.unpack_dual(
            eg.render(scene, camera().detach(), spp=4, seed=13, bounces=2)
        )
    assert tangent is not None
    return {"image": primal, "tangent": tangent}


def rasterized() -> Arrays:
    """nvdiffrast's four operators, with centres and with exact coverage."""
    verts, faces = grid()
    verts, texture = leaf(verts), leaf(colors(64).reshape(1, 8, 8, 3))
    w = 2.5 - verts[:, 2:] + 0.3 * verts[:, :1]
    pos = torch.cat([verts[:, :2] * 1.6, w - 1.5, w], 1)[None]
    tri = faces.int()
    rast, rast_db = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, SIZE)
    uv, uv_da = dr.interpolate((verts[None, :, :2] + 1) / 2, rast, tri, rast_db, diff_attrs="all")
    color = dr.texture(texture, uv, uv_da, filter_mode="linear-mipmap-linear")
    both = [dr.antialias(color, rast, pos, tri), dr.antialias(color, rast, pos, tri, exact=True)]
    return gradients(torch.cat(both, -1), verts=verts, texture=texture)


def bracket() -> tuple[eg.Mesh, Tensor]:
    verts = torch.tensor(
        [[0, 0, 0], [1, 0, 0], [1, 0.2, 0], [0.2, 0.2, 0], [0.2, 0.8, 0], [0, 0.8, 0]], dtype=torch.float32
    )
    solid = torch.cat([verts, verts + torch.tensor([0.0, 0.0, 0.3])]) - torch.tensor([0.4, 0.35, 0.15])
    front = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    around = torch.arange(6)
    following = (around + 1) % 6
    sides = torch.cat(
        [torch.stack([around, around + 6, following], 1), torch.stack([following, around + 6, following + 6], 1)]
    )
    faces = torch.cat([front.flip(1), front + 6, sides.flip(1)])
    mesh = eg.Mesh(solid, faces, face_colors=colors(len(faces)))
    matrix = torch.eye(4)
    matrix[:3, :3] = torch.linalg.matrix_exp(torch.tensor([[0, -0.15, 0.1], [0.15, 0, -0.2], [-0.1, 0.2, 0.0]]))
    return mesh, matrix


def posed() -> Arrays:
    """A pose that a fit finds in a few steps."""
    mesh, matrix = bracket()
    view = camera().detach()
    moved = mesh.replace(verts=mesh.verts @ matrix[:3, :3].T)
    target = eg.render(moved, view, spp=32, seed=0)
    found = fit.fit_pose(mesh, target, view, init=torch.eye(4), options=fit.FitOptions(seed=0, steps=6, progress=False))
    return {"matrix": found.matrix}


def fitted() -> Arrays:
    """The colour and the place of a scene after a few steps of a fit."""
    mesh, matrix = bracket()
    view = camera().detach()
    target = eg.render(mesh.replace(verts=mesh.verts @ matrix[:3, :3].T), view, spp=16, seed=0)
    found = fit.fit_scene(
        mesh, [target], view, {"verts": 0.01, "face_colors": 0.02}, options=fit.FitOptions(seed=0, steps=8, progress=False),
    )  # fmt: skip
    return {"verts": found.scene.meshes[0].verts, "colors": found.scene.meshes[0].face_colors}


SCENES: dict[str, Callable[[], Arrays]] = {
    **{scene.__name__: scene for scene in (colored, textured, lit, shaded, channels, directional)},
    "orthographic": through(make=orthographic, filter="gaussian"),
    "fisheye": through(make=lambda: fisheye(50.0)),
    "wide fisheye": through(make=lambda: fisheye(110.0)),
    "panorama": through(make=panorama),
    "tent filter": through(make=lambda: camera().detach(), filter="tent"),
    "cone and sun": under(cone_and_sun, {}),
    "point light, three bounces": under(point, {"bounces": 3}),
    "mesh that shines": under(shining_mesh, {"sampling": eg.Sampling(lights=2)}),
    "mesh that shines, two bounces": under(shining_mesh, {"bounces": 2}),
    "sky": under(sky, {}),
    "alpha-tested, shadows": under(point, {}, alpha_mode="MASK"),
    "alpha-blended, sky": under(sky, {}, alpha_mode="BLEND"),
    "without shadows": under(cone_and_sun, {"shadows": False}),
    **{scene.__name__: scene for scene in (minified, stepping, lit_directional, rasterized, posed, fitted)},
}


def measured() -> dict[str, np.ndarray]:
    return {f"{name} {n}": t.detach().numpy() for name, scene in SCENES.items() for n, t in scene().items()}


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
