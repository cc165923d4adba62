"""Tangents of normal maps: those of Blender's MikkTSpace, their derivatives, and mirrored images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from lit_scenes import F64, vector
from oracles.shading import radiance
from scenes import icosphere
from torch import Tensor
from torch.autograd import gradcheck
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.points.surfaces import Surfaces
from edgegrad.scene.appearance import jumps
from edgegrad.scene.mikktspace import Fans

# A sphere of 80 faces, and what Blender 4.4 gives for it by Mesh.calc_tangents(): in "mirrored" the images of some faces are,
# in "creased" there are flat faces and a seam, in "collapsed" the images of some faces are lines.
BLENDER = np.load(Path(__file__).parent / "mikktspace.npz")
NOTHING = (1.0, 0.0, 0.0, -1.0)  # what MikkTSpace gives where there is no tangent


def fans_of(*corners: np.ndarray) -> Fans:
    index = np.arange(3 * len(corners[0])).reshape(-1, 3)
    return Fans.from_corners(*((part.reshape(3 * len(part), -1), index) for part in corners))


@pytest.mark.parametrize("name", ["mirrored", "creased", "collapsed"])
def test_tangents_are_those_of_mikktspace(name: str) -> None:
    position, normal, uv = BLENDER["position"], BLENDER[f"normal_{name}"], BLENDER[f"uv_{name}"]
    expected = torch.from_numpy(BLENDER[f"tangent_{name}"]).double()
    fans = fans_of(position, normal, uv)
    assert len(np.unique(position.reshape(-1, 3), axis=0)) < int(fans.of_corner.max()) + 1 < position.size // 3
    found = fans.tangents(*map(torch.from_numpy, (position, normal, uv)))
    none = (found[..., :3] == 0).all(-1)
    assert int(none.sum()) < 10 and (expected[none] == torch.tensor(NOTHING)).all()
    torch.testing.assert_close(found[~none], expected[~none], rtol=0, atol=5e-4)  # of float32: angles of thin images


def test_rows_that_no_corner_has_change_nothing() -> None:
    verts, faces, normals = (part.numpy() for part in bowl(5))
    uvs, more = np.abs(verts[:, :2]), np.ones((1, 3))
    own = [fans.of_corner for fans in (
        Fans.from_corners((verts, faces), (normals, faces), (uvs, faces)),
        Fans.from_corners((verts, faces), (np.concatenate([normals, more]), faces), (uvs, faces)),
        Fans.from_corners((verts, faces), (np.concatenate([more, normals]), faces + 1), (uvs, faces)),
        fans_of(verts[faces], normals[faces], uvs[faces]),
    )]  # fmt: skip
    assert len(verts) < int(own[0].max()) + 1 < 3 * len(faces)
    for other in own[1:]:
        pairs = torch.stack([own[0], other], -1).reshape(-1, 2).unique(dim=0)
        assert len(pairs) == int(own[0].max()) + 1 == int(other.max()) + 1


def test_derivatives_of_tangents() -> None:
    position, normal, uv = (
        torch.from_numpy(part[:12]).double().requires_grad_()
        for part in (BLENDER["position"], BLENDER["normal_mirrored"], BLENDER["uv_mirrored"])
    )
    fans = fans_of(*(part.detach().numpy() for part in (position, normal, uv)))
    assert gradcheck(fans.tangents, (position, normal, uv))


def test_nothing_without_a_direction() -> None:
    """Faces, edges, images and normals without a size give zeros, and finite derivatives."""
    position, normal, uv = (
        torch.rand(3, 3, 3, dtype=F64),
        torch.rand(3, 3, 3, dtype=F64),
        torch.rand(3, 3, 2, dtype=F64),
    )
    position[0, 1], normal[1], uv[2] = position[0, 0], 0.0, 0.5
    leaves = [part.clone().requires_grad_() for part in (position, normal, uv)]
    found = fans_of(position.numpy(), normal.numpy(), uv.numpy()).tangents(*leaves)
    assert (found[2, :, :3] == 0).all()
    for gradient in torch.autograd.grad(found.square().sum() + found.sum(), leaves):
        assert torch.isfinite(gradient).all()


def bowl(rows: int = 33) -> tuple[Tensor, Tensor, Tensor]:
    """z = −x²/2 over |x|, |y| ≤ 1, its faces and its normals."""
    t = torch.linspace(-1, 1, rows, dtype=F64)
    x, y = (part.reshape(-1) for part in torch.meshgrid(t, t, indexing="xy"))
    i = (torch.arange(rows - 1)[:, None] * rows + torch.arange(rows - 1)).reshape(-1, 1)
    faces = torch.cat([i + torch.tensor([0, 1, rows + 1]), i + torch.tensor([0, rows + 1, rows])])
    return torch.stack([x, y, -(x**2) / 2], 1), faces, normalize(torch.stack([x, 0 * x, 1 + 0 * x], 1), dim=1)


def test_a_mirrored_image() -> None:
    """Texture coordinates that run from the middle to both sides: what a map says bends to both sides, up to the middle."""
    verts, faces, normals = bowl()
    tilted = normalize(vector(0.3, 0.2, 1), dim=0)
    image = eg.Texture(((tilted + 1) / 2).expand(2, 2, 3))
    uvs = torch.stack([verts[:, 0].abs(), verts[:, 1]], 1)
    mesh = eg.Mesh(verts, faces, uvs=uvs, uv_faces=faces, normals=normals, material=eg.Material(1.0, normal_map=image))
    towards = normalize(vector(0.3, 0.1, 1.0), dim=0)
    scene = eg.Scene([mesh], lights=[eg.lights.DirectionalLight(-towards)])
    x = torch.tensor([-0.7, -0.31, -0.01, 0.01, 0.31, 0.7], dtype=F64)
    hits = eg.points.trace(scene, torch.stack([x, 0.12 + 0 * x, 2 + 0 * x], 1), vector(0, 0, -1))
    n, side = normalize(torch.stack([x, 0 * x, 1 + 0 * x], 1), dim=1), x.sign()[:, None]
    along = side * torch.stack([n[:, 2], 0 * x, -n[:, 0]], 1)
    expected = (tilted[0] * along + tilted[1] * vector(0, 1, 0) + tilted[2] * n) @ towards / torch.pi
    torch.testing.assert_close(radiance(hits)[:, 0], expected, rtol=1e-3, atol=0)


def test_smooth_normal_maps_have_no_creases() -> None:
    """Tangents that faces share are no jumps; where the image is mirrored they are."""
    verts, faces, normals = bowl(5)
    flat = eg.Texture(torch.tensor([0.5, 0.5, 1.0], dtype=F64).expand(2, 2, 3))

    def extra(uvs: Tensor) -> int:
        material = eg.Material(1.0, normal_map=flat)
        mesh = eg.Mesh(verts, faces, uvs=uvs, uv_faces=faces, normals=normals, material=material)
        corners = jumps(mesh, Surfaces(eg.Scene([mesh])).tangents(0))
        at = torch.stack([faces[..., None].expand_as(corners), torch.arange(corners.shape[-1]).expand_as(corners)], -1)
        rows = torch.cat([at.double(), corners[..., None].round(decimals=9)], -1).reshape(-1, 3)
        return len(rows.unique(dim=0)) - len(verts) * corners.shape[-1]

    assert extra(verts[:, :2]) == 0
    # On the five vertices of the middle: along x and its opposite, and the handedness.
    assert extra(torch.stack([verts[:, 0].abs(), verts[:, 1]], 1)) > 0


def test_gradients_under_transforms() -> None:
    ball = icosphere(1)
    map_ = torch.tensor([0.5, 0.5, 1.0], dtype=F64) + 0.2 * torch.rand((4, 4, 3), dtype=F64) - 0.1
    camera = eg.Camera.look_at((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(8, 8)).to(F64)

    def loss(verts: Tensor) -> Tensor:
        mesh = eg.Mesh(
            verts, ball.faces, uvs=verts[:, :2], uv_faces=ball.faces, normals=eg.Mesh(verts, ball.faces).vertex_normals(),
            material=eg.Material(normal_map=eg.Texture(map_)),
        )  # fmt: skip
        return (
            eg.render(eg.Scene([mesh], lights=[eg.lights.PointLight(vector(1, 2, 3), 20.0)]), camera, 1, seed=0)
            .square()
            .sum()
        )

    leaf = ball.verts.clone().requires_grad_()
    expected = torch.autograd.grad(loss(leaf), leaf)[0]
    assert torch.equal(torch.func.grad(loss)(ball.verts), expected) and expected.any()
    assert torch.equal(torch.vmap(torch.func.grad(loss))(ball.verts[None])[0], expected)
