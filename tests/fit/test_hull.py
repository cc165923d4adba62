"""Visual hulls, remeshing and texture coordinates, from which fits of shapes and textures start."""

import math

import pytest
import torch
from quiet_fits import arranged
from small_scenes import QUIET, ball

import edgegrad as eg
from edgegrad.fit import fit_texture, regularizers

gpytoolbox = pytest.importorskip("gpytoolbox")


def torus(shift=(0.4, -0.2, 0.3)):
    trimesh = pytest.importorskip("trimesh")
    ring = trimesh.creation.torus(major_radius=1.0, minor_radius=0.3)
    return eg.Mesh(torch.tensor(ring.vertices).float() + torch.tensor(shift), torch.tensor(ring.faces))


def around(mesh, count, size=64, distance=6.0, **options):
    """Return cameras on a spiral."""
    middle = mesh.verts.mean(0)
    found = []
    for k in range(count):
        y = 1.0 - (2 * k + 1) / count
        turn, r = k * math.pi * (3.0 - math.sqrt(5.0)), math.sqrt(1.0 - y * y)
        away = torch.tensor([r * math.cos(turn), r * math.sin(turn), y])
        found.append(eg.Camera.look_at(middle + distance * away, middle, (0.1, 0.9, 0.2), size=(size, size), **options))
    return found


def silhouettes(mesh, cameras):
    return [eg.render_aovs(mesh, camera, ["alpha"], spp=16, seed=0)["alpha"] for camera in cameras]


def volume(mesh):
    a, b, c = mesh.verts.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6.0


def holes(mesh):
    """Count holes by Euler's formula for a closed surface in one piece."""
    return 1 - (len(mesh.verts) - len(regularizers.edges(mesh.faces)) + len(mesh.faces)) // 2


def test_the_hull_of_a_ring_has_its_hole():
    ring = torus()
    cameras = around(ring, 16)
    hull = eg.shapes.visual_hull(silhouettes(ring, cameras), cameras, 48)
    assert holes(hull) == 1 and len(gpytoolbox.boundary_edges(hull.faces.numpy())) == 0
    assert 0.97 < volume(hull) / volume(ring) < 1.2  # outwards; a hull holds the body, but for its cells
    for a, b in zip(hull.verts.aminmax(dim=0), ring.verts.aminmax(dim=0), strict=True):
        torch.testing.assert_close(a, b, rtol=0, atol=0.08)
    for alpha, mask in zip(silhouettes(hull, cameras), silhouettes(ring, cameras), strict=True):
        assert float(torch.minimum(alpha, mask).sum() / torch.maximum(alpha, mask).sum()) > 0.95
    even = eg.shapes.visual_hull(silhouettes(ring, cameras), cameras, 48, faces=1200)
    assert 800 < len(even.faces) < 1600 and holes(even) == 1
    assert float(regularizers.edge_length(even.verts, even.faces)) < 0.1


def test_orthographic_cameras():
    egg = ball(3).replace(verts=ball(3).verts * torch.tensor([0.5, 1.0, 0.7]))
    eyes = [(4.0, 0.0, 0.0), (0.0, 4.0, 0.1), (0.0, 0.0, 4.0), (3.0, 3.0, 0.0), (0.0, 3.0, 3.0), (3.0, 0.0, 3.0)]
    cameras = [eg.Camera.orthographic(eye, (0, 0, 0), (0.3, 0.5, 0.8), height=3.0, size=(64, 80)) for eye in eyes]
    masks = silhouettes(egg, cameras)
    hull = eg.shapes.visual_hull(masks, cameras, 40)
    assert 0.97 < volume(hull) / volume(egg) < 1.25
    torch.testing.assert_close(hull.verts.amax(0), egg.verts.amax(0), rtol=0, atol=0.06)


def test_an_object_that_goes_on_beyond_an_image():
    """Beyond a side that the mask touches nothing is cut away; beyond the others there is nothing."""
    egg = ball(3)
    cameras = around(egg, 12)
    near = [
        camera.crop(0, 0, 64, 37) if k % 3 == 0 else camera for k, camera in enumerate(cameras)
    ]  # the middle is at 32
    masks = silhouettes(egg, near)
    assert all(bool((mask[:, -1] > 0.5).any()) for mask in masks[::3])
    hull = eg.shapes.visual_hull(masks, near, 40)
    assert 0.97 < volume(hull) / volume(egg) < 1.2


def test_small_pieces_are_left_out():
    egg = ball(3)
    cameras = around(egg, 8)
    masks = silhouettes(egg, cameras)
    dot = torch.tensor([0.0, 1.6, 0.0]) + 0.05 * ball(1).verts
    both = eg.Scene([egg, eg.Mesh(dot, ball(1).faces)])
    specks = [eg.render_aovs(both, camera, ["alpha"], spp=16, seed=0)["alpha"] for camera in cameras]
    assert sum(float((a - b).abs().sum()) for a, b in zip(masks, specks, strict=True)) > 2.0
    assert holes(eg.shapes.visual_hull(specks, cameras, 40)) == 0  # one piece


def test_hull_errors_name_the_argument():
    egg = ball(2)
    cameras = around(egg, 4, 32)
    masks = silhouettes(egg, cameras)
    corner = torch.zeros(32, 32, 1)
    corner[1:4, 1:4] = 1.0
    side = [eg.Camera.orthographic((x, 0, 4.0), (x, 0, 0), height=3.0, size=(32, 32)) for x in (0.0, 0.3)]
    for call, error, message in (
        (lambda: eg.shapes.visual_hull(masks[0], cameras[0]), ValueError, "cameras: expected at least two, got 1"),
        (lambda: eg.shapes.visual_hull(masks[:2], cameras), ValueError, "masks: expected 4, one for each camera, got 2"),
        (lambda: eg.shapes.visual_hull([None, *masks[1:]], cameras), ValueError, "expected pictures or masks"),
        (lambda: eg.shapes.visual_hull(masks, cameras, resolution=2), ValueError, "resolution: expected an int from 4"),
        (lambda: eg.shapes.visual_hull(masks, cameras, faces=0), ValueError, "faces: expected"),
        (lambda: eg.shapes.visual_hull(silhouettes(egg, side), side), ValueError, "cameras: expected some that look in"),
        (lambda: eg.shapes.visual_hull([corner, corner.flip(0, 1), *masks[2:]], cameras), ValueError,
         "masks: expected silhouettes of one object, got some that have no body in common"),
    ):  # fmt: skip
        with pytest.raises(error, match=message):
            call()


def test_area_regularizer_shrinks_a_sphere():
    """The area is that of a unit sphere in squared diagonals of its box."""
    sphere = ball(4)
    assert float(regularizers.area(sphere.verts, sphere.faces)) == pytest.approx(4 * math.pi / 12, rel=0.01)
    verts = sphere.verts.clone().requires_grad_()
    regularizers.area(verts, sphere.faces).backward()
    assert float((verts.grad * verts.detach()).sum()) == pytest.approx(2 * 4 * math.pi / 12, rel=0.01)  # dA/ds of A s²


# -- texture coordinates ----------------------------------------------------------------------------------------------


def test_unwrapped_faces_lie_apart_and_keep_their_shape():
    pytest.importorskip("xatlas")
    ring = torus()
    found = eg.textures.unwrap(ring, 256)
    assert torch.equal(found.faces, ring.faces) and torch.equal(found.verts, ring.verts)
    assert float(found.uvs.min()) >= 0.0 and float(found.uvs.max()) <= 1.0

    def lengths(points, faces):
        corner = points[faces]
        return (corner - corner.roll(1, 1)).norm(dim=-1)

    ratio = lengths(found.uvs, found.uv_faces) / lengths(found.verts, found.faces)
    assert float(ratio.std() / ratio.mean()) < 0.25  # each face lies as its own corners say
    flat = torch.cat([found.uvs, torch.zeros(len(found.uvs), 1)], 1)
    seen = eg.render_aovs(
        eg.Mesh(flat, found.uv_faces),
        eg.Camera.orthographic((0.5, 0.5, 1.0), (0.5, 0.5, 0.0), (0.0, 1.0, 0.0), height=1.0, size=(64, 64)),
        ["alpha"], spp=16, seed=0
    )["alpha"]  # fmt: skip
    a, b, c = flat[found.uv_faces].unbind(1)
    area = 0.5 * float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum())
    assert float(seen.mean()) == pytest.approx(area, rel=0.02)  # none on another


def test_a_texture_on_an_unwrapped_mesh():
    pytest.importorskip("xatlas")
    egg = ball(2)
    colors = 0.5 + 0.4 * torch.sin(3.0 * egg.verts)
    cameras = around(egg, 6, 32)
    pictures = [eg.render(egg.replace(colors=colors), camera, spp=32, seed=0) for camera in cameras]
    fit = fit_texture(eg.textures.unwrap(egg, 64), pictures, cameras, 64, **arranged(steps=40, **QUIET))
    view = eg.Camera.look_at((2.0, 2.5, 5.0), (0.0, 0.0, 0.0), size=(32, 32))
    apart = eg.render(fit.mesh, view, spp=32, seed=0) - eg.render(egg.replace(colors=colors), view, spp=32, seed=0)
    assert -10.0 * math.log10(float(apart.square().mean())) > 28.0


def test_unwrapping_errors_name_the_argument():
    pytest.importorskip("xatlas")
    with pytest.raises(TypeError, match="mesh: expected a Mesh, got int"):
        eg.textures.unwrap(3)
    with pytest.raises(ValueError, match="size: expected an int from 16"):
        eg.textures.unwrap(ball(1), 2)
    with pytest.raises(ValueError, match="mesh: expected faces with an area"):
        eg.textures.unwrap(ball(1).replace(verts=torch.zeros_like(ball(1).verts)))


@pytest.mark.parametrize("scale", [2.0**-66, 2.0**66])
def test_units_do_not_matter_to_unwrapping(scale: float) -> None:
    mesh = ball(1)
    same, other = eg.textures.unwrap(mesh, 64), eg.textures.unwrap(mesh.replace(verts=mesh.verts * scale), 64)
    assert same.uvs is not None and other.uvs is not None and same.uvs.shape == other.uvs.shape
    assert torch.equal(same.uvs, other.uvs)
