"""Two properties of the checks of arguments.

An argument that is malformed in any way is refused with a message that names it. An argument that is merely stored in another
way gives the same bits of the image and of the gradients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from malformed_calls import BAD_OPTIONS, F64, FLOATS, INF, NAN, Case, call, check_refused, good_case, malformed_cases
from quiet_fits import arranged
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import fit_pose


def refuses(malformed: tuple[Case, str]) -> None:
    case, entry = malformed
    if case.malformed:
        check_refused(lambda: call(case.values, entry), case.malformed, case.how)
    else:
        call(case.values, entry)


# -- harmless ways to store numbers ---------------------------------------------------------------------------------


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
    "fit_pose": (lambda **given: fit_pose(**arranged(**given)),
                 {"mesh": GOOD_MESH, "images": torch.rand(8, 8, 3), "cameras": GOOD_CAMERA, "steps": 1, "spp": 1, "max_size": 8},
                 {"mesh": ["text", None, torch.eye(3)], "images": PICTURE, "cameras": ["text", None, torch.eye(4)],
                  "masks": [bad for bad in PICTURE if bad is not None] + [torch.rand(8, 8, 3)],
                  "init": ["text", torch.eye(3), torch.full((4, 4), NAN), -torch.eye(4), torch.ones(4, 4), [1, 2], object()],
                  **{name: [bad for bad in COUNTS if bad is not None] for name in ("max_size", "steps", "spp")},
                  "step_tolerance": [0.0, -1.0, NAN, "x"], "seed": [-1, 1.5, "x", True, 2**70], "scale": ["yes", 1, None],
                  "focal": ["yes", 1, None], "search": ["all", 1, -2, None, 2.5], "callback": [3, "print"]}),
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
            function(**good | {"cameras": GOOD_CAMERA.crop(500, 500, 8, 8), "init": torch.eye(4)})


@pytest.mark.parametrize("helper", HELPERS)
def test_helpers_refuse_and_name(helper: str):
    """Every bad value of every argument; of two at a time, in the properties below."""
    function, good, bad = HELPERS[helper]
    for name, values in bad.items():
        for value in values:
            names = {name, f"{name}[0]", f"options.{name}"}
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
    check_refused(lambda: function(**{**good, **bad}), {*bad, *(f"options.{n}" for n in bad)}, f"{helper} {bad}")


# -- the runs -----------------------------------------------------------------------------------------------------

CHECKS = {
    "refuses": (refuses, malformed_cases(), 60, 2000),
    "same_bits": (same_bits, harmless_cases(), 40, 800),
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
