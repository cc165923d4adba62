"""Alpha edges, and lines along which faces pass through each other, on the way of light from one surface to another: in
render(bounces=n), against exact derivatives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from bounce_scenes import QUAD
from strip_oracle import Strip, border, sent_from_line
from test_secondary_edge_points import MATERIALS, alone, weights_of
from threads import check_threads
from torch import Tensor

import edgegrad as eg
from edgegrad.light import secondary_edges

pytestmark = pytest.mark.watched

F64 = torch.float64
Leaves = dict[str, Tensor]
BLACK = eg.Material(torch.zeros(3, dtype=F64))
CUTOFF = 0.5
NARROW = Strip.standard().camera
# It sees much of the receiver, so that much light that is reflected there comes to it.
WIDE = eg.Camera.look_at(torch.tensor([0.0, 0.1, 0.4], dtype=F64), (1.0, 0.0, 0.1), (0.0, 1.0, 0.0), 95.0, (6, 8))

__all__ = ["alone"]


class Border(NamedTuple):
    """Tensors, and as functions of them a scene and what hides the reflector from the receiver there, as a polygon."""

    leaves: Leaves
    scene: Callable[[Leaves], eg.Scene]
    strip: Callable[[Leaves], Strip]
    camera: eg.Camera


def gradients_of(found: Border, samples: int, bounces: int = 2) -> tuple[Tensor, ...]:
    """Return the gradients of the weighted image by all tensors."""
    weights = weights_of(Strip.standard())
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in found.leaves.items()}
    options: dict[str, Any] = {"shadows": False, "bounces": bounces, "sampling": eg.Sampling(edges=samples, surface=1)}
    image = eg.render(found.scene(leaves), found.camera, 1, 0, **options)
    return torch.autograd.grad((weights.to(image) * image).sum(), list(leaves.values()))


def check(found: Border, materials: tuple[str, str], samples: int, side: int | None = None) -> None:
    """Gradients by all tensors in MOST, along the exact ones, and as a whole; of one side of the polygon, or of all."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in found.leaves.items()}
    value = border(
        found.strip(leaves), MATERIALS[materials[0]], MATERIALS[materials[1]], weights_of(Strip.standard()), side=side
    )
    expected = torch.autograd.grad(value, list(leaves.values()))
    for name, a, b in zip(leaves, gradients_of(found, samples), expected, strict=True):
        if name not in MOST:
            continue
        ratio, error = float((a * b).sum() / (b * b).sum()), float((a - b).norm() / b.norm())
        assert abs(ratio - 1) < MOST[name] and error < 2 * MOST[name], (name, ratio, error)


def two_faces(leaves: Leaves, materials: tuple[str, str]) -> list[eg.Mesh]:
    one = torch.tensor([[0, 1, 2]])
    return [
        eg.Mesh(leaves[name], one, material=eg.Material(**MATERIALS[material]))
        for name, material in zip(("receiver", "reflector"), materials, strict=True)
    ]


def standard(**more: Tensor) -> Leaves:
    strip = Strip.standard()
    return {"receiver": strip.receiver, "reflector": strip.reflector, **more}


def seen(leaves: Leaves, corners: Tensor, camera: eg.Camera) -> Strip:
    strip = Strip.standard()
    return strip._replace(receiver=leaves["receiver"], reflector=leaves["reflector"], strip=corners, camera=camera)


def lit(meshes: list[eg.Mesh]) -> eg.Scene:
    return eg.Scene(meshes, lights=[eg.lights.PointLight(Strip.standard().light, 4.0)])


def masked_sheet(materials: tuple[str, str]) -> Border:
    """A sheet of two triangles of which alpha, a ramp up and one down, leaves a strip between straight alpha edges. `uv` scales
    and moves the texture."""
    o, e1, e2 = (torch.tensor(x, dtype=F64) for x in ([0.1, -0.6, -0.25], [0.1, 1.1, 0.05], [-0.1, 0.1, 0.5]))
    at = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=F64)
    leaves = standard(
        sheet=o + at[:, :1] * e1 + at[:, 1:] * e2,
        alpha=torch.tensor([0.1, 0.9, 1.0, 0.2], dtype=F64),
        uv=torch.tensor([1.0, 0.02], dtype=F64),
    )

    def scene(leaves: Leaves) -> eg.Scene:
        scale, shift = leaves["uv"]
        uvs = torch.stack([scale * at[:, 0] + shift, at[:, 1]], 1)
        alpha = leaves["alpha"][None, :]
        sheet = eg.Mesh(
            leaves["sheet"],
            torch.tensor(QUAD),
            uvs=uvs,
            uv_faces=torch.tensor(QUAD),
            alpha=alpha,
            wrap="clamp",
            material=BLACK,
        )
        return lit([*two_faces(leaves, materials), sheet])

    def strip(leaves: Leaves) -> Strip:
        a, (scale, shift), v = leaves["alpha"], leaves["uv"], leaves["sheet"]
        left = (0.125 + 0.25 * (CUTOFF - a[0]) / (a[1] - a[0]) - shift) / scale
        right = (0.625 + 0.25 * (a[2] - CUTOFF) / (a[2] - a[3]) - shift) / scale
        near, far, diagonal = ((lambda u, k=k, m=m: v[k] + u * (v[m] - v[k])) for k, m in ((0, 1), (3, 2), (0, 2)))
        corners = near(left), near(right), diagonal(right), far(right), far(left), diagonal(left)
        return seen(leaves, torch.stack(corners), NARROW)

    return Border(leaves, scene, strip, NARROW)


def blade_through_reflector(materials: tuple[str, str], camera: eg.Camera = NARROW) -> Border:
    """A triangle that is stuck through the reflector: what of it stands before that hides a part."""
    blade = torch.tensor([[-0.5, 0.8, 0.2], [-1.4, -0.7, 0.5], [-1.4, -0.5, -0.6]], dtype=F64)

    def strip(leaves: Leaves) -> Strip:
        tip, *rest = leaves["blade"]
        q = leaves["reflector"]
        normal = torch.linalg.cross(q[1] - q[0], q[2] - q[0])
        own, *heights = (normal @ (p - q[0]) for p in (tip, *rest))
        through = [tip + own / (own - h) * (p - tip) for h, p in zip(heights, rest, strict=True)]
        return seen(leaves, torch.stack([tip, *through]), camera)

    def scene(leaves: Leaves) -> eg.Scene:
        return lit([*two_faces(leaves, materials), eg.Mesh(leaves["blade"], torch.tensor([[0, 1, 2]]), material=BLACK)])

    return Border(standard(blade=blade), scene, strip, camera)


# How far off gradients may be, along the exact ones. By the receiver, which the blade hides a little, it is a hundredth of the
# others and as noisy.
MOST = {"reflector": 0.03, "sheet": 0.03, "alpha": 0.03, "uv": 0.03, "blade": 0.03}


@pytest.mark.unwatched
@pytest.mark.usefixtures("alone")
def test_alpha_edges_and_borders_of_a_sheet() -> None:
    check(masked_sheet(("glossy", "lambert")), ("glossy", "lambert"), 800_000)


@pytest.mark.slow
@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize(
    ("make", "materials"),
    [
        (masked_sheet, ("lambert", "glossy")),
        (blade_through_reflector, ("lambert", "lambert")),
        (blade_through_reflector, ("glossy", "lambert")),
        (blade_through_reflector, ("lambert", "glossy")),
    ],
)
def test_whole_borders(make: Callable[[tuple[str, str]], Border], materials: tuple[str, str]) -> None:
    check(make(materials), materials, 8_000_000)


@pytest.mark.unwatched
@pytest.mark.usefixtures("alone")
def test_intersection_with_the_reflector(monkeypatch: pytest.MonkeyPatch) -> None:
    """The blade passes through the reflector, and its edges are left out."""
    monkeypatch.setattr(secondary_edges, "_seen", lambda *_: [])
    check(blade_through_reflector(("lambert", "glossy"), WIDE), ("lambert", "glossy"), 400_000, side=1)


@pytest.mark.usefixtures("alone")
@pytest.mark.parametrize("make", [masked_sheet, blade_through_reflector])
def test_same_bits_at_any_number_of_threads(make: Callable[[tuple[str, str]], Border]) -> None:
    check_threads(lambda: gradients_of(make(("lambert", "lambert")), 20_000, bounces=3))


@pytest.mark.unwatched
@pytest.mark.usefixtures("alone")
def test_alpha_edge_of_the_reflector() -> None:
    """The reflector itself is masked where its texture coordinates, its last two barycentrics, are small."""
    strip, weights = Strip.standard()._replace(camera=WIDE), weights_of(Strip.standard())
    at = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], dtype=F64)
    alpha = torch.tensor([0.1, 0.2, 0.8, 1.0], dtype=F64).requires_grad_()
    uv = torch.tensor([1.0, 0.02], dtype=F64).requires_grad_()
    edge = (0.375 + 0.25 * (CUTOFF - alpha[1]) / (alpha[2] - alpha[1]) - uv[1]) / uv[0]
    ends = torch.stack([edge, 0 * edge]), torch.stack([edge, 1 - edge])
    sent = sent_from_line(strip, *(end.detach() for end in ends), MATERIALS["glossy"], MATERIALS["glossy"], weights)
    expected = torch.autograd.grad(-edge * sent, (alpha, uv))
    receiver, reflector = two_faces(standard(), ("glossy", "glossy"))
    uvs = torch.stack([uv[0] * at[:, 0] + uv[1], at[:, 1]], 1)
    scene = lit([receiver, reflector.replace(uvs=uvs, uv_faces=reflector.faces, alpha=alpha[None, :], wrap="clamp")])
    image = eg.render(
        scene, strip.camera, 1, 0, shadows=False, bounces=2, sampling=eg.Sampling(edges=400_000, surface=1)
    )
    found = torch.autograd.grad((weights.to(image) * image).sum(), (alpha, uv))
    for a, b in zip(found, expected, strict=True):
        assert float((a - b).norm() / b.norm()) < 0.02, (a, b)
