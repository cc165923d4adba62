"""What is refused, and how: each message names the argument, what was expected and what came."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scenes import cube, front_camera

import edgegrad as eg
from edgegrad import library
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import kernel_scene as scene_of_kernel
from edgegrad.library import core

pytestmark = pytest.mark.watched

F64 = torch.float64
NAN, INF = torch.nan, torch.inf
VERTS, FACES = cube().verts.float(), cube().faces
CAMERA = front_camera(8)
POSE, K = CAMERA.world_to_camera, CAMERA.K


def mesh(**fields: object) -> eg.Mesh:
    return eg.Mesh(**{"verts": VERTS, "faces": FACES, **fields})


def textured(**fields: object) -> eg.Mesh:
    return mesh(**{"texture": torch.rand(4, 5, 3), "uvs": torch.rand(8, 2), "uv_faces": FACES, **fields})


def camera(**fields: object) -> eg.Camera:
    return eg.Camera(**{"world_to_camera": POSE, "K": K, "size": (8, 8), **fields})


def look_at(**fields: object) -> eg.Camera:
    return eg.Camera.look_at(**{"eye": (0.0, 0.0, 4.0), "target": (0.0, 0.0, 0.0), **fields})


def render(scene: object = None, view: object = CAMERA, **options: object) -> torch.Tensor:
    return eg.render(mesh() if scene is None else scene, view, **{"spp": 1, **options})


def put(tensor: torch.Tensor, index: tuple[int, ...] | int, value: float) -> torch.Tensor:
    """A copy with one element replaced."""
    tensor = tensor.clone()
    tensor[index] = value
    return tensor


def check(call: Callable[[], object], error: type[Exception], *parts: str) -> None:
    """The call raises this very error, and its message has all the parts, in their order."""
    with pytest.raises((TypeError, ValueError), match=r"[\s\S]*".join(map(re.escape, parts))) as raised:
        call()
    assert raised.type is error


def test_check_tells_messages_apart():
    def call():
        raise ValueError("verts: expected shape (V, 3), got (3, 2)")

    check(call, ValueError, "verts", "(V, 3)", "(3, 2)")
    for error, parts in [(TypeError, ["verts"]), (ValueError, ["faces"]), (ValueError, ["(3, 2)", "(V, 3)"])]:
        with pytest.raises(AssertionError):
            check(call, error, *parts)


T, V = TypeError, ValueError

MESH = {
    "verts is text": (lambda: mesh(verts="cube"), T, "verts: expected a tensor, array or nested sequence", "got str"),
    "verts is missing": (lambda: mesh(verts=None), T, "verts: expected a tensor", "got NoneType"),
    "faces is missing": (lambda: mesh(faces=None), T, "faces: expected a tensor", "got NoneType"),
    "verts of integers": (
        lambda: mesh(verts=FACES),
        T,
        "verts: expected float32 or float64, got torch.int64",
        ".float()",
    ),
    "verts in half precision": (
        lambda: mesh(verts=VERTS.half()),
        T,
        "verts: expected float32 or float64, got torch.float16",
    ),
    "verts in 2-D": (lambda: mesh(verts=VERTS[:, :2]), V, "verts: expected shape (V, 3), got (8, 2)"),
    "no verts": (lambda: mesh(verts=VERTS[:0]), V, "verts: expected shape (V, 3), none of them 0, got (0, 3)"),
    "verts not finite": (
        lambda: mesh(verts=put(put(VERTS, (3, 1), NAN), (5, 0), INF)),
        V,
        "verts: expected finite numbers, got nan at [3, 1] (2 such values in all)",
    ),
    "faces of floats": (
        lambda: mesh(faces=FACES.float()),
        T,
        "faces: expected an integer dtype",
        "got torch.float32",
        ".long()",
    ),
    "quads": (lambda: mesh(faces=FACES.reshape(-1, 4)), V, "faces: expected shape (F, 3), got (9, 4); triangulate"),
    "no faces": (lambda: mesh(faces=FACES[:0]), V, "faces: expected shape (F, 3), none of them 0, got (0, 3)"),
    "face index too large": (
        lambda: mesh(faces=put(FACES, (4, 2), 8)),
        V,
        "faces: expected indices from 0 to 7 (verts has 8 rows), got 8 at [4, 2]",
    ),
    "face index negative": (
        lambda: mesh(faces=put(FACES, (4, 2), -1)),
        V,
        "faces: expected indices from 0",
        "got -1 at [4, 2]",
    ),
    "two kinds of colour": (
        lambda: mesh(colors=VERTS, face_colors=torch.rand(12, 3)),
        V,
        "face_colors: expected one kind of colour, got colors and face_colors",
    ),
    "colors of bytes": (lambda: mesh(colors=VERTS.byte()), T, "colors: expected float32 or float64, got torch.uint8"),
    "colors too few": (lambda: mesh(colors=VERTS[:7]), V, "colors: expected shape (8, C), got (7, 3)"),
    "colors without channels": (
        lambda: mesh(colors=VERTS[:, :0]),
        V,
        "colors: expected shape (8, C), none of them 0, got (8, 0)",
    ),
    "face_colors too few": (lambda: mesh(face_colors=VERTS), V, "face_colors: expected shape (12, C), got (8, 3)"),
    "corner_colors flat": (
        lambda: mesh(corner_colors=VERTS),
        V,
        "corner_colors: expected shape (12, 3, C), got (8, 3)",
    ),
    "texture flat": (lambda: textured(texture=VERTS), V, "texture: expected shape (h, w, C), got (8, 3)"),
    "colors not finite": (
        lambda: mesh(colors=put(VERTS, (7, 2), -INF)),
        V,
        "colors: expected finite numbers, got -inf at [7, 2]",
    ),
    "texture not finite": (
        lambda: textured(texture=put(torch.rand(4, 5, 3), (1, 2, 0), NAN)),
        V,
        "texture: expected finite numbers, got nan at [1, 2, 0]",
    ),
    "texture without uvs": (lambda: textured(uvs=None), V, "uvs: expected with a texture, got None"),
    "texture without uv_faces": (lambda: textured(uv_faces=None), V, "uv_faces: expected with a texture, got None"),
    "uvs alone": (lambda: textured(texture=None, uv_faces=None), V, "uv_faces: expected with uvs, got None"),
    "uv_faces alone": (lambda: mesh(uv_faces=FACES), V, "uvs: expected with uv_faces, got None"),
    "alpha without uvs": (lambda: mesh(alpha=torch.ones(2, 2)), V, "uvs: expected with alpha, got None"),
    "alpha of colours": (lambda: textured(alpha=torch.ones(2, 2, 1)), V, "alpha: expected shape (h, w), got (2, 2, 1)"),
    "alpha of bytes": (lambda: textured(alpha=torch.ones(2, 2).byte()), T, "alpha: expected float32 or float64"),
    "alpha not finite": (
        lambda: textured(alpha=torch.tensor([[1.0, NAN]])),
        V,
        "alpha: expected finite numbers, got nan at [0, 1]",
    ),
    "alpha_cutoff as text": (lambda: textured(alpha_cutoff="half"), T, "alpha_cutoff: expected a number, got str"),
    "alpha_cutoff not finite": (
        lambda: textured(alpha_cutoff=NAN),
        V,
        "alpha_cutoff: expected a finite number, got nan",
    ),
    "wrap unknown": (lambda: textured(wrap="border"), V, "wrap: expected one of repeat, clamp, mirror, or a pair"),
    "wrap of three axes": (lambda: textured(wrap=("clamp",) * 3), V, "wrap: expected one of repeat, clamp, mirror"),
    "filter of a texture": (
        lambda: textured(filter="cubic"),
        V,
        "filter: expected one of linear, nearest, mipmap, got 'cubic'",
    ),
    "uvs in 3-D": (lambda: textured(uvs=VERTS), V, "uvs: expected shape (T, 2), got (8, 3)"),
    "uvs of integers": (lambda: textured(uvs=FACES[:, :2]), T, "uvs: expected float32 or float64, got torch.int64"),
    "uvs not finite": (
        lambda: textured(uvs=put(torch.rand(8, 2), (6, 1), NAN)),
        V,
        "uvs: expected finite",
        "nan at [6, 1]",
    ),
    "uv_faces of floats": (lambda: textured(uv_faces=FACES.float()), T, "uv_faces: expected an integer dtype"),
    "uv_faces too few": (lambda: textured(uv_faces=FACES[:5]), V, "uv_faces: expected shape (12, 3), got (5, 3)"),
    "uv index too large": (
        lambda: textured(uvs=torch.rand(6, 2)),
        V,
        "uv_faces: expected indices from 0 to 5 (uvs has 6 rows), got 7",
    ),
    "replace what is not there": (lambda: mesh().replace(vertices=VERTS), T, "replace: expected one of", "'vertices'"),
    "scale of three": (
        lambda: mesh().transformed(scale=torch.ones(3)),
        V,
        "scale: expected one number, got shape (3,)",
    ),
    "scale of text": (lambda: mesh().transformed(scale="big"), T, "scale: expected a tensor", "got str"),
    "R of another shape": (lambda: mesh().transformed(torch.eye(4)), V, "R: expected shape (3, 3), got (4, 4)"),
    "R of integers": (
        lambda: mesh().transformed(torch.eye(3).long()),
        T,
        "R: expected float32 or float64, got torch.int64",
    ),
    "t of another shape": (lambda: mesh().transformed(t=torch.ones(3, 1)), V, "t: expected shape (3,), got (3, 1)"),
    "t not finite": (
        lambda: mesh().transformed(t=[0.0, NAN, 0.0]),
        V,
        "t: expected finite numbers, got nan at [1]",
    ),
}

SCENE = {
    "no mesh": (lambda: eg.Scene([]), V, "meshes: expected at least one Mesh, got none"),
    "a number": (lambda: eg.Scene(3), T, "meshes: expected a Mesh or a sequence of them, got int"),
    "not a mesh": (lambda: eg.Scene([mesh(), VERTS]), T, "meshes[1]: expected a Mesh, got Tensor"),
    "other channels": (
        lambda: eg.Scene([mesh(), mesh(colors=VERTS), mesh(colors=VERTS[:, :2])]),
        V,
        "meshes[2]: expected 3 channels like meshes[1], got 2",
    ),
    "another device": (
        lambda: eg.Scene([mesh(), mesh().to("meta")]),
        V,
        "meshes: expected one device, got ['cpu', 'meta']",
    ),
    "background of text": (lambda: eg.Scene(mesh(), "red"), T, "background: expected a tensor", "got str"),
    "background of bytes": (lambda: eg.Scene(mesh(), VERTS[0].byte()), T, "background: expected float32 or float64"),
    "background of other channels": (
        lambda: eg.Scene(mesh(colors=VERTS), torch.zeros(4)),
        V,
        "background: expected shape (3,) or (H, W, 3), got (4,)",
    ),
    "background not finite": (
        lambda: eg.Scene(mesh(), [0.0, NAN, 0.0]),
        V,
        "background: expected finite",
        "nan at [1]",
    ),
}

CAMERAS = {
    "pose of text": (lambda: camera(world_to_camera="here"), T, "world_to_camera: expected a tensor", "got str"),
    "pose of integers": (
        lambda: camera(world_to_camera=torch.eye(4).int()),
        T,
        "world_to_camera: expected float32 or float64",
    ),
    "pose without last row": (
        lambda: camera(world_to_camera=POSE[:3]),
        V,
        "world_to_camera: expected shape (4, 4)",
        "(3, 4)",
    ),
    "pose not finite": (lambda: camera(world_to_camera=put(POSE, (1, 3), NAN)), V, "world_to_camera", "nan at [1, 3]"),
    "pose transposed": (
        lambda: camera(world_to_camera=POSE.mT),
        V,
        "world_to_camera: expected the last row",
        "transposed?",
    ),
    "pose with a scale": (
        lambda: camera(world_to_camera=torch.diag(torch.tensor([2.0, 2, 2, 1]))),
        V,
        "world_to_camera: expected a rotation in the upper 3 × 3, got one with |R Rᵀ − 1| up to 3",
    ),
    "pose with a reflection": (
        lambda: camera(world_to_camera=torch.diag(torch.tensor([1.0, -1, 1, 1]))),
        V,
        "world_to_camera: expected a rotation, got a reflection",
    ),
    "K of another shape": (lambda: camera(K=K[:2]), V, "K: expected shape (3, 3) or (B, 3, 3), got (2, 3)"),
    "K of integers": (lambda: camera(K=K.long()), T, "K: expected float32 or float64, got torch.int64"),
    "K not finite": (lambda: camera(K=put(K, (0, 0), INF)), V, "K: expected finite numbers, got inf at [0, 0]"),
    "K transposed": (lambda: camera(K=K.mT), V, "K: expected the last row", "transposed?"),
    "K singular": (lambda: camera(K=put(K, (1, 1), 0.0)), V, "K: expected focal lengths that are not zero", "singular"),
    "batches that differ": (
        lambda: camera(world_to_camera=POSE.expand(2, 4, 4), K=K.expand(3, 3, 3)),
        V,
        "K: expected a batch of 2 like world_to_camera, got 3",
    ),
    "size is a number": (lambda: camera(size=8), T, "size: expected (height, width), got 8"),
    "size is missing": (lambda: camera(size=None), T, "size: expected (height, width), got None"),
    "size of three": (lambda: camera(size=(8, 8, 3)), T, "size: expected (height, width), got (8, 8, 3)"),
    "size of floats": (lambda: camera(size=(8.0, 8)), T, "size: expected an int, got float (8.0)"),
    "size zero": (lambda: camera(size=(0, 8)), V, "size: expected an int from 1 to 65536, got 0"),
    "size too large": (lambda: look_at(size=(8, 100_000)), V, "size: expected an int from 1 to 65536, got 100000"),
    "projection": (
        lambda: camera(projection="cylinder"),
        V,
        "projection: expected one of 'perspective', 'fisheye', 'panorama', 'orthographic', got 'cylinder'",
    ),
    "eye in 2-D": (lambda: look_at(eye=(0.0, 1.0)), V, "eye: expected shape (3,), got (2,)"),
    "eye not finite": (lambda: look_at(eye=(0.0, NAN, 1.0)), V, "eye: expected finite numbers, got nan at [1]"),
    "target of text": (lambda: look_at(target="origin"), T, "target: expected a tensor", "got str"),
    "eye on target": (
        lambda: look_at(eye=(0, 0, 0)),
        V,
        "target: expected a point apart from eye, got both at [0.0, 0.0, 0.0]",
    ),
    "up along the view": (lambda: look_at(up=(0, 0, 1)), V, "up: expected a direction apart from the line of sight"),
    "up of zero": (lambda: look_at(up=(0, 0, 0)), V, "up: expected a direction", "[0.0, 0.0, 0.0]"),
    "fov_y too wide": (lambda: look_at(fov_y=180.0), V, "fov_y: expected degrees between 0 and 180, got 180"),
    "fov_y not a number": (lambda: look_at(fov_y=NAN), V, "fov_y: expected degrees between 0 and 180, got nan"),
    "fov_y of two": (lambda: look_at(fov_y=torch.ones(2)), V, "fov_y: expected one number, got shape (2,)"),
    "height negative": (
        lambda: eg.Camera.orthographic((0, 0, 4), (0, 0, 0), height=-1.0),
        V,
        "height: expected world units above 0, got -1",
    ),
    "OpenCV, R": (
        lambda: eg.Camera.from_opencv(POSE, POSE[:3, 3], K, (8, 8)),
        V,
        "R: expected shape (3, 3), got (4, 4)",
    ),
    "OpenCV, t": (
        lambda: eg.Camera.from_opencv(POSE[:3, :3], POSE[3], K, (8, 8)),
        V,
        "t: expected 3 numbers, got shape (4,)",
    ),
    "OpenCV, K": (
        lambda: eg.Camera.from_opencv(POSE[:3, :3], POSE[:3, 3], POSE, (8, 8)),
        V,
        "K: expected shape (3, 3)",
    ),
    "OpenGL, pose": (
        lambda: eg.Camera.from_opengl(K, (8, 8), 40.0),
        V,
        "camera_to_world: expected shape (4, 4) or (B, 4, 4), got (3, 3)",
    ),
    "OpenGL, neither": (
        lambda: eg.Camera.from_opengl(POSE, (8, 8)),
        T,
        "from_opengl: expected one of fov_y, fov_x and K, got none",
    ),
    "OpenGL, both": (
        lambda: eg.Camera.from_opengl(POSE, (8, 8), 40.0, K),
        T,
        "expected one of fov_y, fov_x and K, got fov_y and K",
    ),
    "OpenGL, fov_y": (lambda: eg.Camera.from_opengl(POSE, (8, 8), 200.0), V, "fov_y: expected degrees", "got 200"),
    "stack of nothing": (lambda: eg.Camera.stack([]), V, "cameras: expected at least one camera, got none"),
    "stack of tensors": (lambda: eg.Camera.stack([POSE]), T, "cameras[0]: expected a Camera, got Tensor"),
    "stack of sizes": (
        lambda: eg.Camera.stack([CAMERA, CAMERA.resized((4, 8))]),
        V,
        "cameras[1]: expected a single perspective camera of size (8, 8), got Camera(perspective, 4 × 8",
    ),
}

RENDER = {
    "scene": (lambda: render(VERTS), T, "scene: expected a Scene or a Mesh, got Tensor"),
    "camera": (lambda: render(view=POSE), T, "camera: expected a Camera, got Tensor", "Camera.look_at"),
    "spp of floats": (lambda: render(spp=4.0), T, "spp: expected an int, got float (4.0)"),
    "spp of a bool": (lambda: render(spp=True), T, "spp: expected an int, got bool (True)"),
    "spp of a tensor of floats": (lambda: render(spp=torch.tensor(1.5)), T, "spp: expected an int, got Tensor"),
    "spp zero": (lambda: render(spp=0), V, "spp: expected an int from 1 to 1048576, got 0"),
    "seed of text": (lambda: render(seed="one"), T, "seed: expected an int, got str ('one')"),
    "seed negative": (lambda: render(seed=-1), V, "seed: expected an int from 0 to 2⁶³ − 1, got -1"),
    "seed too large": (lambda: render(seed=2**63), V, "seed: expected an int from 0 to 2⁶³ − 1", str(2**63)),
    "grad_seed": (lambda: render(grad_seed=0.5), T, "grad_seed: expected an int, got float (0.5)"),
    "surface_samples": (lambda: render(surface_samples=0), V, "surface_samples: expected an int from 1", "got 0"),
    "edge_samples": (lambda: render(edge_samples="many"), T, "edge_samples: expected an int, got str ('many')"),
    "visibility": (lambda: render(visibility=1), T, "visibility: expected True or False, got int (1)"),
    "filter": (lambda: render(filter="lanczos"), V, "filter: expected one of box, tent, gaussian, got 'lanczos'"),
    "background of another size": (
        lambda: render(eg.Scene(mesh(), torch.zeros(8, 9, 3))),
        V,
        "background: expected shape (8, 8, C), got (8, 9, 3); give it the camera's size",
    ),
}

CASES = [
    pytest.param(*case, id=f"{group}-{name}".replace(" ", "_"))
    for group, cases in (("mesh", MESH), ("scene", SCENE), ("camera", CAMERAS), ("render", RENDER))
    for name, case in (((name, (call, error, parts))) for name, (call, error, *parts) in cases.items())
]


@pytest.mark.parametrize("call, error, parts", CASES)
def test_message(call, error, parts):
    check(call, error, *parts)


def test_numbers_that_are_not_python_numbers_are_fine():
    size = tuple(np.array([8, 8]))
    image = render(view=camera(size=size), spp=np.int64(2), seed=torch.tensor(3), surface_samples=np.int32(4))
    assert image.shape == (8, 8, 3)


# -- what goes bad after it was checked: the kernel looks again -------------------------------------------------------


def malformed(name: str, index: tuple[int, ...], value: float) -> Callable[[], object]:
    """Renders after a change in place of one tensor of the scene or the camera."""

    def call() -> torch.Tensor:
        look = textured() if name in ("texture", "uvs", "uv_faces") else mesh(colors=VERTS)
        fields = {n: v.clone() for n, v in vars(look).items() if isinstance(v, torch.Tensor)}
        background, pose, intrinsics = torch.zeros(8, 8, 3), POSE.clone(), K.clone()
        scene = eg.Scene(eg.Mesh(**fields), background)
        view = camera(world_to_camera=pose, K=intrinsics)
        {**fields, "background": background, "world_to_camera": pose, "K": intrinsics}[name][index] = value
        return render(scene, view)

    return call


@pytest.mark.parametrize(
    "name, index, value, parts",
    [
        ("verts", (3, 1), NAN, ["verts: expected finite numbers, got nan at [3, 1]"]),
        ("colors", (5, 2), INF, ["colors: expected finite numbers, got inf at [5, 2]"]),
        ("uvs", (7, 0), -INF, ["uvs: expected finite numbers, got -inf at [7, 0]"]),
        ("texture", (2, 1, 0), NAN, ["texture: expected finite numbers, got nan at ["]),
        ("background", (0, 4, 1), NAN, ["background: expected finite numbers, got nan at ["]),
        ("world_to_camera", (2, 3), NAN, ["world_to_camera: expected finite numbers, got nan at [2, 3]"]),
        ("K", (1, 2), INF, ["K: expected finite numbers, got inf at [1, 2]"]),
        ("K", (0, 0), 0.0, ["K: expected focal lengths that are not zero, got a singular matrix"]),
        ("faces", (4, 1), 8, ["faces: expected indices from 0 to 7 (rows of verts), got 8 at [4, 1]"]),
        ("faces", (0, 2), -1, ["faces: expected indices from 0 to 7 (rows of verts), got -1 at [0, 2]"]),
        ("uv_faces", (4, 1), 8, ["uv_faces: expected indices from 0 to 7 (rows of uvs), got 8 at [4, 1]"]),
    ],
)
def test_change_in_place_after_the_checks(name, index, value, parts):
    check(malformed(name, index, value), ValueError, *parts)


def test_change_in_place_beyond_the_range_of_floats() -> None:
    mesh = eg.Mesh(VERTS.double(), FACES)
    mesh.verts[2, 1] = 1e200
    check(lambda: render(mesh, camera()), ValueError, "verts: expected numbers up to 3.4e38, got 1", "at [2, 1]")


@pytest.mark.parametrize("value", [NAN, INF])
def test_adjoint_that_is_not_finite(value):
    verts = VERTS.clone().requires_grad_()
    image = render(mesh(verts=verts))
    adjoint = put(torch.ones_like(image), (3, 2, 1), value)
    check(
        lambda: image.backward(adjoint), ValueError, f"the gradient of the image: expected finite numbers, got {value}"
    )
    assert verts.grad is None


def kernel_scene(**arrays: np.ndarray) -> object:
    """The kernel's scene of a textured mesh, some of its arrays replaced."""
    flat = flatten(eg.Scene([textured(), mesh(colors=VERTS)]))
    return scene_of_kernel(flat._replace(**{name: torch.as_tensor(array) for name, array in arrays.items()}))


FLAT = flatten(eg.Scene([textured(), mesh(colors=VERTS)]))


@pytest.mark.parametrize(
    "arrays, parts",
    [
        ({"verts": torch.zeros(4, 2, dtype=F64)}, ["verts: expected 3 columns, got 2"]),
        ({"faces": FLAT.faces[:, :2]}, ["faces: expected 3 columns, got 2"]),
        ({"corners": FLAT.corners[:, :1]}, ["corners: expected 3 columns, got 1"]),
        ({"colors": FLAT.colors[:, :2]}, ["texels: expected 2 columns, got 3"]),
        ({"uvs": torch.zeros(8, 3, dtype=F64)}, ["uvs: expected 2 columns, got 3"]),
        ({"texels": FLAT.texels[:, :1]}, ["texels: expected 3 columns, got 1"]),
        ({"textures": FLAT.textures[:, :2]}, ["textures: expected 6 columns, got 2"]),
        ({"corners": FLAT.corners[:3]}, ["corners: expected one row a face"]),
        ({"faces": FLAT.faces[:0], "corners": FLAT.corners[:0]}, ["faces: expected at least one face, got none"]),
        ({"face_texture": FLAT.face_texture[:3]}, ["face_texture: expected one number a face"]),
        ({"face_texture": FLAT.face_texture + 1}, ["face_texture: expected a texture's number, got 1"]),
        ({"textures": FLAT.textures + 1}, ["textures: row 0 lies outside the texels"]),
        ({"textures": FLAT.textures * 0}, ["textures: row 0 lies outside the texels"]),
        ({"colors": FLAT.colors[:4]}, ["colors: expected indices from 0 to 3 (rows of colors), got"]),
    ],
)
def test_kernel_refuses_arrays_that_do_not_fit(arrays, parts):
    """Nothing that the package builds; it would be an error of its own."""
    check(lambda: kernel_scene(**arrays), ValueError, *parts)


SEEN = np.ones(24, np.uint8)  # the faces of kernel_scene


def kernel_camera(pose: torch.Tensor = POSE, intrinsics: torch.Tensor = K) -> object:
    return core.Camera(pose.contiguous().numpy(), intrinsics.contiguous().numpy(), np.zeros(8), True, "pinhole", 8, 8)


def pixels(coverage: np.ndarray) -> object:
    """What the image pass leaves to the backward pass."""
    return core.HitsFloat(coverage, coverage.copy(), np.stack([coverage] * 2, -1).astype(np.int32), SEEN)


def kernel_channels(vertex: int = 0, face: int = 0, missing: int = 0, uv: bool = False, unit: int = -1) -> object:
    """So many attributes of vertices and of faces, for that many vertices and faces too few."""
    arrays = np.zeros((len(FLAT.verts) - missing, vertex)), np.zeros((len(FLAT.faces) - missing, face))
    return core.Channels(*arrays, alpha=False, barycentrics=False, uv=uv, unit=unit)


def kernel_forward(channels: int = 3, height: int = 8, filter: str = "box", **attributes: Any) -> None:
    image, coverage = np.zeros((height, 8, channels), np.float32), np.zeros((height, 8), np.float32)
    options = core.ImageOptions(spp=1, filter=filter, seed=0)
    kernel_scene().forward(kernel_camera(), kernel_channels(**attributes), options, 1, image, pixels(coverage))


def kernel_backward(**gradients: np.ndarray) -> None:
    image, coverage = np.zeros((8, 8, 3), np.float32), np.zeros((8, 8), np.float32)
    options = core.ImageOptions(spp=1, filter="box", seed=0), core.GradientOptions(seed=0)
    kernel_scene().backward(kernel_camera(), kernel_channels(), *options, 1, image, pixels(coverage), gradients)


@pytest.mark.parametrize(
    "call, parts",
    [
        (lambda: kernel_camera(pose=POSE[:3]), ["world_to_camera: expected shape (4, 4)"]),
        (lambda: kernel_camera(intrinsics=K[:2]), ["K: expected shape (3, 3)"]),
        (
            lambda: kernel_forward(channels=2),
            ["image: expected an image of the camera's size and the scene's channels"],
        ),
        (lambda: kernel_forward(height=7), ["image: expected an image of the camera's size"]),
        (lambda: kernel_forward(filter="sinc"), ['filter: expected "box", "tent" or "gaussian", got "sinc"']),
        (lambda: kernel_forward(vertex=1), ["background: expected one number for each channel"]),
        (lambda: kernel_forward(vertex=1, missing=1), ["vertex_attributes: expected one row a vertex"]),
        (lambda: kernel_forward(face=1, missing=1), ["face_attributes: expected one row a face"]),
        (lambda: kernel_forward(uv=True), ["uv: expected texture coordinates of all faces"]),
        (lambda: kernel_channels(face=5), ["face_attributes: expected at most 4 columns"]),
        (lambda: kernel_channels(vertex=3, unit=1), ["unit: expected -1, or the first of three columns"]),
        (lambda: kernel_backward(verts=np.zeros((3, 3))), ["gradient of verts: expected the size of verts"]),
        (lambda: kernel_backward(texels=np.zeros((3, 3))), ["gradient of texels: expected the size of texels"]),
        (lambda: kernel_backward(lights=np.zeros(3)), ["gradients: there is none of lights"]),
    ],
)
def test_kernel_refuses_arguments_that_do_not_fit(call, parts):
    check(call, ValueError, *parts)


# -- without a usable Embree ------------------------------------------------------------------------------------------

WITHOUT_EMBREE = """
import importlib.metadata, json, pathlib, sys

real = importlib.metadata.distribution

class Distribution:
    version = "4.4.0"
    def __init__(self, path): self.files = [] if path is None else [File(path)]

class File(type(pathlib.PurePosixPath())):
    @property
    def name(self): return "libembree4.so.4"
    def locate(self): return pathlib.Path(str(self))

def distribution(name):
    if name != "embreex": return real(name)
    if path == "not installed": raise importlib.metadata.PackageNotFoundError(name)
    return Distribution(path)

importlib.metadata.distribution = distribution
messages = []
for path in json.loads(sys.argv[1]):
    try: from edgegrad import render
    except ImportError as error: messages.append(str(error))
    for name in [n for n in sys.modules if n.startswith("edgegrad")]: del sys.modules[name]
print(json.dumps(messages))
"""


@pytest.mark.unwatched
def test_import_without_a_usable_embree(tmp_path):
    """Not installed; installed without the library; a file that is no library; a library that is not Embree."""
    text = tmp_path / "libembree4.so"
    text.write_text("no library")
    ways = ["not installed", None, str(text), str(tmp_path / "gone.so"), library.core.__file__]
    command = [sys.executable, "-c", WITHOUT_EMBREE, json.dumps(ways)]
    messages = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    reasons = [
        "embreex is not installed",
        "the installed embreex 4.4.0 carries no libembree4",
        f"cannot open {text}",
        f"cannot open {tmp_path / 'gone.so'}",
        f"{library.core.__file__} lacks rtcNewDevice; version 4.x is needed",
    ]
    for message, reason in zip(messages, reasons, strict=True):
        assert message.startswith("edgegrad needs the Embree 4 library") and "pip install 'embreex" in message
        assert reason in message


def test_index_into_another_mesh_in_place() -> None:
    """After the checks, an index beyond its own mesh must not read the next one."""
    for bad in (len(VERTS), -1):
        for changed in (0, 1):
            meshes = [eg.Mesh(VERTS.clone(), FACES.clone()) for _ in range(2)]
            meshes[changed].faces[2, 1] = bad
            with pytest.raises(ValueError, match="faces: expected indices from 0 to"):
                eg.render(eg.Scene(meshes), CAMERA)
