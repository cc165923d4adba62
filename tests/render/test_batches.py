"""Batches of cameras."""

from __future__ import annotations

import pytest
import torch
from torch_scenes import (
    ADJOINT,
    BACKGROUND,
    CAMERA,
    MESH,
    OTHER,
    SIZE,
    TRIANGLE,
    gradients,
    image_and_gradients,
    leaf,
    same_bits,
    with_leaves,
)

import edgegrad as eg

pytestmark = pytest.mark.quick


def test_batch_of_one_is_that_camera():
    single = image_and_gradients(TRIANGLE, CAMERA)
    batch = image_and_gradients(TRIANGLE, eg.Camera.stack([CAMERA]))
    assert batch[0].shape == (1, SIZE, SIZE, 3)
    assert same_bits([x.reshape(y.shape) for x, y in zip(batch, single, strict=True)], single)


def test_batch_first_camera_is_that_camera():
    """The samples of the first camera are those it has alone, and a camera that the loss ignores gives nothing."""
    single = image_and_gradients(TRIANGLE, CAMERA)
    scene, camera, leaves = with_leaves(TRIANGLE, eg.Camera.stack([CAMERA, OTHER]))
    images = eg.render(scene, camera, 4, seed=0)
    *of_scene, pose, K = gradients(images, leaves, torch.stack([ADJOINT, torch.zeros_like(ADJOINT)]))
    assert same_bits([images[0], *of_scene, pose[0], K[0]], single)
    assert not pose[1].any() and not K[1].any()


def test_batch_other_cameras():
    """They have samples of their own, so they differ from what the camera gives alone as two seeds differ."""
    options = {"spp": 64, "sampling": eg.Sampling(surface=5000, edges=5000)}
    single, again = (image_and_gradients(TRIANGLE, OTHER, seed=seed, **options) for seed in (0, 1))
    scene, camera, leaves = with_leaves(TRIANGLE, eg.Camera.stack([CAMERA, OTHER]))
    images = eg.render(scene, camera, **{"seed": 0, **options})
    *of_scene, pose, K = gradients(images, leaves, torch.stack([torch.zeros_like(ADJOINT), ADJOINT]))
    for found, one, other in zip([images[1], *of_scene, pose[1], K[1]], single, again, strict=True):
        # Measured: 0.3 to 1.5 times that, which is at most 0.7 % of the whole.
        assert not torch.equal(found, one)
        assert (found - one).norm() < 4 * (other - one).norm() < 0.04 * one.norm()


@pytest.mark.parametrize("shared", ["K", "world_to_camera"])
def test_batch_gradients_sum(shared):
    """Over the cameras, for the scene and for what the cameras share."""
    batched = eg.Camera.stack([CAMERA, OTHER])
    one = {"K": CAMERA.K, "world_to_camera": CAMERA.world_to_camera}[shared]
    leaves = [leaf(MESH.verts), leaf(one)]
    scene, camera = eg.Scene(MESH.replace(verts=leaves[0]), BACKGROUND), batched.replace(**{shared: leaves[1]})
    images = eg.render(scene, camera, 4, seed=0)
    assert images.shape == (2, SIZE, SIZE, 3)
    adjoint = torch.stack([ADJOINT, ADJOINT.flip(0)])
    found = torch.autograd.grad(images, leaves, adjoint, retain_graph=True)
    parts = []
    for b in range(2):
        only = torch.zeros_like(adjoint)
        only[b] = adjoint[b]
        parts.append(torch.autograd.grad(images, leaves, only, retain_graph=True))
        assert all(part.any() for part in parts[-1])
    torch.testing.assert_close(found, tuple(a + b for a, b in zip(*parts, strict=True)), rtol=1e-12, atol=1e-12)
