"""bake(), bake_pictures(), unwrap(): textures whose right values are known."""

from __future__ import annotations

import math

import pytest
import torch
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.baking import SurfacePoints


def square(z: float = 0.0) -> eg.Mesh:
    """(0 … 1)², facing +z, with texture coordinates as positions."""
    corners = torch.tensor([[0.0, 0, z], [1, 0, z], [1, 1, z], [0, 1, z]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return eg.Mesh(corners, faces, uvs=corners[:, :2].contiguous(), uv_faces=faces)


def centres(h: int, w: int) -> tuple[Tensor, Tensor]:
    """x and y of texels, row 0 on top."""
    y, x = torch.meshgrid(1 - (torch.arange(h) + 0.5) / h, (torch.arange(w) + 0.5) / w, indexing="ij")
    return x, y


@pytest.mark.parametrize("by", ["rays", "nearest"])
@pytest.mark.parametrize("lift", [-0.02, 0.02])
def test_colors_of_another_mesh(by: str, lift: float) -> None:
    other = square(lift)
    other = eg.Mesh(
        other.verts, other.faces, colors=other.verts * torch.tensor([1.0, 1, 0]) + torch.tensor([0.0, 0, 0.3])
    )
    texture = eg.textures.bake(square(), other, (6, 8), by=by)
    x, y = centres(6, 8)
    torch.testing.assert_close(texture, torch.stack([x, y, torch.full_like(x, 0.3)], 2))


def test_rays_beyond_their_reach_give_the_nearest_point() -> None:
    other = square(0.5)
    other = eg.Mesh(other.verts + torch.tensor([2.0, 0, 0]), other.faces, colors=other.verts)
    texture = eg.textures.bake(square(), other, 4, reach=0.01)
    assert torch.allclose(texture[..., 0], torch.zeros(()), atol=1e-6)  # its left edge
    torch.testing.assert_close(texture[..., 1], centres(4, 4)[1])


def test_normals_of_a_sphere() -> None:
    ball = icosphere(3)
    ball = eg.Mesh(ball.verts.float(), ball.faces, normals=ball.verts.float())
    cage = eg.textures.unwrap(eg.Mesh(icosphere(1).verts.float(), icosphere(1).faces), size=64)
    texture = eg.textures.bake(cage, ball, 64, what="normal", reach=0.3)
    used = eg.textures.bake(cage, lambda points: torch.ones(len(points.face), 1), 64, margin=0)[..., 0] > 0
    position = eg.textures.bake(cage, lambda points: points.position, 64)
    cosine = (texture * torch.nn.functional.normalize(position, dim=2)).sum(2)[used]
    assert used.float().mean() > 0.3 and cosine.min() > math.cos(math.radians(25)) and cosine.mean() > 0.995


@pytest.mark.parametrize("smooth", [True, False])
def test_a_normal_map_shades_as_the_fine_mesh(smooth: bool) -> None:
    """The map has bumps that the coarse mesh, with interpolated normals or the faces', does not have."""
    coarse, fine = icosphere(2).verts.double(), icosphere(4)
    verts = fine.verts.double() * (1 + 0.03 * torch.sin(7 * fine.verts.double()).prod(1, keepdim=True))
    normals = eg.Mesh(verts.float(), fine.faces).vertex_normals()
    wanted = eg.Mesh(verts.float(), fine.faces, normals=normals, material=eg.Material())
    mesh = eg.Mesh(coarse.float(), icosphere(2).faces, normals=coarse.float() if smooth else None)
    mesh = eg.textures.unwrap(mesh, size=128)
    camera = eg.Camera.look_at((1.5, 1, 2.5), (0, 0, 0), (0, 1, 0), 30.0, (64, 64))
    light = eg.lights.DirectionalLight(torch.tensor([-0.6, -0.5, -0.4]), 3.0)

    def shaded(normal_map: Tensor | None) -> Tensor:
        material = eg.Material(normal_map=None if normal_map is None else eg.Texture(normal_map))
        return eg.render(eg.Scene([mesh.replace(material=material)], lights=[light]), camera, shadows=False, seed=0)

    image = eg.render(eg.Scene([wanted], lights=[light]), camera, shadows=False, seed=0)
    normal_map = eg.textures.bake(mesh, wanted, 128, what="normal_map")
    mirrored = torch.stack([normal_map[..., 0], 1 - normal_map[..., 1], normal_map[..., 2]], 2)
    middle = slice(12, -12)  # silhouettes lie elsewhere
    off = [float((shaded(m) - image)[middle, middle].abs().mean() / image.mean()) for m in (normal_map, mirrored, None)]
    assert off[0] < 0.015 and min(off[1:]) > 0.027, off


def test_visibility_next_to_a_wall() -> None:
    """An endless wall covers half of the sky at its foot; the floor away from it sees (1 + cos) / 2."""
    wall = torch.tensor([[0.0, -400, 0], [0, 400, 0], [0, 400, 0.5], [0, -400, 0.5]])
    texture = eg.textures.bake(
        square(),
        eg.Mesh(wall, torch.tensor([[0, 1, 2], [0, 2, 3]])),
        (2, 4),
        what="visibility",
        rays=8192,
        progress=False,
    )
    x, _ = centres(2, 4)
    elevation = torch.atan2(torch.full_like(x, 0.5), x)
    torch.testing.assert_close(texture[..., 0], (1 + elevation.cos()) / 2, atol=0.02, rtol=0)


def test_a_function_and_a_margin() -> None:
    given: list[SurfacePoints] = []

    def function(points: SurfacePoints) -> Tensor:
        given.append(points)
        return points.uv.float()

    small = square()
    assert small.uvs is not None
    small = small.replace(uvs=0.25 + 0.5 * small.uvs)
    texture = eg.textures.bake(small, function, 16, margin=2)
    points = given[0]
    assert len(points.face) == 64 and torch.equal(points.normal, torch.tensor([0.0, 0, 1]).double().expand(64, 3))
    x, y = centres(16, 16)
    inside, out = (slice(4, 12), slice(4, 12)), (slice(2, 14), slice(2, 14))
    torch.testing.assert_close(texture[inside], torch.stack([x, y], 2)[inside])
    near = torch.stack([x.clamp(0.25 + 1 / 32, 0.75 - 1 / 32), y.clamp(0.25 + 1 / 32, 0.75 - 1 / 32)], 2)
    torch.testing.assert_close(texture[2, 4:12], near[2, 4:12])
    assert not texture[0].any() and (texture[out] > 0).float().mean() > 0.9
    assert (eg.textures.bake(small, function, 16, margin=None) > 0).all()


def test_pictures_give_the_texture_back() -> None:
    """Pictures show a ball from all around; what one does not see comes from others."""
    ball = eg.textures.unwrap(eg.Mesh(icosphere(2).verts.float(), icosphere(2).faces), size=64)
    truth = eg.textures.bake(ball, lambda points: 0.5 + 0.4 * torch.sin(3 * points.position), 64, margin=None)
    eyes = [(3.0, 0, 0), (-3.0, 0, 0), (0, 3.0, 0.1), (0, -3.0, 0.1), (0, 0, 3.0), (0, 0, -3.0)]
    cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 50.0, (96, 96)) for eye in eyes]
    cameras[4] = eg.Camera.orthographic((0, 0, 3.0), (0, 0, 0), (0, 1, 0), 2.4, (96, 96))
    shown = ball.replace(texture=truth)
    images = [eg.render(shown, camera, spp=16, seed=0) for camera in cameras]
    masks = [eg.render_aovs(shown, camera, ["alpha"], seed=0)["alpha"] for camera in cameras]
    found = eg.textures.bake_pictures(ball, images, cameras, 64, masks=masks)
    used = eg.textures.bake(ball, lambda points: torch.ones(len(points.face), 1), 64, margin=0)[..., 0] > 0
    assert (found - truth)[used].abs().mean() < 0.02
    one = eg.textures.bake_pictures(ball, images[:1], cameras[:1], 64)
    position = eg.textures.bake(ball, lambda points: points.position, 64)
    front = used & (position[..., 0] > 0.6)
    assert (one - truth)[front].abs().mean() < 0.02 < (one - truth)[used & ~front].abs().mean()


def test_wrong_arguments() -> None:
    mesh = square()
    plain = eg.Mesh(mesh.verts, mesh.faces)
    camera = eg.Camera.look_at((0.5, 0.5, 3), (0.5, 0.5, 0), (0, 1, 0), 40.0, (8, 8))
    away = eg.Camera.look_at((0.5, 0.5, 3), (0.5, 0.5, 6), (0, 1, 0), 40.0, (8, 8))
    image = torch.ones(8, 8, 3)
    for call, error, words in (
        (lambda: eg.textures.bake(plain, mesh), ValueError, "mesh: expected texture coordinates, .* unwrap"),
        (lambda: eg.textures.bake(mesh, 3), TypeError, "source: expected a Mesh"),
        (lambda: eg.textures.bake(mesh, plain), ValueError, "source: expected colours"),
        (lambda: eg.textures.bake(mesh, plain, what="gloss"), ValueError, "what: expected one of"),
        (lambda: eg.textures.bake(mesh, plain, by="luck"), ValueError, "by: expected"),
        (lambda: eg.textures.bake(mesh, plain, 0), ValueError, "size: expected"),
        (lambda: eg.textures.bake(mesh, lambda points: torch.ones(3), 4), ValueError, "source: expected shape"),
        (lambda: eg.textures.bake(mesh, plain, (4, 4, 3)), ValueError, "size: expected an int or"),
        (lambda: eg.textures.bake(mesh, plain, 4.0), TypeError, "size: expected an int"),
        (
            lambda: eg.textures.bake(mesh, lambda points: points.normal * torch.nan, 4),
            ValueError,
            "source: expected finite",
        ),
        (
            lambda: eg.textures.bake(mesh.replace(uvs=mesh.uvs + 0.5), plain, 4),
            ValueError,
            "unit square, got some from 0.5 to 1.5",
        ),
        (lambda: eg.textures.bake(mesh.replace(uvs=mesh.uvs * 0.1), plain, 1), ValueError, "give a larger size"),
        (lambda: eg.textures.bake_pictures(mesh, [image], camera), TypeError, "cameras: expected a list"),
        (
            lambda: eg.textures.bake_pictures(mesh, [camera], [image]),
            TypeError,
            r"cameras\[0\]: expected a Camera, got Tensor",
        ),
        (
            lambda: eg.textures.bake_pictures(mesh, [image.byte()], [camera]),
            TypeError,
            r"images\[0\]: .* srgb_to_linear",
        ),
        (
            lambda: eg.textures.bake_pictures(mesh, [image * torch.nan], [camera]),
            ValueError,
            r"images\[0\]: expected finite",
        ),
        (lambda: eg.textures.bake_pictures(mesh, ["a.png"], [camera]), TypeError, "use read_image"),
        (lambda: eg.textures.bake_pictures(mesh, [], [camera]), ValueError, "images: expected one for each"),
        (lambda: eg.textures.bake_pictures(mesh, [image[1:]], [camera]), ValueError, r"images\[0\]: expected shape"),
        (
            lambda: eg.textures.bake_pictures(mesh, [image], [camera], masks=[image]),
            ValueError,
            r"masks\[0\]: expected shape",
        ),
        (lambda: eg.textures.bake_pictures(mesh, [image], [away], 4), ValueError, "cameras: expected some that see"),
    ):
        with pytest.raises(error, match=words):
            call()  # pyright: ignore[reportArgumentType]


def test_faces_on_the_same_texels_are_told() -> None:
    """Three squares: the second covers the right half of the first, the third touches both with an edge only."""
    own = square()
    moved = [
        own.uvs * torch.tensor([0.5, 0.5]) + torch.tensor(shift) for shift in ([0.0, 0.0], [0.25, 0.0], [0.0, 0.5])
    ]
    faces = torch.cat([own.faces + 4 * k for k in range(3)])
    verts = torch.cat([own.verts + torch.tensor([2.0 * k, 0, 0]) for k in range(3)])
    mesh = eg.Mesh(verts, faces, uvs=torch.cat(moved), uv_faces=faces)
    with pytest.warns(UserWarning, match=r"mesh: 8 of 40 texels lie on two faces or more") as seen:
        texture = eg.textures.bake(mesh, lambda points: points.face[:, None].double(), 8, margin=0)
    assert [warning.filename for warning in seen] == [__file__]
    assert "(4 faces overlap, the first of them 0)" in str(seen[0].message)
    assert texture[4:, :4].max() <= 1 and texture[:4, :4].min() >= 4  # the first has them
    twice = torch.cat([own.faces, own.faces.flip(1)])  # from both sides
    camera = eg.Camera.look_at((0.5, 0.5, 2), (0.5, 0.5, 0), (0, 1, 0), 40.0, (8, 8))
    with pytest.warns(UserWarning, match=r"mesh: 16 of 16 texels"):
        eg.textures.bake_pictures(
            eg.Mesh(own.verts, twice, uvs=own.uvs, uv_faces=twice), [torch.ones(8, 8, 3)], [camera], 4
        )


@pytest.mark.filterwarnings("error")
def test_charts_side_by_side_do_not_overlap() -> None:
    cage = eg.textures.unwrap(eg.Mesh(icosphere(2).verts.float(), icosphere(2).faces), size=128)
    for size in (16, 128):
        eg.textures.bake(cage, lambda points: points.position, size, margin=0)
