"""Messages of render() and of the kernel: each names the argument, what was expected and what came."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from messages import CAMERA, FACES, INF, NAN, POSE, VERTS, K, T, V, bad_calls, camera, check_message, mesh, textured

import edgegrad as eg
from edgegrad import library
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import kernel_scene as scene_of_kernel
from edgegrad.library import core

pytestmark = pytest.mark.watched

F64 = torch.float64


def render(scene: object = None, view: object = CAMERA, **options: object) -> torch.Tensor:
    return eg.render(mesh() if scene is None else scene, view, **{"seed": 0, "spp": 1, **options})


def test_check_tells_messages_apart():
    def call():
        raise ValueError("verts: expected shape (V, 3), got (3, 2)")

    check_message(call, ValueError, "verts", "(V, 3)", "(3, 2)")
    for error, parts in [(TypeError, ["verts"]), (ValueError, ["faces"]), (ValueError, ["(3, 2)", "(V, 3)"])]:
        with pytest.raises(AssertionError):
            check_message(call, error, *parts)


RENDER = {
    "scene": (lambda: render(VERTS), T, "scene: expected a Scene or a Mesh, got Tensor"),
    "camera": (lambda: render(view=POSE), T, "camera: expected a Camera, got Tensor", "Camera.look_at"),
    "spp of floats": (lambda: render(spp=4.0), T, "spp: expected an int, got float (4.0)"),
    "spp of a tensor of floats": (lambda: render(spp=torch.tensor(1.5)), T, "spp: expected an int, got Tensor"),
    "spp zero": (lambda: render(spp=0), V, "spp: expected an int from 1 to 1048576, got 0"),
    "seed too large": (lambda: render(seed=2**63), V, "seed: expected an int from 0 to 2⁶³ − 1", str(2**63)),
    "seed of a gradient": (lambda: eg.Sampling(seed=0.5), T, "sampling.seed: expected an int, got float (0.5)"),
    "samples of surfaces": (lambda: eg.Sampling(surface=0), V, "sampling.surface: expected an int from 1", "got 0"),
    "samples of edges": (lambda: eg.Sampling(edges=1.5), T, "sampling.edges: expected an int, got float (1.5)"),
    "points of lights": (lambda: eg.Sampling(lights=0), V, "sampling.lights: expected an int from 1", "got 0"),
    "creases": (lambda: eg.Sampling(creases="all"), V, "sampling.creases: expected \"auto\", True or False, got 'all'"),
    "no sampling": (lambda: render(sampling={"edges": 4}), T, "sampling: expected an edgegrad.Sampling, got dict"),
    "no generator": (lambda: render(generator=3), T, "generator: expected a torch.Generator, got int"),
    "seed and generator": (
        lambda: render(seed=3, generator=torch.Generator()),
        V,
        "seed: expected None together with a generator",
    ),
    "visibility": (lambda: render(visibility=1), T, "visibility: expected True or False, got int (1)"),
    "filter": (lambda: render(filter="lanczos"), V, "filter: expected one of box, tent, gaussian, got 'lanczos'"),
    "background of another size": (
        lambda: render(eg.Scene(mesh(), torch.zeros(8, 9, 3))),
        V,
        "background: expected shape (8, 8, C), got (8, 9, 3); give it the camera's size",
    ),
}


@bad_calls(RENDER)
def test_messages_of_render(call, error, parts):
    check_message(call, error, *parts)


def test_numbers_that_are_not_python_numbers_are_fine():
    size = tuple(np.array([8, 8]))
    image = render(
        view=camera(size=size), spp=np.int64(2), seed=torch.tensor(3), sampling=eg.Sampling(surface=np.int32(4))
    )
    assert image.shape == (8, 8, 3)


# -- what goes bad after it was checked: the kernel looks again -------------------------------------------------------


def malformed(name: str, index: tuple[int, ...], value: float) -> Callable[[], object]:
    """Return a call that renders after a change in place of one tensor of the scene or the camera."""

    def call() -> torch.Tensor:
        appearance = textured() if name in ("texture", "uvs", "uv_faces") else mesh(colors=VERTS)
        fields = {n: v.clone() for n, v in vars(appearance).items() if isinstance(v, torch.Tensor)}
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
    check_message(malformed(name, index, value), ValueError, *parts)


def test_change_in_place_beyond_the_range_of_floats() -> None:
    mesh = eg.Mesh(VERTS.double(), FACES)
    mesh.verts[2, 1] = 1e200
    check_message(
        lambda: render(mesh, camera()), ValueError, "verts: expected numbers up to 3.4e38, got 1", "at [2, 1]"
    )


def kernel_scene(**arrays: np.ndarray) -> object:
    """Return the kernel's scene of a textured mesh with some of its arrays replaced."""
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
    check_message(lambda: kernel_scene(**arrays), ValueError, *parts)


SEEN = np.ones(24, np.uint8)  # the faces of kernel_scene


def kernel_camera(pose: torch.Tensor = POSE, intrinsics: torch.Tensor = K) -> object:
    return core.Camera(pose.contiguous().numpy(), intrinsics.contiguous().numpy(), np.zeros(8), True, "pinhole", 8, 8)


def pixels(coverage: np.ndarray) -> object:
    """Return what the image pass leaves to the backward pass."""
    return core.HitsFloat(coverage, coverage.copy(), np.stack([coverage] * 2, -1).astype(np.int32), SEEN)


def kernel_channels(vertex: int = 0, face: int = 0, missing: int = 0, uv: bool = False, unit: int = -1) -> object:
    """Return so many attributes of vertices and of faces, for that many vertices and faces too few."""
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
    check_message(call, ValueError, *parts)


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
    kinds = ["not installed", None, str(text), str(tmp_path / "gone.so"), library.core.__file__]
    command = [sys.executable, "-c", WITHOUT_EMBREE, json.dumps(kinds)]
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


@pytest.mark.unwatched
@pytest.mark.parametrize("place", ["lib/libembree4.so", "lib/libembree4.dylib", "Library/bin/embree4.dll"])
def test_embree_of_conda_is_found(tmp_path, monkeypatch, place):
    """Its package embree brings the library without the distribution embreex."""

    def distribution(name):
        raise library.importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(library.importlib.metadata, "distribution", distribution)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    with pytest.raises(ImportError, match="embreex is not installed"):
        library.embree_path()
    (tmp_path / place).parent.mkdir(parents=True)
    (tmp_path / place).touch()
    assert library.embree_path() == str(tmp_path / place)


def test_index_into_another_mesh_in_place() -> None:
    """After the checks, an index beyond its own mesh must not read the next one."""
    for bad in (len(VERTS), -1):
        for changed in (0, 1):
            meshes = [eg.Mesh(VERTS.clone(), FACES.clone()) for _ in range(2)]
            meshes[changed].faces[2, 1] = bad
            with pytest.raises(ValueError, match="faces: expected indices from 0 to"):
                eg.render(eg.Scene(meshes), CAMERA, seed=0)


@pytest.mark.parametrize(
    "call, parts",
    [
        (
            lambda: eg.render_aovs(mesh(colors=VERTS), None, ["depth"], seed=0),
            ["camera: expected a Camera, got NoneType"],
        ),
        (
            lambda: eg.jvp(mesh(colors=VERTS), camera(), {VERTS: VERTS[None]}, sp=3, seed=0),
            ["jvp: expected only", "got 'sp'"],
        ),
        (lambda: eg.jvp(mesh(colors=VERTS), camera(), None, seed=0), ["tangents: expected a mapping", "got NoneType"]),
        (
            lambda: eg.screen_gradient(mesh(colors=VERTS), camera(), torch.zeros(8, 8, 3), bounces=2, seed=0),
            ["screen_gradient: expected only", "got 'bounces'"],
        ),
    ],
    ids=["camera", "jvp", "tangents", "screen_gradient"],
)
def test_calls_of_other_entry_points(call, parts):
    check_message(call, TypeError, *parts)
