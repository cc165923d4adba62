"""Mipmaps as shaders and meshes look them up: values, and derivatives by texels and by what moves."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.watched
F64 = torch.float64


def facing(texture: Tensor, pixels_a_texel: float) -> tuple[eg.Mesh, eg.Camera]:
    """A square that shows a texture in so many pixels a texel."""
    h, w = texture.shape[:2]
    verts = torch.tensor([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], dtype=F64)
    uvs = torch.tensor([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    f = pixels_a_texel
    size = round(h * f), round(w * f)
    K = torch.tensor([[f, 0, 0], [0, f, 0], [0, 0, 1]], dtype=F64)
    camera = eg.Camera(torch.eye(4, dtype=F64), K, size)
    return eg.Mesh(verts, faces, texture=texture, uvs=uvs, uv_faces=faces), camera


@pytest.mark.parametrize("levels", [0, 1, 2, 3])
def test_mipmaps_show_means_of_texels(levels: int):
    texture = torch.rand((32, 64, 3), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 0.5**levels)
    hits = eg.points.primary_hits(mesh, camera, spp=1, seed=0).hits
    mean = torch.nn.functional.avg_pool2d(texture.movedim(-1, 0), 2**levels).movedim(0, -1)
    expected = hits.sample(mean, uv=hits.uv)
    assert torch.allclose(hits.sample(texture, mipmap=True), expected, atol=1e-9)


def test_between_two_levels_mipmaps_are_linear():
    texture = torch.rand((32, 32, 2), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 2**-1.25)
    hits = eg.points.primary_hits(mesh, camera, spp=1, seed=0).hits
    levels = [torch.nn.functional.avg_pool2d(texture.movedim(-1, 0), 2**k).movedim(0, -1) for k in (1, 2)]
    low, high = (hits.sample(level, uv=hits.uv) for level in levels)
    assert torch.allclose(hits.sample(texture, mipmap=True), 0.75 * low + 0.25 * high, atol=1e-6)


def test_texels_get_gradients_through_mipmaps():
    texture = torch.rand((8, 8, 1), dtype=F64)
    mesh, camera = facing(texture, 0.5)

    def value(texture: Tensor) -> Tensor:
        return eg.points.primary_hits(mesh, camera, spp=1, seed=0).hits.sample(texture, mipmap=True)

    assert torch.autograd.gradcheck(value, texture.requires_grad_())


@pytest.mark.unwatched
@pytest.mark.parametrize("view", ["perspective", pytest.param("orthographic", marks=pytest.mark.slow)])
def test_levels_of_mipmaps_have_derivatives(view: str):
    """Differentiate by the square and by the camera at fixed places in the image. The square is turned away from the camera, so
    the level differs from place to place."""
    texture = torch.rand((64, 64, 2), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 1.0)
    R = torch.tensor([[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]], dtype=F64)
    mesh = mesh.transformed(R, torch.tensor([-26.0, -32, 120], dtype=F64))
    if view == "perspective":
        camera = eg.Camera.look_at((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), fov_y=25.0, size=(8, 8))
    else:
        camera = eg.Camera.orthographic((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), height=50.0, size=(8, 8))
    camera = camera.replace(world_to_camera=camera.world_to_camera.double(), K=camera.K.double())

    def value(verts: Tensor, uvs: Tensor, t: Tensor, focal: Tensor, texture: Tensor = texture) -> Tensor:
        moved = mesh.replace(verts=verts, uvs=uvs)
        W, K = camera.world_to_camera, camera.K
        W = torch.cat([torch.cat([W[:3, :3], W[:3, 3:] + t[:, None]], 1), W[3:]])
        K = torch.cat([torch.cat([focal * K[:2, :2], K[:2, 2:]], 1), K[2:]])
        return eg.points.primary_hits(moved, camera.replace(world_to_camera=W, K=K), spp=1, seed=0).hits.sample(
            texture, mipmap=True
        )

    assert mesh.uvs is not None
    leaves = [mesh.verts, mesh.uvs, torch.zeros(3, dtype=F64), torch.ones((), dtype=F64)]
    leaves = [leaf.detach().clone().requires_grad_() for leaf in leaves]
    assert len(value(*leaves)) > 40
    assert torch.autograd.gradcheck(value, leaves, eps=1e-7, atol=1e-4, rtol=1e-3)


def test_mipmaps_need_neighbours():
    texture = torch.rand((8, 8, 1), dtype=F64)
    mesh, camera = facing(texture, 0.5)
    hits = eg.points.primary_hits(mesh, camera, spp=1, seed=0).hits
    with pytest.raises(ValueError, match="mipmap: expected the surface's own texture coordinates"):
        hits.sample(texture, uv=hits.uv, mipmap=True)
    rays = eg.points.trace(mesh, torch.zeros(3), torch.tensor([1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="mipmap: expected hits of a camera"):
        rays.sample(texture, mipmap=True)
    with pytest.raises(ValueError, match=r"mipmap: expected filter="):
        hits.sample(texture, mipmap=True, filter="nearest")


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [("repeat", [2, 0, 1, 2, 0]), ("clamp", [0, 0, 1, 2, 2]), ("mirror", [0, 0, 1, 2, 2])],
)
def test_beyond_the_border(wrap: str, expected: list[int]):
    texture = torch.arange(3.0, dtype=F64).reshape(1, 3, 1)
    mesh, camera = facing(texture, 1.0)
    hits = eg.points.primary_hits(mesh, camera, spp=1, seed=0).hits
    for k, value in zip((-1, 0, 1, 2, 3), expected, strict=True):
        uv = torch.tensor([(k + 0.5) / 3, 0.5], dtype=F64).expand(len(hits), 2)
        for filter in ("nearest", "linear"):
            assert torch.allclose(
                hits.sample(texture, uv=uv, wrap=wrap, filter=filter), torch.tensor(float(value)).double()
            )
    far = torch.tensor([4.5 / 3 + 2, 0.5], dtype=F64).expand(
        len(hits), 2
    )  # texel 10: mirrored 1, repeated 1, clamped 2
    assert torch.allclose(
        hits.sample(texture, uv=far, wrap=wrap), torch.tensor(2.0 if wrap == "clamp" else 1.0).double()
    )


def test_meshes_with_mipmaps_are_shaded_by_them():
    texture = torch.rand((32, 64, 3), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 0.3)
    found = []
    for shader in (None, lambda hits: hits.sample(texture, mipmap=True)):
        looked_up = mesh.replace(filter="linear" if shader else "mipmap")
        image = eg.render(looked_up, camera, spp=4, seed=3, shader=shader)
        found.append(image.detach())
    assert torch.allclose(*found, rtol=1e-9, atol=1e-12)
    fine = mesh.replace(filter="mipmap")
    assert torch.allclose(eg.render_aovs(fine, camera, ["image"], 4, 3)["image"], found[0], atol=1e-12)
    assert "with mipmaps" in eg.plan(fine, camera)["textures"].why
    single = fine.replace(texture=texture.float())  # the image has the type of the colours, as without mipmaps
    assert eg.render(single, camera, spp=1, seed=0).dtype == torch.float32
    with pytest.raises(ValueError, match='screen_gradient: expected textures with filter "linear" or "nearest"'):
        eg.screen_gradient(fine, camera, found[0], seed=0)


@pytest.mark.unwatched
def test_meshes_with_mipmaps_have_gradients():
    """The derivative along the texture is the image. That along a shift across the image, which changes no level, is a finite
    difference."""
    generator = torch.Generator().manual_seed(2)
    mesh, camera = facing(torch.rand((48, 48, 2), generator=generator, dtype=F64), 0.4)
    K = camera.K + torch.tensor([[0, 0, 3], [0, 0, 3], [0, 0, 0]], dtype=F64)  # so that the border is in the image
    camera = camera.replace(K=K, size=(25, 25))
    weights = torch.arange(25, dtype=F64)[None, :, None].expand(25, 25, 2)
    shift = torch.tensor([1.0, 0.5, 0.0], dtype=F64)

    def loss(mesh: eg.Mesh, seed: int) -> Tensor:
        return (weights * eg.render(mesh, camera, spp=256, seed=seed, sampling=eg.Sampling(surface=4000))).sum()

    rows, h, count = [], 2.0, 24
    for seed in range(count):
        # At evenly spaced places, whose mean the difference is: what crosses the image's border changes with the place.
        place = torch.tensor(h * ((2 * seed + 1) / count - 1), dtype=F64)
        texture, t = mesh.texture.clone().requires_grad_(), place.requires_grad_()  # pyright: ignore
        moved = mesh.replace(verts=mesh.verts + t * shift, texture=texture, filter="mipmap")
        value = loss(moved, seed)
        by_texture, by_t = torch.autograd.grad(value, [texture, t])
        value, along = value.detach(), (by_texture * texture.detach()).sum()
        ahead, back = (
            loss(mesh.replace(verts=mesh.verts + s * h * shift, filter="mipmap"), seed).detach() for s in (1, -1)
        )
        rows.append([float(along - value), float(value), float(by_t), float(ahead - back) / (2 * h)])
    along, value, by_shift, difference = torch.tensor(rows, dtype=F64).T
    error = (by_shift - difference).std() / len(rows) ** 0.5
    assert abs(float(along.mean())) < 4 * float(along.std()) / len(rows) ** 0.5 < 0.01 * float(value.mean())
    assert abs(float((by_shift - difference).mean())) < 4 * float(error)
    assert float(error) < 0.0125 * abs(float(difference.mean()))
