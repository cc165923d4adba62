"""Properties of the checks: whatever is wrong with an argument, of any entry, is refused with a message that names it; and
whatever is merely stored in another way gives the same bits, image and gradient.

A case is a good call that is malformed in one or several places. Each spoiler says which arguments a message may name.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import fit_pose

F32, F64 = torch.float32, torch.float64
NAN, INF = math.nan, math.inf
LOOKS = ("plain", "colors", "face_colors", "corner_colors", "texture")
MESH = ("verts", "faces", "colors", "face_colors", "corner_colors", "texture", "uvs", "uv_faces")
CAMERA = ("world_to_camera", "K", "size", "projection")
FLOATS = (
    "verts", "colors", "face_colors", "corner_colors", "texture", "uvs", "background", "world_to_camera", "K"
)  # fmt: skip
ADJOINT = "the gradient of the image"


@dataclass
class Case:
    """The arguments of one call, and which of them are malformed: empty where the call must work."""

    values: dict[str, Any]
    malformed: set[str] = field(default_factory=set)
    how: list[str] = field(default_factory=list)

    def spoil(self, name: str, value: object, how: str, *also: str) -> None:
        self.values[name] = value
        self.malformed |= {name, *also}
        self.how.append(f"{name} {how}")


def good_case(draw: st.DrawFn) -> Case:
    """A cube with any look, before any background, in any camera, with any options."""
    random = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    dtype, look_dtype = draw(st.sampled_from([F32, F64])), draw(st.sampled_from([F32, F64]))
    H, W, C = draw(st.integers(2, 6)), draw(st.integers(2, 6)), draw(st.integers(1, 4))
    corners = torch.cartesian_prod(*[torch.tensor([-0.6, 0.6], dtype=dtype)] * 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = torch.tensor([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=random, dtype=look_dtype)

    values: dict[str, Any] = {"verts": corners + 0.1 * rand(8, 3).to(dtype), "faces": faces}
    look = draw(st.sampled_from(LOOKS))
    if look == "texture":
        values |= {"texture": rand(3, 4, C), "uvs": 3 * rand(7, 2) - 1, "uv_faces": (faces * 5 + 3) % 7}
    elif look != "plain":
        values[look] = rand(*{"colors": (8, C), "face_colors": (12, C), "corner_colors": (12, 3, C)}[look])
    behind = draw(st.sampled_from([(), (C,), (H, W, C)]))
    if behind:
        values["background"] = rand(*behind)
    camera = eg.Camera.look_at(torch.tensor([0.3, 0.4, -3.0], dtype=dtype), (0.0, 0.1, 0.0), size=(H, W))
    batch = draw(st.sampled_from([None, None, 2]))
    pose = camera.world_to_camera if batch is None else camera.world_to_camera.repeat(batch, 1, 1)
    values |= {"world_to_camera": pose, "K": camera.K, "size": (H, W)}
    values["projection"] = draw(st.sampled_from(["perspective", "orthographic", "panorama"]))
    values |= {"spp": draw(st.integers(1, 3)), "seed": draw(st.integers(0, 2**63 - 1))}
    for name, choices in (
        ("surface_samples", st.sampled_from([None, 1, 30])),
        ("edge_samples", st.sampled_from([None, 1, 30])),
        ("visibility", st.booleans()),
        ("filter", st.sampled_from(["box", "tent", "gaussian"])),
        ("grad_seed", st.sampled_from([None, 0, 7])),
    ):
        values[name] = draw(choices)
    return Case(values)


def call(values: dict[str, Any], entry: str = "render") -> list[Tensor]:
    """The image and the gradients of all floating-point tensors that require one, of copies of the values."""
    mesh = eg.Mesh(**{name: value for name, value in values.items() if name in MESH})
    meshes = values.get("meshes", lambda mesh: [mesh])(mesh)
    scene = values.get("scene", eg.Scene)(meshes, values.get("background"))
    camera = values.get("camera", eg.Camera)(*(values[name] for name in CAMERA))
    done = (*MESH, *CAMERA, "background", "meshes", "scene", "camera", ADJOINT, "leaves")
    options = {name: value for name, value in values.items() if name not in done}
    if entry == "plan":
        return [torch.tensor(eg.plan(scene, camera, **options).samples)]
    if entry == "profile":
        found = eg.profile(scene, camera, repeats=1, **options)
        return [torch.tensor(found.samples["image_samples"])]
    image = eg.render(scene, camera, **options)
    if not image.requires_grad:
        return [image]
    adjoint = values.get(ADJOINT, torch.linspace(-1, 1, image.numel(), dtype=image.dtype).reshape(image.shape))
    image.backward(adjoint)
    return [image.detach(), *(leaf.grad for leaf in values.get("leaves", []))]


# -- what spoils a call -----------------------------------------------------------------------------------------------


def put(tensor: Tensor, at: int, value: float) -> Tensor:
    tensor = tensor.clone(memory_format=torch.contiguous_format)
    tensor.view(-1)[at % tensor.numel()] = value
    return tensor


def rest_of(name: str) -> list[str]:
    """Other arguments whose check may come first where the size of one is wrong."""
    return {"verts": ["faces", "colors"], "uvs": ["uv_faces"], "texture": ["background", "meshes[1]"]}.get(name, [])


NO_TENSOR = ["text", object(), {"a": 1}, [[1.0, 2.0], [3.0]], [["a"]], 1j, [10**400], b"bytes", Ellipsis]


def spoil_float(draw: st.DrawFn, case: Case) -> None:
    name = draw(st.sampled_from([name for name in FLOATS if name in case.values]))
    tensor, at = case.values[name], draw(st.integers(0, 10**6))
    if (
        not isinstance(tensor, Tensor)
        or tensor.is_sparse
        or tensor.is_meta
        or not tensor.is_floating_point()
        or tensor.numel() == 0
        or tensor.ndim == 0
    ):
        return  # malformed already
    number = st.sampled_from([NAN, INF, -INF] + [1e39, -1e100, 1e300] * (tensor.dtype == F64))
    ways: dict[str, Callable[[], object]] = {
        "holds a number": lambda: put(tensor, at, draw(number)),
        "has another dtype": lambda: tensor.to(
            draw(st.sampled_from([torch.half, torch.bfloat16, torch.int64, torch.bool, torch.complex64]))
        ),
        "has more dimensions": lambda: tensor[None] if name == "background" else tensor[None, None],
        "has fewer dimensions": lambda: tensor.reshape(-1)[0],
        "is sparse": lambda: tensor.to_sparse(),
        "is on another device": lambda: tensor.to("meta"),
        "is no tensor": lambda: draw(st.sampled_from(NO_TENSOR)),
        "is empty": lambda: tensor[..., :0] if draw(st.booleans()) else tensor[:0],
        "is a list of gradients": lambda: [tensor.clone().requires_grad_()],
    }
    how = draw(st.sampled_from(list(ways)))
    value = ways[how]()
    also = rest_of(name) if how in ("is empty", "has fewer dimensions") else []
    case.spoil(name, value, how, *also)


def spoil_uv(draw: st.DrawFn, case: Case) -> None:
    if "uvs" in case.values and "uvs" not in case.malformed:
        case.spoil(
            "uvs",
            put(case.values["uvs"], draw(st.integers(0, 100)), draw(st.sampled_from([2e9, -1e12, 1e30]))),
            "is far out",
        )


def spoil_index(draw: st.DrawFn, case: Case) -> None:
    name = draw(st.sampled_from([name for name in ("faces", "uv_faces") if name in case.values]))
    index, at = case.values[name], draw(st.integers(0, 35))
    if name in case.malformed:
        return
    rows = 8 if name == "faces" else 7
    beyond = st.sampled_from([-1, -rows, -(2**31), -(2**63), rows, 255, 2**31 - 1, 2**31, 2**32, 2**40, 2**63 - 1])
    ways: dict[str, Callable[[], object]] = {
        "is out of range": lambda: put(index, at, draw(beyond)),
        "is not of integers": lambda: index.to(draw(st.sampled_from([F32, F64, torch.bool, torch.complex64]))),
        "has another width": lambda: index.reshape(
            draw(st.sampled_from([(9, 4), (18, 2), (36,), (1, 12, 3), (36, 1)]))
        ),
        "is empty": lambda: index[:0] if draw(st.booleans()) else index[:, :0],
        "is sparse": lambda: index.to_sparse(),
        "is on another device": lambda: index.to("meta"),
        "requires a gradient": lambda: index.double().requires_grad_(),
        "is no tensor": lambda: draw(st.sampled_from(NO_TENSOR)),
        "is long": lambda: index[:1].expand(2**30, 3),  # of no memory, but more corners than 32 bits count
    }
    how = draw(st.sampled_from(list(ways)))
    # The looks of faces are as many as faces.
    also = ("face_colors", "corner_colors", "uv_faces") if how in ("is long",) else ()
    case.spoil(name, ways[how](), how, *also)


def spoil_camera(draw: st.DrawFn, case: Case) -> None:
    M, K = case.values["world_to_camera"], case.values["K"]
    if case.malformed & {"world_to_camera", "K"}:
        return
    linear = torch.eye(4).to(M)
    ways: dict[str, tuple[str, Callable[[], object]]] = {
        "is scaled": ("world_to_camera", lambda: M * torch.tensor([[2.0], [2.0], [2.0], [1.0]]).to(M)),
        "is mirrored": ("world_to_camera", lambda: linear.diagonal_scatter(torch.tensor([1.0, -1, 1, 1]).to(M)) @ M),
        "is sheared": ("world_to_camera", lambda: put(linear, 1, 0.1) @ M),
        "has no rotation": ("world_to_camera", lambda: M * torch.tensor([0.0, 0, 0, 1]).to(M)),
        "is transposed": ("world_to_camera", lambda: M.mT),
        "is not affine": ("world_to_camera", lambda: M + put(torch.zeros_like(linear), 14, 1.0)),
        "has no focal length": ("K", lambda: put(K, draw(st.sampled_from([0, 4])), 0.0)),
        "is of rank one": ("K", lambda: torch.cat([K[:1], 2 * K[:1], K[2:]])),
        "has a focal length of nothing": ("K", lambda: torch.diag(torch.tensor([1e-200, 1e-200, 1], dtype=F64))),
        "is transposed as well": ("K", lambda: K.mT),
        "is projective": ("K", lambda: put(K, 8, 2.0)),
        "is of another batch": ("K", lambda: K.repeat(3, 1, 1)),
    }
    how = draw(st.sampled_from(list(ways)))
    name, value = ways[how]
    if how == "is of another batch" and M.dim() == 2:
        return  # then there is no other
    case.spoil(name, value(), how)


BAD_INTS = [-1, -(2**63), 2**63, 10**30, 1.5, 2.0, NAN, "4", True, [4], torch.tensor([1, 2]), 1j]
BAD_OPTIONS: dict[str, list[object]] = {
    "spp": [*BAD_INTS, 0, None, 2**20 + 1],
    "seed": [*BAD_INTS, None],
    "grad_seed": BAD_INTS,
    "surface_samples": [*BAD_INTS, 0, 2**41],
    "edge_samples": [*BAD_INTS, 0, 2**41],
    "visibility": [0, 1, "yes", None, torch.tensor(True)],
    "filter": ["sinc", "", None, 3, b"box", [], ("box",)],
    "size": [(0, 4), (-1, 4), (4, 0), (4,), (4, 4, 4), 4, None, "ab", (4.0, 4), (4, 2**17), (2**70, 4), (True, 4), (None, 4)],
    "projection": ["pinhole", None, 3, "Perspective", b"perspective"],
}  # fmt: skip


def spoil_option(draw: st.DrawFn, case: Case) -> None:
    name = draw(st.sampled_from(list(BAD_OPTIONS)))
    bad = draw(st.sampled_from(BAD_OPTIONS[name]))
    case.spoil(name, bad, f"is {bad!r}")


def spoil_objects(draw: st.DrawFn, case: Case) -> None:
    other = eg.Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]]), colors=torch.rand(3, 7))
    ways: dict[str, tuple[str, object, list[str]]] = {
        "is empty": ("meshes", lambda _: [], []),
        "is a number": ("meshes", lambda _: 3, []),
        "is none": ("meshes", lambda _: None, []),
        "is a dictionary": ("meshes", lambda mesh: {"a": mesh}, []),
        "holds a tensor": ("meshes", lambda mesh: [mesh, mesh.verts], ["meshes[1]"]),
        "holds another device": ("meshes", lambda mesh: [mesh, mesh.to("meta")], []),
        # Of other channels than the background, where the first mesh is plain.
        "holds other channels": ("meshes", lambda mesh: [mesh, other, other.replace(colors=other.colors[:, :6])],
                                 ["meshes[1]", "meshes[2]", "background"]),
        "is a tensor": ("scene", lambda *_: torch.eye(3), []),
        "is nothing": ("scene", lambda *_: None, []),
        "is a list": ("scene", lambda *_: [GOOD_MESH], []),
        "is a matrix": ("camera", lambda pose, *_: pose, []),
        "is nowhere": ("camera", lambda *_: None, []),
    }  # fmt: skip
    how = draw(st.sampled_from(list(ways)))
    name, value, also = ways[how]
    case.spoil(name, value, how, *also)


def spoil_adjoint(draw: st.DrawFn, case: Case) -> None:
    """Also what only a backward pass meets."""
    values = case.values
    if case.malformed:
        return
    looks = [values[n] for n in (*LOOKS, "background") if n in values]
    dtype = F64 if any(t.dtype == F64 for t in looks) or (not looks and values["verts"].dtype == F64) else F32
    C = next((values[n].shape[-1] for n in (*LOOKS, "background") if n in values), 3)
    batch = [] if values["world_to_camera"].dim() == 2 else [len(values["world_to_camera"])]
    number = draw(st.sampled_from([NAN, INF, -INF] + [1e39, -1e200] * (dtype == F64)))
    ones = torch.ones([*batch, *values["size"], C], dtype=dtype)
    values["verts"] = values["verts"].clone().requires_grad_()
    case.spoil(ADJOINT, put(ones, draw(st.integers(0, 10**6)), number), f"holds {number}")


SPOILERS = [spoil_float, spoil_float, spoil_uv, spoil_index, spoil_camera, spoil_option, spoil_objects, spoil_adjoint]


@st.composite
def malformed_cases(draw: st.DrawFn) -> tuple[Case, str]:
    case = good_case(draw)
    if draw(st.booleans()):
        case.values["verts"].requires_grad_()
    for spoiler in draw(st.lists(st.sampled_from(SPOILERS), min_size=1, max_size=3)):
        spoiler(draw, case)
    return case, "render" if ADJOINT in case.malformed else draw(
        st.sampled_from(["render", "render", "plan", "profile"])
    )


def check_refused(run: Callable[[], object], names: set[str], how: object) -> None:
    """A TypeError or a ValueError that starts with one of the names, and says what was expected and what came."""
    try:
        run()
    except (TypeError, ValueError) as error:
        message = str(error)
        assert any(message.startswith(f"{name}:") for name in names), f"{how}: {message}"
        assert "expected" in message and "got" in message, f"{how}: {message}"
    else:
        raise AssertionError(f"{how}: nothing was raised")


def refuses(malformed: tuple[Case, str]) -> None:
    case, entry = malformed
    if case.malformed:
        check_refused(lambda: call(case.values, entry), case.malformed, case.how)
    else:
        call(case.values, entry)


# -- what does not ------------------------------------------------------------------------------------------------


def strided(t: Tensor) -> Tensor:
    return torch.stack([t, 7 + 0 * t, t], -1)[..., 0]


def transposed(t: Tensor) -> Tensor:
    return t.transpose(0, -1).contiguous().transpose(0, -1)


def offset(t: Tensor) -> Tensor:
    return torch.cat([t[:1], t, t[:1]])[1:-1]


def reversed_twice(t: Tensor) -> Tensor:
    return t.flip(0).flip(0)


def expanded(t: Tensor) -> Tensor:
    """Other values: one row for all."""
    return t[-1:].expand(t.shape) if t.dim() > 1 else t[-1].expand(t.shape)


def negated(t: Tensor) -> Tensor:
    """A view that says only that its numbers are to be negated."""
    return torch.complex(torch.zeros_like(t), -t).conj().imag if t.is_floating_point() else t


LAYOUTS = [strided, transposed, offset, reversed_twice, negated]
ROWS = ("colors", "face_colors", "corner_colors", "texture", "background")  # what may have one value all over


@st.composite
def harmless_cases(draw: st.DrawFn) -> tuple[dict[str, Any], dict[str, Any], list[str]]:
    """Two calls with the same numbers: in plain contiguous tensors, and stored in other ways."""
    values = good_case(draw).values
    leaves = [t.requires_grad_() for name, t in values.items() if name in FLOATS and draw(st.booleans())]
    plain, other, how = {**values, "leaves": leaves}, {**values}, []
    copies = {id(t): t.detach().clone().requires_grad_() for t in leaves}
    other["leaves"] = list(copies.values())
    for name, value in values.items():
        if not isinstance(value, Tensor):
            continue
        source = copies.get(id(value), value)
        layouts = LAYOUTS + [expanded] * (name in ROWS)
        change = draw(st.sampled_from([None, *layouts]))
        if change is None:
            other[name] = source
            continue
        how.append(f"{name} {change.__name__}")
        plain[name], other[name] = change(value).clone(memory_format=torch.contiguous_format), change(source)
        if name in ("faces", "uv_faces"):
            other[name] = other[name].to(draw(st.sampled_from([torch.uint8, torch.int16, torch.int32, torch.int64])))
        elif not value.requires_grad and draw(st.booleans()):
            other[name] = draw(st.sampled_from([Tensor.numpy, fortran]))(other[name].resolve_neg())
    for name in ("spp", "seed"):
        other[name] = draw(st.sampled_from([int, np.int64, torch.tensor]))(values[name])
    other["size"] = draw(st.sampled_from([list, np.array, torch.tensor]))(values["size"])
    return plain, other, how


def fortran(t: Tensor) -> np.ndarray:
    return np.asfortranarray(t.numpy())


def same_bits(calls: tuple[dict[str, Any], dict[str, Any], list[str]]) -> None:
    plain, other, how = calls
    expected, found = call(plain), call(other)
    assert len(expected) == len(found)
    for a, b in zip(expected, found, strict=True):
        assert (a is None) == (b is None), how
        assert a is None or (torch.equal(a, b) and bool(torch.isfinite(a).all())), how


# -- the helpers --------------------------------------------------------------------------------------------------

VECTOR = ["text", None, [1.0, 2.0], [[1.0, 2.0, 3.0]], [0.0, NAN, 1.0], [INF, 0.0, 0.0], torch.zeros(3, dtype=torch.half),
          torch.tensor([0.0, 1e300, 0.0], dtype=F64), torch.zeros(4), 3.0, torch.eye(3).to_sparse()]  # fmt: skip
MATRIX3 = ["text", None, torch.eye(4), torch.eye(2), torch.full((3, 3), NAN), torch.eye(3, dtype=torch.half), 1.0,
           torch.eye(3).to_sparse(), torch.eye(3).long()]  # fmt: skip
ROTATION = [*MATRIX3, 2.0 * torch.eye(3), -torch.eye(3), torch.zeros(3, 3), torch.eye(3) + 0.1]
ANGLE = [0.0, 180.0, 1j, [1j], torch.tensor(1j), -1.0, NAN, INF, "40", None, [1.0, 2.0], torch.ones(2), torch.eye(2)]
SIZE = BAD_OPTIONS["size"]
POSE4 = ["text", None, torch.eye(3), torch.full((4, 4), NAN), torch.eye(4).long(), torch.eye(4) * 2, torch.ones(4, 4),
         torch.diag(torch.tensor([1.0, 1, -1, 1])), torch.eye(4).to_sparse()]  # fmt: skip
NUMBER = ["big", 1j, torch.tensor(1j), None, [1.0, 2.0], NAN, INF, torch.ones(3), 1j, object()]
PIXELS = [1.5, "a", None, True, 2**40, -(2**70), torch.ones(2), [1]]
PICTURE = ["text", None, torch.rand(3), torch.rand(7, 8, 3), torch.full((8, 8, 3), NAN), torch.ones(8, 8, 3).byte(),
           torch.rand(8, 8, 3, 1), torch.rand(8, 8, 3).to_sparse()]  # fmt: skip

GOOD_MESH = eg.Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), colors=torch.eye(3))
GOOD_CAMERA = eg.Camera.look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0), size=(8, 8))
EYE = {"eye": (1.0, 2.0, 3.0), "target": (0.0, 0.0, 0.0), "up": (0.0, 1.0, 0.0), "size": (4, 4)}
COUNTS = [0, -1, 1.5, "4", None, True, 10**30]
HELPERS: dict[str, tuple[Callable[..., object], dict[str, Any], dict[str, list[Any]]]] = {
    "look_at": (eg.Camera.look_at, {**EYE, "fov_y": 40.0},
                {"eye": VECTOR, "target": VECTOR, "up": [*VECTOR, (0, 0, 0), (2.0, 4.0, 6.0)],
                 "fov_y": [a for a in ANGLE if a is not None], "size": SIZE}),
    "orthographic": (eg.Camera.orthographic, {**EYE, "height": 2.0},
                     {"eye": VECTOR, "target": VECTOR, "height": [-2.0, ANGLE[0], *ANGLE[2:]], "size": SIZE}),
    "from_opencv": (eg.Camera.from_opencv, {"R": torch.eye(3), "t": torch.ones(3), "K": torch.eye(3), "size": (4, 4)},
                    {"R": ROTATION, "t": [*VECTOR[:3], *VECTOR[4:]],  # one in two dimensions is what OpenCV gives
                     "K": [*MATRIX3[:-1], torch.zeros(3, 3), torch.ones(3, 3)], "size": SIZE}),
    "from_opengl": (eg.Camera.from_opengl, {"camera_to_world": torch.eye(4), "size": (4, 4), "K": torch.eye(3)},
                    {"camera_to_world": POSE4, "K": [m for m in MATRIX3 if m is not None], "size": SIZE}),
    "crop": (GOOD_CAMERA.crop, {"top": 1, "left": 1, "height": 4, "width": 4}, {"top": PIXELS, "left": PIXELS}),
    "resized": (GOOD_CAMERA.resized, {"size": (4, 4)}, {"size": SIZE}),
    "project": (GOOD_CAMERA.project, {"points": torch.zeros(5, 3)},
                {"points": ["text", None, torch.zeros(5, 2), torch.tensor(1.0), torch.zeros(3).long(), 3.0,
                            torch.full((2, 3), NAN), torch.zeros(2, 3).to_sparse(), torch.zeros(3).half()]}),
    "transformed": (GOOD_MESH.transformed, {"R": torch.eye(3), "t": torch.ones(3), "scale": 2.0},
                    {"R": [m for m in MATRIX3 if m is not None], "t": [v for v in VECTOR if v is not None],
                     "scale": NUMBER}),
    "scene transformed": (eg.Scene(GOOD_MESH).transformed, {"R": torch.eye(3), "t": torch.ones(3), "scale": 2.0},
                          {"R": [m for m in MATRIX3 if m is not None], "scale": NUMBER}),
    "stack": (eg.Camera.stack, {"cameras": [GOOD_CAMERA] * 2}, {"cameras": [[], GOOD_CAMERA]}),
    "fit_pose": (fit_pose, {"mesh": GOOD_MESH, "target": torch.rand(8, 8, 3), "camera": GOOD_CAMERA, "progress": False,
                            "steps": 1, "spp": 1, "max_size": 8},
                 {"mesh": ["text", None, torch.eye(3)], "target": PICTURE,
                  "camera": ["text", None, torch.eye(4), eg.Camera.stack([GOOD_CAMERA] * 2)],
                  "mask": [bad for bad in PICTURE if bad is not None] + [torch.rand(8, 8, 3)],
                  "init": ["text", torch.eye(3), torch.full((4, 4), NAN), -torch.eye(4), torch.ones(4, 4), [1, 2], object()],
                  "background": ["red", NAN, torch.ones(2), torch.ones(9, 8, 3), [NAN] * 3],
                  "max_size": COUNTS, "steps": COUNTS, "spp": COUNTS, "tolerance": [0.0, -1.0, NAN, "x", None],
                  "seed": [-1, 1.5, "x", None, True, 2**70], "fit_scale": ["yes", 1, None], "fit_focal": ["yes", 1, None],
                  "callback": [3, "print"]}),
    "profile": (eg.profile, {"scene": GOOD_MESH, "camera": GOOD_CAMERA, "spp": 1},
                {"repeats": COUNTS, "spp": COUNTS, "scene": [None, "x"], "camera": [None, "x"],
                 "adjoint": [*PICTURE[:1], *PICTURE[2:]]}),
    "background": (eg.Scene, {"meshes": [GOOD_MESH], "background": torch.ones(3)},
                   {"background": ["red", torch.ones(2), torch.full((3,), NAN), torch.ones(3).long(), 1.0,
                                   torch.ones(3).to_sparse()]}),
}  # fmt: skip
BAD_CALLS = [(helper, name, i) for helper, (*_, bad) in HELPERS.items() for name in bad for i in range(len(bad[name]))]


@pytest.mark.parametrize("helper", HELPERS)
def test_helpers_work_before_they_are_malformed(helper: str):
    function, good, _ = HELPERS[helper]
    if helper != "fit_pose":
        assert function(**good) is not None
    else:
        with pytest.raises(ValueError, match="init: expected a pose at which the picture changes"):
            function(**good | {"camera": GOOD_CAMERA.crop(500, 500, 8, 8), "init": torch.eye(4)})


@pytest.mark.parametrize("helper", HELPERS)
def test_helpers_refuse_and_name(helper: str):
    """Every bad value of every argument; of two at a time, in the properties below."""
    function, good, bad = HELPERS[helper]
    for name, values in bad.items():
        for value in values:
            names = {name, f"{name}[0]"}
            check_refused(lambda v=value, n=name: function(**{**good, n: v}), names, f"{helper} {name} {value!r}")


@st.composite
def helper_calls(draw: st.DrawFn) -> tuple[str, dict[str, Any]]:
    helper = draw(st.sampled_from(list(HELPERS)))
    bad = HELPERS[helper][2]
    names = draw(st.lists(st.sampled_from(list(bad)), min_size=1, max_size=3, unique=True))
    return helper, {name: draw(st.sampled_from(bad[name])) for name in names}


def helper_refuses(malformed: tuple[str, dict[str, Any]]) -> None:
    helper, bad = malformed
    function, good, _ = HELPERS[helper]
    check_refused(lambda: function(**{**good, **bad}), set(bad), f"{helper} {bad}")


# -- the runs -----------------------------------------------------------------------------------------------------

CHECKS = {
    "refuses": (refuses, malformed_cases(), 90, 2000),
    "same_bits": (same_bits, harmless_cases(), 60, 800),
    "helpers": (helper_refuses, helper_calls(), 40, 500),
}  # the property, its cases, and how many: in the fast suite with a fixed seed, and in the slow one


def run(name: str, examples: int, derandomize: bool) -> None:
    check, cases, *_ = CHECKS[name]
    ran = []

    @settings(max_examples=examples, deadline=None, derandomize=derandomize, database=None, print_blob=True,
              suppress_health_check=list(HealthCheck))  # fmt: skip
    @given(cases)
    def prop(case: Any) -> None:
        ran.append(case)
        check(case)

    prop()
    assert len(ran) >= examples


@pytest.mark.parametrize("name", CHECKS)
def test_properties(name: str):
    run(name, CHECKS[name][2], derandomize=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKS)
def test_properties_at_length(name: str):
    """3,300 cases, others in each run."""
    run(name, CHECKS[name][3], derandomize=False)


@pytest.mark.parametrize("thing", [GOOD_MESH, eg.Scene(GOOD_MESH), GOOD_CAMERA])
def test_replace_knows_its_fields(thing: Any):
    check_refused(lambda: thing.replace(vertices=1), {"replace"}, "")


def test_other_kinds_of_tensors():
    nested = torch.nested.nested_tensor([torch.rand(3, 3)])
    check_refused(lambda: eg.Mesh(nested, torch.tensor([[0, 1, 2]])), {"verts"}, "nested")
    for image in (torch.rand(4, 4).to("meta"), torch.rand(4, 4).to_sparse()):
        check_refused(lambda image=image: eg.write_image("never.png", image), {"img"}, image.layout)
    for count in (2**30, 2**40):  # of no memory, but more than 32 bits count
        check_refused(lambda n=count: eg.Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]).expand(n, 3)), {"faces"}, count)
        check_refused(lambda n=count: eg.Mesh(torch.zeros(1, 3).expand(4 * n, 3), [[0, 1, 2]]), {"faces"}, count)
    many = [eg.Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]).expand(2**25, 3))] * 22
    check_refused(lambda: eg.Scene(many), {"meshes"}, "together")


def test_the_properties_can_fail():
    """A check that names the wrong argument, raises something else, or lets a bad value pass, is found."""

    def raises(error: Exception) -> Callable[[], Iterator[None]]:
        def call() -> Iterator[None]:
            raise error

        return call

    check_refused(raises(ValueError("K: expected a, got b")), {"K"}, "")
    for wrong in (ValueError("K: expected a, got b"), ValueError("verts: no"), TypeError("x verts: expected a, got b")):
        with pytest.raises(AssertionError):
            check_refused(raises(wrong), {"verts"}, "")
    with pytest.raises(KeyError):
        check_refused(raises(KeyError("verts")), {"verts"}, "")
    with pytest.raises(AssertionError, match="nothing was raised"):
        check_refused(lambda: None, {"verts"}, "")
