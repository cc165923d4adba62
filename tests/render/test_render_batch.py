"""render_batch(): the bits of one image after another."""

from __future__ import annotations

import pytest
import torch
from scenes import icosphere
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.quick


def camera(k: int, size: tuple[int, int] = (20, 24), **options: object) -> eg.Camera:
    return eg.Camera.look_at((0.3 * k, 0.5, 3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, size, **options)  # pyright: ignore[reportArgumentType]


def leaves() -> tuple[list[Tensor], Tensor]:
    """Vertices of five meshes, and colours that three of them share."""
    verts = [(icosphere(k % 3).verts.float() * (0.8 + 0.1 * k)).requires_grad_() for k in range(5)]
    return verts, torch.linspace(0, 1, 3 * len(verts[0])).reshape(-1, 3).requires_grad_()


def pairs(verts: list[Tensor], shared: Tensor, sizes: bool = False) -> list[tuple[eg.Mesh, eg.Camera]]:
    out = []
    for k, v in enumerate(verts):
        colors = shared if len(v) == len(shared) else v.abs()
        out.append((eg.Mesh(v, icosphere(k % 3).faces, colors=colors), camera(k, (20, 20 + k) if sizes else (20, 24))))
    return out


@pytest.mark.parametrize("threads", [1, 3])
def test_bits_are_those_of_single_images(threads: int) -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(threads)
        found = []
        for together in (True, False):
            verts, shared = leaves()
            given, seeds = pairs(verts, shared), [3, 1, 4, 1, 5]
            if together:
                images = eg.render_batch(given, spp=4, seed=seeds)
            else:
                images = torch.stack(
                    [eg.render(*pair, spp=4, seed=seed) for pair, seed in zip(given, seeds, strict=True)]
                )
            assert isinstance(images, Tensor) and images.shape == (5, 20, 24, 3)
            (images * torch.linspace(-1, 2, images.numel()).view_as(images)).sum().backward()
            found.append([images, shared.grad, *(v.grad for v in verts)])
        assert all(a is not None and torch.equal(a, b) and a.any() for a, b in zip(*found, strict=True))
    finally:
        torch.set_num_threads(before)


def test_a_list_where_sizes_differ_and_images_without_loss() -> None:
    verts, shared = leaves()
    images = eg.render_batch(pairs(verts, shared, sizes=True), spp=2, seed=0)
    assert isinstance(images, list) and [image.shape[1] for image in images] == [20, 21, 22, 23, 24]
    images[1].sum().backward()
    assert [v.grad is not None and bool(v.grad.any()) for v in verts] == [False, True, False, False, False]


def test_lit_scenes_and_lenses_come_one_by_one() -> None:
    mesh = icosphere(1)
    lit = eg.Scene(
        [eg.Mesh(mesh.verts.float(), mesh.faces, material=eg.Material())],
        lights=[eg.lights.PointLight((0, 3, 3), intensity=9.0)],
    )
    distorted = camera(1).replace(distortion=torch.tensor([0.05, 0.0, 0.0, 0.0]))
    given = [(lit, camera(0)), (eg.Mesh(mesh.verts.float(), mesh.faces, colors=mesh.verts.float().abs()), distorted)]
    images = eg.render_batch(given, spp=4, seed=0)
    assert isinstance(images, Tensor)
    for image, pair in zip(images, given, strict=True):
        assert torch.equal(image, eg.render(*pair, spp=4, seed=0))


def test_errors_of_lit_scenes_name_the_pair() -> None:
    mesh = icosphere(0)
    lit = eg.Scene(
        [mesh.replace(material=eg.Material())], lights=[eg.lights.DirectionalLight(torch.tensor([0.0, 0, -1]))]
    )
    camera = eg.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40.0, (4, 4))
    with pytest.raises(ValueError, match=r"pairs\[0\]: bounces: expected"):
        eg.render_batch([(lit, camera)], bounces=0, seed=0)
    with pytest.raises(TypeError, match=r"pairs\[1\]: camera: expected"):
        eg.render_batch([(lit, camera), (lit, 3)], seed=0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="pairs: expected at least one"):
        eg.render_batch([], seed=0)


def test_warnings_point_at_the_caller_and_errors_at_the_pair() -> None:
    verts, shared = leaves()
    given = pairs(verts, shared)
    away = eg.Camera.look_at((0.0, 0.5, 3.0), (0.0, 0.0, 9.0), (0.0, 1.0, 0.0), 40.0, (20, 24))
    with pytest.warns(UserWarning, match="behind") as seen:
        eg.render_batch([given[0], (given[1][0], away)], spp=2, seed=0)
    assert [warning.filename for warning in seen] == [__file__]
    with pytest.raises(ValueError, match=r"pairs\[0\]: filter: expected"):
        eg.render_batch(given, filter="none", seed=0)
    with pytest.raises(ValueError, match=r"pairs\[3\]: seed: expected"):
        eg.render_batch(given, seed=[0, 1, 2, -1, 4])  # while others are rendered already


def test_second_derivatives_and_wrong_arguments() -> None:
    verts, shared = leaves()
    given = pairs(verts, shared)
    images = eg.render_batch(given, spp=2, seed=0)
    assert isinstance(images, Tensor)
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(images.square().sum(), verts[0], create_graph=True)
    batch = eg.Camera.stack([camera(0), camera(1)])
    for wrong, options, error, words in (
        (given[0][0], {}, TypeError, "pairs: expected a list"),
        ([given[0][0]], {}, TypeError, r"pairs\[0\]: expected \(scene, camera\)"),
        ([given[0], (given[1][0], batch)], {}, ValueError, r"pairs\[1\]: camera: expected one camera"),
        ([given[0], (given[1][0], None)], {}, TypeError, r"pairs\[1\]: camera: expected a Camera"),
        (given, {"seed": [1, 2]}, ValueError, "seed: expected one, or 5"),
        (given, {"sp": 3}, TypeError, "render_batch: expected only the options"),
    ):
        with pytest.raises(error, match=words):
            eg.render_batch(wrong, **{"seed": 0, **options})  # pyright: ignore[reportArgumentType]
