"""Gradients along lines where faces pass through each other, against exact images of the faces cut apart
(tests/oracles/cut_apart.py) and against finite differences."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from crossing_faces import F64, found, generator, joined, random_triangles, tangle
from finite_differences import check_ratio, rotation
from oracles.cut_apart import cut_apart
from oracles.exact import exact_image
from scenes import cube, front_camera, icosphere, smooth_adjoint, smooth_colors
from threads import check_threads
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core

BACKGROUND = torch.tensor([0.15, 0.25, 0.4], dtype=F64)
ALONG = torch.tensor([0.7, 0.6, -0.2], dtype=F64)
PROJECTIONS = ("perspective", "orthographic")


# -- gradients against exact images -----------------------------------------------------------------------------------


def roof() -> tuple[Tensor, Tensor]:
    """A triangle through the edge between two faces."""
    verts = torch.tensor(
        [
            [-0.6, 0.1, 0.2], [0.7, -0.1, 0.3], [0.1, 0.7, -0.5], [-0.1, -0.8, -0.4],
            [0.5, 0.5, 0.9], [-0.4, 0.0, -0.8], [0.45, -0.45, 0.3],
        ],
        dtype=F64,
    )  # fmt: skip
    return verts, torch.tensor([[0, 1, 2], [1, 0, 3], [4, 5, 6]])


def at_a_vertex() -> tuple[Tensor, Tensor]:
    """Two faces that share a vertex and meet along a segment from it."""
    verts = torch.tensor(
        [[-0.7, 0.1, 0.2], [0.7, 0.6, 0.3], [0.6, -0.6, 0.1], [0.4, 0.2, 0.9], [0.5, -0.15, -0.8]], dtype=F64
    )
    return verts, torch.tensor([[0, 1, 2], [0, 3, 4]])


SCENES = {
    "two": random_triangles(2, 14, 1.5),
    "three, through one point": random_triangles(3, 15, 2.0),
    "eight": random_triangles(8, 13, 1.5),
    "through an edge": roof(),
    "at a vertex": at_a_vertex(),
}


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("name", SCENES)
def test_gradient_against_the_exact_one(name, projection):
    """Compare the gradients of all vertices and of the camera, each relative to its own size. The intersections matter."""
    verts, faces = SCENES[name]
    verts = verts - (verts.mean(0) if name in ("two", "three, through one point", "eight") else 0)
    camera, adjoint = front_camera(32, projection), smooth_adjoint(32, 32, 3).to(F64)
    colors = torch.rand((len(verts), 3), generator=generator(4), dtype=F64)
    assert len(found(verts, faces)[0]) >= {"three, through one point": 3, "eight": 8, "through an edge": 2}.get(name, 1)

    def gradient(image) -> list[Tensor]:
        leaves = [t.clone().requires_grad_() for t in (verts, camera.world_to_camera, camera.K)]
        scene = eg.Scene([eg.Mesh(leaves[0], faces, colors=colors)], BACKGROUND)
        loss = (image(scene, camera.replace(world_to_camera=leaves[1], K=leaves[2])) * adjoint).sum()
        grads = torch.autograd.grad(loss, leaves)
        return [grads[0], grads[1][:3], grads[2][:2]]

    true = gradient(lambda scene, camera: exact_image(cut_apart(scene), camera))
    options: dict[str, Any] = {"sampling": eg.Sampling(surface=50_000, edges=50_000)}
    estimates = [gradient(lambda s, c, k=k: eg.render(s, c, seed=k, **options)) for k in range(4)]
    for k, exact in enumerate(true):
        mean = torch.stack([e[k] for e in estimates]).mean(0)
        assert float((mean - exact).norm()) < 0.004 * float(exact.norm())


# -- gradients against finite differences -----------------------------------------------------------------------------

SAMPLES: dict[str, Any] = {"sampling": eg.Sampling(surface=20_000, edges=20_000)}


def two_boxes() -> tuple[eg.Mesh, eg.Mesh]:
    """Return two boxes of different colours that pass through each other."""
    box = cube(0.45).transformed(rotation((0.6, 0.0, 0.8), torch.tensor(0.4, dtype=F64)))
    other = box.transformed(
        rotation((0.0, 1.0, 0.0), torch.tensor(0.9, dtype=F64)), torch.tensor([0.35, 0.2, 0.15], dtype=F64)
    )
    assert other.colors is not None
    return box, other.replace(colors=1 - other.colors)


def test_boxes_through_each_other():
    """0.20 in another renderer: it had no edge there. Two meshes of float32, of which one moves."""
    box, other = two_boxes()

    def one_moves(theta: Tensor):
        moved = box.transformed(t=theta * ALONG)
        return eg.Scene([moved.to(torch.float32), other.to(torch.float32)], BACKGROUND), camera

    camera = front_camera(48)
    check_ratio(one_moves, 0.006, spp=2048, **SAMPLES)


@pytest.mark.parametrize("mesh", [pytest.param("itself", marks=pytest.mark.slow), "another"])
def test_a_sphere_sunk_to_edges_that_lie_in_a_sheet(mesh):
    """A third of an icosphere's equator are edges. Which of their two faces passes through the sheet depends on the direction
    of the motion, so the gradient is the mean."""
    ball = icosphere(2).transformed(scale=0.7)
    corners = torch.tensor([[-1.2, -1.1, 0.0], [1.2, -1.0, 0.0], [1.1, 1.2, 0.0], [-1.1, 1.0, 0.0]], dtype=F64)
    colors = torch.tensor([[0.9, 0.1, 0.1], [0.8, 0.3, 0.1], [0.7, 0.1, 0.2], [0.9, 0.3, 0.3]], dtype=F64)
    sheet = eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), colors=colors)
    camera = eg.Camera.look_at((1.4, 1.9, 2.6), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (64, 64)).to(F64)
    assert ball.colors is not None
    both = eg.Mesh(*joined(ball, sheet), colors=torch.cat([ball.colors, colors]))

    def shifted(theta: Tensor):
        if mesh == "itself":
            return eg.Scene([both.transformed(t=theta * ALONG)], BACKGROUND), camera
        return eg.Scene([ball.transformed(t=theta * ALONG), sheet.transformed(t=theta * ALONG)], BACKGROUND), camera

    check_ratio(shifted, 0.006, spp=384, **SAMPLES)

    def sunk(theta: Tensor):
        t = theta * torch.tensor([0.0, 0.0, 1.0], dtype=F64)
        return eg.Scene([ball.transformed(t=t), sheet], BACKGROUND), camera

    check_ratio(sunk, 0.003, spp=768, **SAMPLES)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_a_face_seen_edge_on_contributes_nothing(projection):
    """A blade through a sheet whose plane holds the eye: it has no image, and its line no gradient that is not finite."""
    verts = torch.tensor(
        [[-1.0, -1, 0], [1, -1, 0], [0, 1.3, 0], [0, -0.4, -0.5], [0, -0.3, 0.5], [0, 0.5, 0.1]], dtype=F64
    )
    faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    world_to_camera = torch.eye(4, dtype=F64)
    world_to_camera[2, 3] = 3.0
    K = torch.tensor([[40.0, 0, 16], [0, 40, 16], [0, 0, 1]], dtype=F64)
    K[:2, :2] /= 1 if projection == "perspective" else 3
    camera = eg.Camera(world_to_camera, K, (32, 32), projection)

    def gradient(verts: Tensor, faces: Tensor) -> Tensor:
        verts = verts.clone().requires_grad_()
        mesh = eg.Mesh(verts, faces, colors=torch.arange(3.0 * len(verts), dtype=F64).reshape(-1, 3) / 10)
        image = eg.render(mesh, camera, seed=1)
        return torch.autograd.grad(image, verts, smooth_adjoint(32, 32, 3))[0]

    assert [pair[:2] for pair in found(verts, faces)[0]] == [(0, 1)]
    with_blade, alone = gradient(verts, faces), gradient(verts[:3], faces[:1])
    assert bool(with_blade.isfinite().all())
    assert float((with_blade[:3] - alone).norm()) < 0.02 * float(alone.norm())


def test_copies_share_the_line():
    """A box listed twice by index, or three times by place, through another: the line between them is there once."""
    box, other = two_boxes()
    twice = box.replace(faces=torch.cat([box.faces, box.faces[:, [1, 2, 0]]]))
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)

    def slope(*meshes: eg.Mesh) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        scene = eg.Scene([*(mesh.transformed(t=theta * ALONG) for mesh in meshes), other], BACKGROUND)
        return torch.autograd.grad((eg.render(scene, camera, **{"seed": 0, **SAMPLES}) * adjoint).sum(), theta)[0]

    once = slope(box)
    for meshes in ([twice], [box, box, box]):
        torch.testing.assert_close(slope(*meshes), once, rtol=0.02, atol=0.0)


# -- what it costs ----------------------------------------------------------------------------------------------------


def crossing() -> eg.Scene:
    verts, faces = tangle()
    return eg.Scene([eg.Mesh(verts, faces, colors=smooth_colors(verts))], BACKGROUND)


def test_same_bits_at_any_number_of_threads():
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)
    (mesh,) = crossing().meshes

    def compute() -> tuple[Tensor, ...]:
        core.clear_geometry()
        verts = mesh.verts.clone().requires_grad_()
        return torch.autograd.grad(eg.render(mesh.replace(verts=verts), camera, spp=4, seed=0), verts, adjoint)

    check_threads(compute)


def test_where_the_vertices_were_before_changes_no_bit():
    """The order in which pairs are found is kept while the vertices move."""
    camera, adjoint = front_camera(48), smooth_adjoint(48, 48, 3).to(F64)
    (mesh,) = crossing().meshes

    def gradient(scale: float = 1.0) -> Tensor:
        verts = (scale * mesh.verts).requires_grad_()
        return torch.autograd.grad(eg.render(mesh.replace(verts=verts), camera, spp=4, seed=0), verts, adjoint)[0]

    core.clear_geometry()
    first = gradient()
    for scale in (1.1, 0.9):
        gradient(scale)
    assert torch.equal(gradient(), first)


def test_whether_they_are_drawn_does_not_depend_on_where_the_vertices_were():
    """Nor do the drawn pairs depend on it, for so many that some estimates say one thing and some the other."""
    camera, adjoint, ball = front_camera(48), smooth_adjoint(48, 48, 3).to(F64), icosphere(4)
    noise = torch.randn(ball.verts.shape, generator=generator(4), dtype=F64)

    def gradient(size: float) -> Tensor:
        verts = (ball.verts + size * noise).requires_grad_()
        return torch.autograd.grad(eg.render(ball.replace(verts=verts), camera, spp=4, seed=0), verts, adjoint)[0]

    for size in torch.linspace(0.05, 0.062, 7).tolist():
        core.clear_geometry()
        first = gradient(size)
        for before in (0.3, 0.6):
            core.clear_geometry()
            gradient(before * size)
            assert torch.equal(gradient(size), first)


def test_gradient_where_they_are_drawn():
    """Fewer are drawn of faces that the image did not hit, and stand for others."""
    ball, camera = icosphere(4), front_camera(48)
    noise = torch.randn(ball.verts.shape, generator=generator(), dtype=F64)
    assert found(ball.verts + 0.08 * noise, ball.faces)[2]

    def tangled(theta: Tensor):
        return eg.Scene([ball.replace(verts=ball.verts + (0.08 + theta) * noise)], BACKGROUND), camera

    check_ratio(tangled, 0.0005, spp=512, seeds=8)


def test_plan_counts_them():
    camera = front_camera(48)
    apart = [cube(0.3).transformed(t=x * torch.tensor([1.0, 0.0, 0.0], dtype=F64)) for x in (-0.5, 0.5)]
    together = [cube(0.3), cube(0.4).transformed(t=torch.tensor([0.2, 0.3, 0.1], dtype=F64))]
    for meshes, on in ((apart, False), (together, True)):
        moving = [mesh.replace(verts=mesh.verts.clone().requires_grad_()) for mesh in meshes]
        plan = eg.plan(eg.Scene(moving), camera)
        assert plan["intersections"].on == on and (plan["intersections"].bytes > 0) == on
        assert (eg.profile(eg.Scene(moving), camera, repeats=1).samples["intersections"] > 0) == on
    assert not eg.plan(eg.Scene(together), camera)["intersections"].on
