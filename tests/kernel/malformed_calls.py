"""Calls of render, plan and profile that are malformed in one or several places.

Each corruption says which arguments the message may name.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
from hypothesis import strategies as st
from torch import Tensor

import edgegrad as eg

F32, F64 = torch.float32, torch.float64
NAN, INF = math.nan, math.inf


APPEARANCES = ("plain", "colors", "face_colors", "corner_colors", "texture")
MESH = ("verts", "faces", "colors", "face_colors", "corner_colors", "texture", "uvs", "uv_faces")
CAMERA = ("world_to_camera", "K", "size", "projection")
FLOATS = (
    "verts", "colors", "face_colors", "corner_colors", "texture", "uvs", "background", "world_to_camera", "K"
)  # fmt: skip
ADJOINT = "the gradient of the image"


@dataclass
class Case:
    """The arguments of one call, and which of them are malformed: none where the call must work."""

    values: dict[str, Any]
    malformed: set[str] = field(default_factory=set)
    how: list[str] = field(default_factory=list)

    def corrupt(self, name: str, value: object, how: str, *also: str) -> None:
        self.values[name] = value
        self.malformed |= {name, *also}
        self.how.append(f"{name} {how}")


def good_case(draw: st.DrawFn) -> Case:
    """Return a cube of any appearance before any background, in any camera, with any options."""
    random = torch.Generator().manual_seed(draw(st.integers(0, 1000)))
    dtype, color_dtype = draw(st.sampled_from([F32, F64])), draw(st.sampled_from([F32, F64]))
    H, W, C = draw(st.integers(2, 6)), draw(st.integers(2, 6)), draw(st.integers(1, 4))
    corners = torch.cartesian_prod(*[torch.tensor([-0.6, 0.6], dtype=dtype)] * 3)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    faces = torch.tensor([[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)])

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=random, dtype=color_dtype)

    values: dict[str, Any] = {"verts": corners + 0.1 * rand(8, 3).to(dtype), "faces": faces}
    appearance = draw(st.sampled_from(APPEARANCES))
    if appearance == "texture":
        values |= {"texture": rand(3, 4, C), "uvs": 3 * rand(7, 2) - 1, "uv_faces": (faces * 5 + 3) % 7}
    elif appearance != "plain":
        values[appearance] = rand(*{"colors": (8, C), "face_colors": (12, C), "corner_colors": (12, 3, C)}[appearance])
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
        ("sampling.surface", st.sampled_from([None, 1, 30])),
        ("sampling.edges", st.sampled_from([None, 1, 30])),
        ("visibility", st.booleans()),
        ("filter", st.sampled_from(["box", "tent", "gaussian"])),
        ("sampling.seed", st.sampled_from([None, 0, 7])),
    ):
        values[name] = draw(choices)
    return Case(values)


def call(values: dict[str, Any], entry: str = "render") -> list[Tensor]:
    """Return the image and the gradients of all floating-point tensors that require one, of copies of the values."""
    mesh = eg.Mesh(**{name: value for name, value in values.items() if name in MESH})
    meshes = values.get("meshes", lambda mesh: [mesh])(mesh)
    scene = values.get("scene", eg.Scene)(meshes, values.get("background"))
    camera = values.get("camera", eg.Camera)(*(values[name] for name in CAMERA))
    done = (*MESH, *CAMERA, "background", "meshes", "scene", "camera", ADJOINT, "leaves")
    options = {name: value for name, value in values.items() if name not in done}
    own = [name for name in options if name.startswith("sampling.")]
    options["sampling"] = eg.Sampling(**{name.removeprefix("sampling."): options.pop(name) for name in own})
    if entry == "plan":
        return [torch.tensor(eg.plan(scene, camera, **options).samples)]
    if entry == "profile":
        found = eg.profile(scene, camera, repeats=1, **options)
        return [torch.tensor(found.samples["image_samples"])]
    image = eg.render(scene, camera, **{"seed": 0, **options})
    if not image.requires_grad:
        return [image]
    adjoint = values.get(ADJOINT, torch.linspace(-1, 1, image.numel(), dtype=image.dtype).reshape(image.shape))
    image.backward(adjoint)
    return [image.detach(), *(leaf.grad for leaf in values.get("leaves", []))]


# -- corruptions -----------------------------------------------------------------------------------------------------


def put(tensor: Tensor, at: int, value: float) -> Tensor:
    tensor = tensor.clone(memory_format=torch.contiguous_format)
    tensor.view(-1)[at % tensor.numel()] = value
    return tensor


def rest_of(name: str) -> list[str]:
    """Return other arguments whose check may come first where the size of one is wrong."""
    return {"verts": ["faces", "colors"], "uvs": ["uv_faces"], "texture": ["background", "meshes[1]"]}.get(name, [])


NO_TENSOR = ["text", object(), {"a": 1}, [[1.0, 2.0], [3.0]], [["a"]], 1j, [10**400], b"bytes", Ellipsis]


def corrupt_float(draw: st.DrawFn, case: Case) -> None:
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
    kinds: dict[str, Callable[[], object]] = {
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
    how = draw(st.sampled_from(list(kinds)))
    value = kinds[how]()
    also = rest_of(name) if how in ("is empty", "has fewer dimensions") else []
    case.corrupt(name, value, how, *also)


def corrupt_uv(draw: st.DrawFn, case: Case) -> None:
    if "uvs" in case.values and "uvs" not in case.malformed:
        case.corrupt(
            "uvs",
            put(case.values["uvs"], draw(st.integers(0, 100)), draw(st.sampled_from([2e9, -1e12, 1e30]))),
            "is far out",
        )


def corrupt_index(draw: st.DrawFn, case: Case) -> None:
    name = draw(st.sampled_from([name for name in ("faces", "uv_faces") if name in case.values]))
    index, at = case.values[name], draw(st.integers(0, 35))
    if name in case.malformed:
        return
    rows = 8 if name == "faces" else 7
    beyond = st.sampled_from([-1, -rows, -(2**31), -(2**63), rows, 255, 2**31 - 1, 2**31, 2**32, 2**40, 2**63 - 1])
    kinds: dict[str, Callable[[], object]] = {
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
    how = draw(st.sampled_from(list(kinds)))
    # There are as many colours of faces as faces.
    also = ("face_colors", "corner_colors", "uv_faces") if how in ("is long",) else ()
    case.corrupt(name, kinds[how](), how, *also)


def corrupt_camera(draw: st.DrawFn, case: Case) -> None:
    M, K = case.values["world_to_camera"], case.values["K"]
    if case.malformed & {"world_to_camera", "K"}:
        return
    linear = torch.eye(4).to(M)
    kinds: dict[str, tuple[str, Callable[[], object]]] = {
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
    how = draw(st.sampled_from(list(kinds)))
    name, value = kinds[how]
    if how == "is of another batch" and M.dim() == 2:
        return  # then there is no other
    case.corrupt(name, value(), how)


BAD_INTS = [-1, -(2**63), 2**63, 10**30, 1.5, 2.0, NAN, "4", True, [4], torch.tensor([1, 2]), 1j]
BAD_OPTIONS: dict[str, list[object]] = {
    "spp": [*BAD_INTS, 0, None, 2**20 + 1],
    "seed": BAD_INTS,
    "sampling.seed": BAD_INTS,
    "sampling.surface": [*BAD_INTS, 0, 2**41],
    "sampling.edges": [*BAD_INTS, 0, 2**41],
    "visibility": [0, 1, "yes", None, torch.tensor(True)],
    "filter": ["sinc", "", None, 3, b"box", [], ("box",)],
    "size": [(0, 4), (-1, 4), (4, 0), (4,), (4, 4, 4), 4, None, "ab", (4.0, 4), (4, 2**17), (2**70, 4), (True, 4), (None, 4)],
    "projection": ["pinhole", None, 3, "Perspective", b"perspective"],
}  # fmt: skip


def corrupt_option(draw: st.DrawFn, case: Case) -> None:
    name = draw(st.sampled_from(list(BAD_OPTIONS)))
    bad = draw(st.sampled_from(BAD_OPTIONS[name]))
    case.corrupt(name, bad, f"is {bad!r}")


def corrupt_objects(draw: st.DrawFn, case: Case) -> None:
    other = eg.Mesh(torch.rand(3, 3), torch.tensor([[0, 1, 2]]), colors=torch.rand(3, 7))
    kinds: dict[str, tuple[str, object, list[str]]] = {
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
        "is a list": ("scene", lambda mesh, *_: [mesh], []),
        "is a matrix": ("camera", lambda pose, *_: pose, []),
        "is nowhere": ("camera", lambda *_: None, []),
    }  # fmt: skip
    how = draw(st.sampled_from(list(kinds)))
    name, value, also = kinds[how]
    case.corrupt(name, value, how, *also)


def corrupt_adjoint(draw: st.DrawFn, case: Case) -> None:
    """Corrupt the adjoint, which only a backward pass meets."""
    values = case.values
    if case.malformed:
        return
    appearances = [values[n] for n in (*APPEARANCES, "background") if n in values]
    dtype = (
        F64 if any(t.dtype == F64 for t in appearances) or (not appearances and values["verts"].dtype == F64) else F32
    )
    C = next((values[n].shape[-1] for n in (*APPEARANCES, "background") if n in values), 3)
    batch = [] if values["world_to_camera"].dim() == 2 else [len(values["world_to_camera"])]
    number = draw(st.sampled_from([NAN, INF, -INF] + [1e39, -1e200] * (dtype == F64)))
    ones = torch.ones([*batch, *values["size"], C], dtype=dtype)
    values["verts"] = values["verts"].clone().requires_grad_()
    case.corrupt(ADJOINT, put(ones, draw(st.integers(0, 10**6)), number), f"holds {number}")


CORRUPTIONS = [
    corrupt_float, corrupt_float, corrupt_uv, corrupt_index, corrupt_camera, corrupt_option, corrupt_objects, corrupt_adjoint
]  # fmt: skip


@st.composite
def malformed_cases(draw: st.DrawFn) -> tuple[Case, str]:
    case = good_case(draw)
    if draw(st.booleans()):
        case.values["verts"].requires_grad_()
    for corruption in draw(st.lists(st.sampled_from(CORRUPTIONS), min_size=1, max_size=3)):
        corruption(draw, case)
    return case, "render" if ADJOINT in case.malformed else draw(
        st.sampled_from(["render", "render", "plan", "profile"])
    )


def check_refused(run: Callable[[], object], names: set[str], how: object) -> None:
    """Assert a TypeError or a ValueError that starts with one of the names and says what was expected and what came."""
    try:
        run()
    except (TypeError, ValueError) as error:
        message = str(error)
        assert any(message.startswith(f"{name}:") for name in names), f"{how}: {message}"
        assert "expected" in message and "got" in message, f"{how}: {message}"
    else:
        raise AssertionError(f"{how}: nothing was raised")
