"""Layouts, dtypes, channels and devices of tensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scenes import smooth_adjoint, smooth_colors
from torch import Tensor
from torch_scenes import (
    ADJOINT,
    BACKGROUND,
    CAMERA,
    F32,
    F64,
    MESH,
    SIZE,
    TRIANGLE,
    gradients,
    image_and_gradients,
    leaf,
    mixed_scene,
    same_bits,
    with_leaves,
)

import edgegrad as eg


def strided(tensor: Tensor) -> Tensor:
    """Return the same values, one in three of a larger tensor."""
    larger = torch.zeros((*tensor.shape, 3), dtype=tensor.dtype)
    larger[..., 1] = tensor
    return larger[..., 1]


def transposed(tensor: Tensor) -> Tensor:
    """Return the same values, stored along the other axis."""
    return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor


@pytest.mark.parametrize("layout", [strided, transposed])
def test_layouts(layout):
    """Inputs and the adjoint image may have any layout."""
    plain, camera, leaves = with_leaves(mixed_scene(), CAMERA)
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    image = eg.render(plain, camera, 4, seed=0)
    expected = [image, *gradients(image, leaves, adjoint)]

    def changed(mesh: eg.Mesh) -> eg.Mesh:
        return mesh.replace(**{name: layout(value) for name, value in vars(mesh).items() if isinstance(value, Tensor)})

    scene = eg.Scene([changed(mesh) for mesh in plain.meshes], layout(plain.background))
    camera = camera.replace(world_to_camera=layout(camera.world_to_camera), K=layout(camera.K))
    assert not scene.meshes[0].verts.is_contiguous()
    image = eg.render(scene, camera, 4, seed=0)
    assert same_bits([image, *gradients(image, leaves, layout(adjoint))], expected)


def test_expanded_inputs():
    """One colour for all vertices; its gradient is the sum over them. And an adjoint that is one number."""
    color = leaf(MESH.colors[0])
    image = eg.render(MESH.replace(colors=color.expand(3, 3)), CAMERA, 4, seed=0)
    colors = leaf(color.expand(3, 3))
    other = eg.render(MESH.replace(colors=colors), CAMERA, 4, seed=0)
    assert torch.equal(image, other)
    torch.testing.assert_close(
        torch.autograd.grad(image.sum(), color)[0], torch.autograd.grad(other.sum(), colors)[0].sum(0)
    )


@pytest.mark.parametrize("verts", [F32, F64])
@pytest.mark.parametrize("colors", [F32, F64])
@pytest.mark.parametrize("camera", [F32, F64])
def test_dtypes(verts, colors, camera):
    """The image has the dtype of the colours, each gradient that of its tensor."""
    scene, moved, leaves = with_leaves(TRIANGLE.to(colors).replace(background=None), CAMERA.to(camera))
    position = leaf(MESH.verts.to(verts))
    scene = scene.replace(meshes=[scene.meshes[0].replace(verts=position)])
    image = eg.render(scene, moved, 4, seed=0)
    assert image.dtype == colors
    color, pose, K = leaves[1:]
    for tensor, gradient in zip((position, color, pose, K), gradients(image, (position, color, pose, K)), strict=True):
        assert gradient.dtype == tensor.dtype and gradient.shape == tensor.shape and gradient.any()
    # Geometry is computed in double, so that float32 only rounds what comes in and goes out; but the input's rounding,
    # 1e-7 of 10 px, moves an edge past one of the 1,600 samples with a probability of some 1e-3.
    expected = eg.render(TRIANGLE.replace(background=None), CAMERA, 4, seed=0)
    torch.testing.assert_close(image.double(), expected, rtol=0, atol=1e-5)


def test_dtype_is_the_widest_among_colours():
    both = eg.Scene([MESH.to(F32), MESH.transformed(t=[0.0, 0.0, 1.0])])
    assert eg.render(both, CAMERA, 4, seed=0).dtype == F64
    assert eg.render(eg.Scene(MESH.to(F32), BACKGROUND), CAMERA, 4, seed=0).dtype == F64
    assert eg.render(MESH.to(F32).replace(verts=MESH.verts), CAMERA, 4, seed=0).dtype == F32
    assert eg.render(eg.Mesh(MESH.verts, MESH.faces), CAMERA, 4, seed=0).dtype == F64  # plain: that of its vertices
    assert eg.render(eg.Mesh(MESH.verts.to(F32), MESH.faces), CAMERA, 4, seed=0).dtype == F32


@pytest.mark.parametrize("dtype", [torch.int32, torch.int16, torch.uint8])
def test_integer_dtypes(dtype):
    expected = image_and_gradients(mixed_scene(), CAMERA)
    meshes = [
        m.replace(faces=m.faces.to(dtype), uv_faces=None if m.uv_faces is None else m.uv_faces.to(dtype))
        for m in mixed_scene().meshes
    ]
    assert same_bits(image_and_gradients(mixed_scene().replace(meshes=meshes), CAMERA), expected)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 17])
def test_any_number_of_channels(channels):
    """The kernel has code of its own for some numbers; all give the same channel by channel."""
    palette = smooth_colors(torch.arange(3 * channels, dtype=F64).reshape(-1, 3)).reshape(3, channels)
    scene = eg.Scene(MESH.replace(colors=palette), palette[0])
    image = eg.render(scene, CAMERA, 4, seed=0)
    for c in range(channels):
        single = eg.Scene(MESH.replace(colors=palette[:, c : c + 1]), palette[0, c : c + 1])
        torch.testing.assert_close(image[..., c : c + 1], eg.render(single, CAMERA, 4, seed=0), rtol=1e-14, atol=1e-14)
    # A loss that looks at one channel only draws the samples that it draws when there is no other.
    verts = leaf(MESH.verts)
    adjoint = torch.zeros(SIZE, SIZE, channels, dtype=F64)
    adjoint[..., -1] = ADJOINT[..., 0]
    found = gradients(
        eg.render(eg.Scene(scene.meshes[0].replace(verts=verts), scene.background), CAMERA, 4, seed=0), [verts], adjoint
    )
    alone = eg.render(eg.Scene(single.meshes[0].replace(verts=verts), single.background), CAMERA, 4, seed=0)
    torch.testing.assert_close(found, gradients(alone, [verts], ADJOINT[..., :1]), rtol=1e-12, atol=1e-12)


def test_to_moves_everything():
    scene, camera, leaves = with_leaves(mixed_scene(), CAMERA)
    moved = scene.to("cpu", F32), camera.to("cpu", F32)
    assert all(m.verts.dtype == F32 and m.faces.dtype == torch.int64 for m in moved[0].meshes)
    assert moved[0].meshes[2].texture.dtype == F32 and moved[0].background.dtype == F32
    assert moved[1].K.dtype == moved[1].world_to_camera.dtype == F32
    image = eg.render(*moved, 4, seed=0)
    assert image.dtype == F32
    for tensor, gradient in zip(leaves, gradients(image, leaves), strict=True):
        assert gradient.dtype == F64 and gradient.shape == tensor.shape
    assert scene.to("cpu").meshes[0].verts is scene.meshes[0].verts


def test_default_device_does_not_matter():
    """The kernel's tensors live on the CPU, wherever new tensors are made by default; "meta" stands for any other."""
    for scene in (mixed_scene(), eg.Scene(eg.Mesh(MESH.verts, MESH.faces))):
        expected = image_and_gradients(scene, CAMERA)
        scene, camera, leaves = with_leaves(scene, CAMERA)
        with torch.device("meta"):
            image = eg.render(scene, camera, 4, seed=0)
            found = [image, *torch.autograd.grad(image, leaves, smooth_adjoint_on_cpu(image))]
        assert same_bits(found, expected)


def smooth_adjoint_on_cpu(image: Tensor) -> Tensor:
    with torch.device("cpu"):
        return smooth_adjoint(*image.shape)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_come_back():
    expected = image_and_gradients(mixed_scene(), CAMERA)
    scene, camera, leaves = with_leaves(mixed_scene().to("cuda"), CAMERA.to("cuda"))
    image = eg.render(scene, camera, 4, seed=0)
    found = [image, *gradients(image, leaves, ADJOINT.cuda())]
    assert all(tensor.device.type == "cuda" for tensor in found)
    assert same_bits([tensor.cpu() for tensor in found], expected)
    # A camera on the CPU looks at it all the same, and the image is where the scene is.
    assert eg.render(scene, CAMERA, 4, seed=0).device.type == "cuda"


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "uint32", "uint64"])
def test_faces_of_unsigned_integers(dtype: str) -> None:
    faces = np.array([[0, 1, 2]], dtype)
    for given in (faces, torch.from_numpy(faces)):
        mesh = eg.Mesh(torch.eye(3), given)
        assert mesh.faces.long().tolist() == [[0, 1, 2]]
