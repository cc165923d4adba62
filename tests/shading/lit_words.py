"""Lit scenes that are made from words, and all their tensors by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.points.hits import Hits
from edgegrad.points.image_context import ImageContext

F64 = torch.float64
Leaves = dict[str, Tensor]


CAMERAS = {
    "perspective": eg.Camera.look_at((1.0, 1.5, 4.0), (0.0, 0.0, 0.0), fov_y=50.0, size=(24, 24)),
    "orthographic": eg.Camera.orthographic((1.0, 1.5, 4.0), (0.0, 0.0, 0.0), height=4.0, size=(24, 24)),
}
# Words: what the mesh has, what its material has, which lights there are.
SCENES = [
    "colors directional",
    "face_colors spot one_sided",
    "corner_colors harmonics point",
    "texture directional point",
    "normals point directional",
    "normals normal_map texture point",
    "normal_map directional",
    "microfacets point",
    "microfacets normals environment",
    "environment",
    "sky",
    "colors harmonics",
    "area",
    "area one_sided normals microfacets",
    "bulb microfacets",
    "base emission point",
    "nearest texture normal_map base point directional",
    "mipmap texture point",
    "mipmap texture normal_map normals microfacets base emission directional",
    "texture normal_map normals microfacets base emission point directional spot harmonics environment area",
]


def number(value: Any) -> Tensor:
    return torch.as_tensor(value, dtype=F64)


def numbers_of(words: str) -> Leaves:
    """All tensors of a scene by their names."""
    draw = torch.Generator().manual_seed(7)
    rand = lambda *shape: torch.rand(*shape, dtype=F64, generator=draw)  # noqa: E731
    finer = 5 if "mipmap" in words else 1
    ball = icosphere(2)
    verts = ball.verts.double()
    uvs = torch.stack([torch.atan2(verts[:, 0], verts[:, 2]) / 6.3 + 0.5, 0.5 * verts[:, 1] + 0.5], 1)
    V, F = len(verts), len(ball.faces)
    made: dict[str, Callable[[], Leaves]] = {
        "colors": lambda: {"colors": rand(V, 3)},
        "face_colors": lambda: {"face_colors": rand(F, 3)},
        "corner_colors": lambda: {"corner_colors": rand(F, 3, 3)},
        "texture": lambda: {"texture": rand(9 * finer, 14 * finer, 3), "uvs": uvs},
        "normals": lambda: {"normals": verts + 0.2 * (rand(V, 3) - 0.5)},
        "normal_map": lambda: {
            "uvs": uvs, "map": number([0.5, 0.5, 1.0]) + 0.2 * (rand(8, 8, 3) - 0.5), "map_factor": number([1.0, 0.9, 1.0]),
            "map_scale": number(0.7),
        },
        "microfacets": lambda: {"metallic": rand(V, 1), "roughness": number(0.4)},
        "base": lambda: {"base": rand(8 * finer, 8 * finer, 3), "base_uvs": 2 * uvs, "base_factor": rand(3)},
        "emission": lambda: {"emission": rand(3)},
        "point": lambda: {"point": number([2.0, 3.0, 1.0]), "point_power": number(20.0), "point_color": rand(3)},
        "directional": lambda: {"sun": number([0.5, -1.0, -0.3]), "sun_power": number(2.0)},
        "spot": lambda: {
            "spot": number([-2.0, 3.0, 1.0]), "spot_axis": number([2.0, -3.0, -1.0]), "spot_power": number(30.0),
            "spot_inner": number(0.2), "spot_outer": number(0.6),
        },
        "harmonics": lambda: {"harmonics": rand(9, 3), "harmonics_turn": torch.linalg.qr(rand(3, 3))[0]},
        "environment": lambda: {"environment": rand(8, 16, 3), "environment_turn": torch.linalg.qr(rand(3, 3))[0]},
        "sky": lambda: {"sky": rand(3)},
        "bulb": lambda: {"emitter": number([1.0, 2.0, 1.0]), "emitter_radiance": number([5.0, 4.0, 3.0])},
        "area": lambda: {"emitter": number([1.0, 3.0, 0.0]), "emitter_radiance": number([5.0, 4.0, 3.0])},
    }  # fmt: skip
    ground = number([[-3, -1.2, -3], [3, -1.2, -3], [3, -1.2, 3], [-3, -1.2, 3]])
    found: Leaves = {"verts": verts, "ground": ground, "ground_color": number([0.5, 0.6, 0.7])}
    for word in words.split():
        found |= made[word]() if word in made else {}
    return found


def scene_of(words: str, n: Leaves) -> eg.Scene:
    faces = icosphere(2).faces
    own: dict[str, Any] = {
        name: n[name] for name in ("colors", "face_colors", "corner_colors", "texture", "uvs", "normals") if name in n
    }
    if "uvs" in own:
        own["uv_faces"] = faces
    filter = next((kind for kind in ("nearest", "mipmap") if kind in words), "linear")
    material: dict[str, Any] = {name: n[name] for name in ("metallic", "roughness", "emission") if name in n}
    if "map" in n:
        material |= {
            "normal_map": eg.Texture(n["map"], filter=filter, factor=n["map_factor"]), "normal_scale": n["map_scale"]
        }  # fmt: skip
    if "base" in n:
        material["base_color"] = eg.Texture(
            n["base"], uvs=n["base_uvs"], uv_faces=faces, wrap=("mirror", "clamp"), factor=n["base_factor"],
            filter=filter,
        )  # fmt: skip
    if "texture" in own:
        own["filter"] = filter
    mesh = eg.Mesh(n["verts"], faces, material=eg.Material(two_sided="one_sided" not in words, **material), **own)
    ground = eg.Mesh(n["ground"], torch.tensor([[0, 2, 1], [0, 3, 2]]), material=eg.Material(n["ground_color"]))
    lights: list[Any] = []
    if "point" in n:
        lights.append(eg.lights.PointLight(n["point"], n["point_power"], n["point_color"]))
    if "sun" in n:
        lights.append(eg.lights.DirectionalLight(n["sun"], n["sun_power"]))
    if "spot" in n:
        angles = n["spot_inner"], n["spot_outer"]
        lights.append(eg.lights.SpotLight(n["spot"], n["spot_axis"], n["spot_power"], None, *angles))
    if "harmonics" in n:
        lights.append(eg.lights.SphericalHarmonics(n["harmonics"], n["harmonics_turn"]))
    if "environment" in n:
        lights.append(eg.lights.Environment(n["environment"], n["environment_turn"]))
    if "sky" in n:
        lights.append(eg.lights.Environment(n["sky"]))
    if "emitter" in n:
        if "bulb" in words:
            bulb = icosphere(1)
            bulb = eg.Mesh(0.7 * bulb.verts.double() + n["emitter"], bulb.faces)
            lights.append(bulb.replace(material=eg.Material(base_color=0.0, emission=n["emitter_radiance"])))
        else:
            u, v = number([0.5, 0.0, 0.0]), number([0.0, 0.1, 0.5])
            sides = "one_sided" not in words
            lights.append(
                eg.shapes.rectangle(
                    n["emitter"],
                    u,
                    v,
                    material=eg.Material(base_color=0.0, emission=n["emitter_radiance"], two_sided=sides),
                )
            )
    return eg.Scene([mesh, ground], lights=lights)


def hits_of(scene: eg.Scene, camera: eg.Camera) -> Hits:
    frame = ImageContext(scene, make_request(scene, camera, 2, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 40)
    seed = frame.seeds("image", len(found.face))
    return frame.moving_hits(found.face, frame.sampler.rays_at(found.x), found.x, seed)


def cotangents(radiance: Tensor, tensors: Leaves) -> tuple[Tensor, ...]:
    """Return the gradients of the radiance by the tensors, zeros where there are none, for one random cotangent."""
    bar = torch.randn(radiance.shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    loss = (radiance * bar).sum()
    return torch.autograd.grad(loss, list(tensors.values()), allow_unused=True, materialize_grads=True)
