"""Forward mode against reverse mode in lit scenes of all kinds: ⟨v, J u⟩ = ⟨Jᵀ v, u⟩ with the same samples."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from both_modes import check_both_modes
from combinations import diagonal
from lit_scenes import F64, ball, picture, plane, vector
from scenes import smooth_adjoint
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.quick

HEIGHT, WIDTH = 5, 6
ADJOINT = 1.5 + smooth_adjoint(HEIGHT, WIDTH, 3)
LIGHTS = ("point", "spot", "sun", "area", "emitter", "sky", "harmonics")
LENSES = ("pinhole", "distorted", "fisheye", "panorama", "orthographic")
ALPHA = ("opaque", "mask", "blend")
TEXTURES = ("none", "linear", "nearest", "mipmap", "normal map")


def camera(lens: str, eye: Tensor) -> eg.Camera:
    """Return a camera at `eye`, in front of the origin."""
    size = (HEIGHT, WIDTH)
    view = eg.Camera.look_at(eye, (0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov_y=45.0, size=size).to(F64)
    if lens == "orthographic":
        return eg.Camera.orthographic(eye, (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.4, size).to(F64)
    if lens == "distorted":
        return view.replace(distortion=vector(-0.1, 0.03, 0.01, -0.02))
    if lens in ("fisheye", "panorama"):
        focal = 1.2 * WIDTH if lens == "fisheye" else WIDTH / 2
        K = torch.tensor([[focal, 0.0, WIDTH / 2], [0.0, focal, HEIGHT / 2], [0.0, 0.0, 1.0]], dtype=F64)
        return eg.Camera(view.world_to_camera, K, size, lens)
    return view


def light(kind: str, place: Tensor, radiance: Tensor) -> Any:
    """At `place`, or from there, or from an image or coefficients that change with `radiance`."""
    if kind == "point":
        return eg.lights.PointLight(place, 30.0, color=radiance)
    if kind == "spot":
        return eg.lights.SpotLight(place, -place, 40.0, color=radiance, inner_angle=0.3)
    if kind == "sun":
        return eg.lights.DirectionalLight(-place, 2.0, color=radiance)
    if kind == "area":
        return eg.shapes.rectangle(
            place, vector(0.5, 0, 0), vector(0, 0.5, 0.1), material=eg.Material(base_color=0.0, emission=10 * radiance)
        )
    if kind == "emitter":
        emitter = ball(0, smooth=False)
        return emitter.replace(verts=place + 0.3 * emitter.verts, material=eg.Material(0.0, emission=9 * radiance))
    if kind == "sky":
        return eg.lights.Environment(picture() * radiance + 0.1 * place.square().sum())
    return eg.lights.SphericalHarmonics(
        (torch.linspace(0.8, 0.1, 9, dtype=F64)[:, None] + 0.1 * place.sum()) * radiance
    )


def material(texture: str, alpha: str, values: Tensor) -> dict[str, Any]:
    """The appearance of a mesh with texture coordinates, from a few numbers."""
    image = picture() * values[0]
    found: dict[str, Any] = {}
    color: Any = 0.3 + 0.4 * values[:3]
    if texture in ("linear", "nearest", "mipmap"):
        color = eg.Texture(image, filter=texture)
    mode = "BLEND" if alpha == "blend" else "MASK"
    own: dict[str, Any] = {"roughness": 0.5 * values[1], "alpha_mode": mode}
    if texture == "normal map":
        own |= {"normal_map": eg.Texture(vector(0.5, 0.5, 1.0) + 0.1 * image), "normal_scale": 0.6}
    found["material"] = eg.Material(color, **own)
    if alpha != "opaque":
        found["alpha"] = torch.tensor([[0.2, 0.8, 0.6], [0.8, 0.3, 0.7]], dtype=F64) * values[2]
    return found


def scene_of(kind: str, alpha: str, texture: str, verts: Tensor, place: Tensor, values: Tensor) -> eg.Scene:
    """A masked or blended sheet before a ball and a floor, with a light."""
    sheet = plane(0.9)
    sheet = sheet.replace(verts=verts, **material(texture, alpha, values))
    sphere = ball(0, material=eg.Material(values[:3] / 2, roughness=0.6)).transformed(
        scale=0.5, t=vector(0.3, 0.1, -0.9)
    )
    floor = plane(3.0, material=eg.Material(0.6)).transformed(t=vector(0, 0, -1.5))
    source = light(kind, place, values[:3])
    return eg.Scene([sheet, sphere, floor], lights=[source])


def equal_in_both_modes(kind: str, lens: str, alpha: str, texture: str, **options: Any) -> None:
    draw = torch.Generator().manual_seed(hash_of(kind, lens, alpha, texture))
    noise = torch.rand((12, 3), dtype=F64, generator=draw) - 0.5
    values = [plane(0.9).verts + 0.3 * noise[:4], vector(1.2, 1.5, 2.5) + noise[4], 0.9 + 0.2 * noise[5]]
    values.append(vector(0.4, 0.5, 3.0) + 0.2 * noise[6])
    tangents = [0.5 + noise[:4], noise[7], 0.6 + noise[8], noise[9]]

    def image(verts: Tensor, place: Tensor, numbers: Tensor, eye: Tensor) -> Tensor:
        return eg.render(scene_of(kind, alpha, texture, verts, place, numbers), camera(lens, eye), 4, seed=0, **options)

    gradients = check_both_modes(image, values, tangents, ADJOINT, rel=1e-5)  # levels of mipmaps are float32
    assert all(bool(g.any()) for g in gradients[:3])


def hash_of(*names: str) -> int:
    return sum((k + 1) * sum(map(ord, name)) for k, name in enumerate(names))


@pytest.mark.unwatched
@pytest.mark.parametrize(("kind", "lens", "alpha", "texture"), diagonal(LIGHTS, LENSES, ALPHA, TEXTURES))
def test_forward_mode_equals_reverse_mode(kind: str, lens: str, alpha: str, texture: str) -> None:
    equal_in_both_modes(kind, lens, alpha, texture)
