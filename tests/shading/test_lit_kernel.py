"""The kernel's shading of lit scenes against the same in PyTorch: values, cotangents of all tensors, tangents."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch
from combinations import diagonal
from oracles import shading
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.derivatives import transformed
from edgegrad.kernel.first_order import unreached
from edgegrad.kernel.request import make_request
from edgegrad.light import creases, in_kernel, radiance
from edgegrad.points import discontinuous_pixels
from edgegrad.points.hits import Hits
from edgegrad.points.image_context import ImageContext
from edgegrad.points.shadow_rays import Forced
from edgegrad.scene.lights import LightPoints

pytestmark = pytest.mark.watched

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
    looks: dict[str, Any] = {name: n[name] for name in ("metallic", "roughness", "emission") if name in n}
    if "map" in n:
        looks |= {
            "normal_map": eg.Texture(n["map"], filter=filter, factor=n["map_factor"]), "normal_scale": n["map_scale"]
        }  # fmt: skip
    if "base" in n:
        looks["base_color"] = eg.Texture(
            n["base"], uvs=n["base_uvs"], uv_faces=faces, wrap=("mirror", "clamp"), factor=n["base_factor"],
            filter=filter,
        )  # fmt: skip
    if "texture" in own:
        own["filter"] = filter
    mesh = eg.Mesh(n["verts"], faces, material=eg.Material(two_sided="one_sided" not in words, **looks), **own)
    ground = eg.Mesh(n["ground"], torch.tensor([[0, 2, 1], [0, 3, 2]]), material=eg.Material(n["ground_color"]))
    lights: list[Any] = []
    if "point" in n:
        lights.append(eg.PointLight(n["point"], n["point_power"], n["point_color"]))
    if "sun" in n:
        lights.append(eg.DirectionalLight(n["sun"], n["sun_power"]))
    if "spot" in n:
        angles = n["spot_inner"], n["spot_outer"]
        lights.append(eg.SpotLight(n["spot"], n["spot_axis"], n["spot_power"], None, *angles))
    if "harmonics" in n:
        lights.append(eg.SphericalHarmonics(n["harmonics"], n["harmonics_turn"]))
    if "environment" in n:
        lights.append(eg.Environment(n["environment"], n["environment_turn"]))
    if "sky" in n:
        lights.append(eg.Environment(n["sky"]))
    if "emitter" in n:
        if "bulb" in words:
            bulb = icosphere(1)
            bulb = eg.Mesh(0.7 * bulb.verts.double() + n["emitter"], bulb.faces)
            lights.append(eg.AreaLight.of(bulb, n["emitter_radiance"]))
        else:
            u, v = number([0.5, 0.0, 0.0]), number([0.0, 0.1, 0.5])
            sides = "one_sided" not in words
            lights.append(eg.AreaLight.rectangle(n["emitter"], u, v, n["emitter_radiance"], two_sided=sides))
    return eg.Scene([mesh, ground], lights=lights)


def hits_of(scene: eg.Scene, camera: eg.Camera) -> Hits:
    frame = ImageContext(scene, make_request(scene, camera, 2, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 40)
    seed = frame.seeds("image", len(found.face))
    return frame.moving_hits(found.face, frame.sampler.rays_at(found.x), found.x, seed)


def both(words: str, view: str, samples: int, leaves: Leaves, w2c: Tensor) -> tuple[Hits, Hits, Tensor, Tensor]:
    hits = [hits_of(scene_of(words, leaves), CAMERAS[view].replace(world_to_camera=w2c)) for _ in range(2)]
    return hits[0], hits[1], shading.reference(hits[0], True, samples), in_kernel.radiance(hits[1], True, samples)


@pytest.mark.parametrize("view", CAMERAS)
@pytest.mark.parametrize("words", SCENES)
def test_values_and_cotangents(words: str, view: str) -> None:
    leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
    w2c = CAMERAS[view].world_to_camera.double().clone().requires_grad_()
    hits, found, expected, radiance = both(words, view, 2, leaves, w2c)
    assert len(hits) > 200 and float(expected.detach().abs().max()) > 0.05
    assert torch.allclose(radiance, expected, rtol=1e-12, atol=1e-12)
    asked = [light for light in hits._lit if light in found._lit]
    assert all(torch.equal(hits._lit[k], found._lit[k]) for k in asked)
    assert hits._surfaces.shadowing == found._surfaces.shadowing
    bar = torch.randn(expected.shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    tensors = {**leaves, "w2c": w2c}
    wanted, got = (
        torch.autograd.grad((L * bar).sum(), list(tensors.values()), allow_unused=True, materialize_grads=True)
        for L in (expected, radiance)
    )
    for name, a, b in zip(tensors, wanted, got, strict=True):
        # Where one light comes from all around and nothing is interpolated, place and view do not matter.
        # Nor do coordinates within a texel.
        still = ("uvs", "base_uvs") if "nearest" in words else ()
        assert float(a.abs().max()) > 0 or name in ("verts", "ground", "w2c", *still), name
        assert float((a - b).abs().max()) <= 1e-9 * float(a.abs().max()), name


@pytest.mark.parametrize("grey", [0.5, 128 / 255, 127 / 255], ids=["half", "128", "127"])
@pytest.mark.parametrize("noise", [0.0, 1e-15])
def test_a_grey_normal_map_does_not_bend(grey: float, noise: float) -> None:
    """As without the map, by the kernel and by PyTorch, and so are derivatives, which rounding would make as large as 1e15."""
    words, found = "normals normal_map microfacets point", []
    draw = torch.Generator().manual_seed(5)
    image = grey + noise * (torch.rand(8, 8, 3, dtype=F64, generator=draw) - 0.5)
    for mapped in (True, False):
        numbers = numbers_of(words) | ({"map": image, "map_factor": number(1.0)} if mapped else {})
        leaves = {
            name: value.clone().requires_grad_() for name, value in numbers.items() if mapped or "map" not in name
        }
        hits = [hits_of(scene_of(words, leaves), CAMERAS["perspective"]) for _ in range(2)]
        for own, shade in zip(hits, (in_kernel.radiance, shading.reference), strict=True):
            L = shade(own, True, 1)
            grads = torch.autograd.grad(L.sum(), list(leaves.values()), materialize_grads=True)
            found.append({"": L, **dict(zip(leaves, grads, strict=True))})
    *those_mapped, kernels, twins = found
    for one, without in zip(those_mapped, (kernels, twins), strict=True):
        assert all(float(one.pop(name).abs().max()) == 0 for name in ("map", "map_factor", "map_scale"))
        assert all(torch.allclose(one[name], without[name], rtol=1e-9, atol=1e-9) for name in without)
    assert float(kernels["normals"].abs().max()) > 0.1


@pytest.mark.parametrize("words", SCENES)
def test_tangents_are_cotangents(words: str) -> None:
    leaves = numbers_of(words)
    w2c = CAMERAS["perspective"].world_to_camera.double()
    draw = torch.Generator().manual_seed(3)
    values = {**leaves, "w2c": w2c}
    tangents = {name: torch.randn(v.shape, dtype=F64, generator=draw) for name, v in values.items()}

    def radiance(given: Leaves) -> Tensor:
        scene = scene_of(words, {name: v for name, v in given.items() if name != "w2c"})
        return in_kernel.radiance(hits_of(scene, CAMERAS["perspective"].replace(world_to_camera=given["w2c"])), True, 1)

    found, moved = torch.func.jvp(radiance, (values,), (tangents,))[:2]
    assert not transformed()
    bar = torch.randn(found.shape, dtype=F64, generator=draw)
    (grads,) = torch.func.vjp(radiance, values)[1](bar)
    forward = float((bar * moved).sum())
    reverse = sum(float((grads[name] * tangents[name]).sum()) for name in values)
    size = sum(float((grads[name] * tangents[name]).abs().sum()) for name in values)
    assert abs(forward - reverse) < 1e-10 * size


def test_points_of_a_light_that_are_given() -> None:
    leaves = numbers_of("area environment point")
    scene = scene_of("area environment point", leaves)
    for light in range(3):
        hits = hits_of(scene, CAMERAS["perspective"])
        n = len(hits)
        points = scene.casting[light].draw(torch.rand(n, 3, dtype=F64, generator=torch.Generator().manual_seed(2)))
        lit = (torch.arange(n) % 2).double()
        forced = Forced(light, LightPoints(*points), lit, torch.ones(n, dtype=torch.bool))
        found = []
        for shade in (shading.reference, in_kernel.radiance):
            given = Hits(
                hits._surfaces, hits._view, hits._face, hits._exact, hits._pixel, seed=hits._seed, forced=forced
            )
            found.append(shade(given, True, 1))
        assert torch.allclose(*found, rtol=1e-12, atol=1e-12)


def test_what_one_light_adds() -> None:
    """Values and derivatives are those with the light less those in its shadow."""
    words = SCENES[-1].replace("microfacets ", "") + " area"
    for light in (0, 2, 4):
        of = []
        for lit, only in ((1, False), (0, False), (1, True)):
            leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
            scene = scene_of(words, leaves)
            hits = hits_of(scene, CAMERAS["perspective"])
            n = len(hits)
            points = scene.casting[light].draw(torch.rand(n, 3, dtype=F64, generator=torch.Generator().manual_seed(2)))
            forced = Forced(light, points, torch.full((n,), lit, dtype=F64), torch.ones(n, dtype=torch.bool), only)
            place = hits._face, hits._exact, hits._pixel
            given = [Hits(hits._surfaces, hits._view, *place, seed=hits._seed, forced=forced) for _ in range(2)]
            L = in_kernel.radiance(given[0], True, 2)
            assert torch.allclose(shading.reference(given[1], True, 2), L, rtol=1e-12, atol=1e-12)
            of.append([L, *torch.autograd.grad(L.sum(), list(leaves.values()), materialize_grads=True)])
        for with_light, without, alone in zip(*of, strict=True):
            assert torch.allclose(
                with_light - without, alone, rtol=1e-9, atol=1e-9 * float(with_light.detach().abs().max())
            )
        assert float(of[2][0].detach().abs().max()) > 0.01


def test_borders_of_shadows_by_what_the_light_adds() -> None:
    """As by the radiance on both sides of the boundary, as far off it as the kernel takes them, some 1e-4 px. Any other shader is
    asked there."""
    leaves = {
        name: value.clone().requires_grad_() for name, value in numbers_of("normals point area sky colors").items()
    }
    scene = scene_of("normals point area sky colors emission", {**leaves, "emission": torch.ones(3)})
    camera, found = CAMERAS["perspective"], []
    weights = torch.rand(24, 24, 3, generator=torch.Generator().manual_seed(1))
    for shader in (None, lambda hits: radiance.radiance(hits, True, 1)):
        image = eg.render(scene, camera, spp=4, shader=shader, edge_samples=4000)
        found.append(torch.autograd.grad((weights * image).sum(), [leaves["verts"], leaves["point"]]))
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm()) < 1e-4 * float(a.norm()) > 0


def test_borders_of_shadows_of_what_is_looked_up_nearest() -> None:
    """What emits is left out of what a light adds, and its nearest texels with it: as one texel, looked up linearly."""
    found = []
    for filter in ("nearest", "linear"):
        leaves = {name: value.clone().requires_grad_() for name, value in numbers_of("normals point").items()}
        scene = scene_of("normals point", leaves)
        uvs, faces = torch.eye(3)[:, :2], torch.arange(3).expand(len(scene.meshes[0].faces), 3)
        glow = eg.Texture(torch.full((1, 1, 3), 0.3, dtype=F64), uvs, faces, filter=filter)
        glowing = scene.meshes[0].replace(material=eg.Material(emission=glow))
        image = eg.render(scene.replace(meshes=[glowing, scene.meshes[1]]), CAMERAS["perspective"], spp=4)
        found.append(torch.autograd.grad(image.sum(), [leaves["verts"], leaves["point"]]))
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm()) < 1e-5 * float(a.norm()) > 0


AROUND = {
    **CAMERAS,
    "panorama": eg.Camera.panorama(CAMERAS["perspective"].world_to_camera.double(), (48, 24)),
}


@pytest.mark.parametrize(
    ("words", "view"),
    diagonal(
        [
            "colors directional point spot",
            "normals area point",
            "environment",
            "base emission harmonics",
            "nearest texture point spot",
            "mipmap texture base point",
        ],
        list(AROUND),
    ),
)
def test_images_as_a_whole(words: str, view: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As from hits that are shaded one by one, with the pixels that borders of shadows and texels run through shaded again."""
    leaves = numbers_of(words)
    camera = AROUND[view].replace(world_to_camera=AROUND[view].world_to_camera.double())
    plain = scene_of(words, leaves)
    pictured, again, kept = (
        plain.replace(background=torch.rand(*camera.size, 3).double()),
        [],
        discontinuous_pixels.DiscontinuousPixels.found,
    )
    for scene, options in (
        (pictured, {"spp": 7, "seed": 5}),
        (plain, {"spp": 1}),
        (plain, {"light_samples": 3, "filter": "tent", "spp": 4}),
        (pictured, {"shadows": False, "spp": 4}),
    ):
        found = []
        for whole in (True, False):
            with monkeypatch.context() as patch:
                if not whole:
                    patch.setattr(radiance, "_kernel_image", lambda *arguments: None)
                    if "nearest" in words:  # whose borders only PyTorch tells
                        patch.setattr(radiance, "is_fused", lambda scene: False)
                    keep = lambda self: (again.append(found := kept(self)), found)[1]  # noqa: E731
                    patch.setattr(discontinuous_pixels.DiscontinuousPixels, "found", keep)
                found.append(eg.render(scene, camera, **options))
        assert float(found[0].max()) > 0.1
        assert float((found[0] - found[1]).abs().max()) <= 1e-12 * float(found[0].abs().max())
    assert ("point" not in words) or any(int(pixels.sum()) > 10 for pixels, _ in again)


def test_the_same_whole_image_on_any_number_of_threads() -> None:
    scene, before, found = scene_of(SCENES[-1], numbers_of(SCENES[-1])), torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            found.append(eg.render(scene, CAMERAS["perspective"].resized((64, 64)), spp=4))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(*found)


def test_radiance_that_is_not_finite_is_named() -> None:
    light = eg.PointLight(torch.tensor([0.0, 0.0, 3.0]), 1e25, torch.full((3,), 1e25))
    ball = icosphere(2)
    scene = eg.Scene([eg.Mesh(ball.verts.float(), ball.faces, material=eg.Material())], lights=[light])
    with pytest.raises(ValueError, match=r"expected finite numbers, got .*inf"):
        eg.render(scene, CAMERAS["perspective"])


def test_tensors_from_which_no_graph_leads_to_a_result() -> None:
    """Of two outputs of one operation it may be the other that does."""
    leaf, other = (torch.ones(4, 2, requires_grad=True) for _ in range(2))
    used, unused = (2 * leaf).unbind(1)
    left = unreached(3 * used, [used, unused, leaf, other, torch.ones(2)])
    assert [id(tensor) for tensor in left] == [id(unused), id(other)]


def test_all_tensors_get_gradients_though_the_image_depends_on_few() -> None:
    """Zeros of those that it does not depend on: alpha that cuts nothing out, a light that is behind, the lens."""
    ball = icosphere(1)
    alpha = torch.ones(2, 2, requires_grad=True)
    emitter = eg.SpotLight(*(torch.tensor(v, requires_grad=True) for v in ([0.0, 0.0, 9.0], [0.0, 0.0, 1.0])), 3.0)
    distortion = torch.zeros(8, requires_grad=True)
    mesh = eg.Mesh(
        ball.verts.float().requires_grad_(), ball.faces, uvs=torch.rand(len(ball.verts), 2), uv_faces=ball.faces,
        material=eg.Material(), alpha=alpha,
    )  # fmt: skip
    camera = CAMERAS["perspective"].replace(distortion=distortion)
    sun = eg.DirectionalLight(torch.tensor([-0.2, -0.5, -1.0]), 2.0)
    image = eg.render(eg.Scene([mesh], lights=[sun, emitter]), camera, 4)
    leaves = [mesh.verts, alpha, emitter.position, emitter.direction, distortion]
    found = torch.autograd.grad(image.sum(), leaves)
    assert all(bool(torch.isfinite(g).all()) for g in found)
    assert [bool((g != 0).any()) for g in found] == [True, False, False, False, True]


@pytest.mark.parametrize("view", CAMERAS)
def test_light_on_flat_faces(view: str) -> None:
    """E max(0, n·l) at corners, with the normal on the viewer's side; over the greatest."""
    leaves = numbers_of("point directional")
    scene = scene_of("point directional", leaves).replace(meshes=scene_of("point", leaves).meshes[:1])
    frame = ImageContext(scene, make_request(scene, CAMERAS[view], 2, 0))
    found = creases._flat_radiance(frame.fixed, 0, frame.fixed_view, indirect=False)
    (mesh,) = scene.meshes
    corner = mesh.verts[mesh.faces.long()]
    n = torch.nn.functional.normalize(
        torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), dim=1
    )
    towards = (n * frame.fixed_view.to_viewer(corner[:, 0])).sum(1, keepdim=True)
    n, told = torch.where(towards < 0, -n, n)[:, None], towards[:, 0].abs() > 1e-3  # of others the side is left open
    to_point = leaves["point"] - corner
    distance = to_point.norm(dim=-1)
    power = leaves["point_power"] * leaves["point_color"].mean()
    sun = -torch.nn.functional.normalize(leaves["sun"], dim=0)
    expected = torch.stack(
        [power / distance**3 * (n * to_point).sum(-1), leaves["sun_power"] * (n @ sun).expand(-1, 3)], -1
    ).clamp(min=0)
    assert found.shape == expected.shape
    assert int(told.sum()) > 250
    assert float((found - expected / expected.max())[told].abs().max()) < 1e-12


def test_without_shadows() -> None:
    words = SCENES[-1]
    scene = scene_of(words, numbers_of(words))
    dark, lit = (in_kernel.radiance(hits_of(scene, CAMERAS["perspective"]), shadows, 1) for shadows in (True, False))
    assert bool((lit >= dark - 1e-12).all()) and float((lit - dark).max()) > 0.01
    expected = shading.reference(hits_of(scene, CAMERAS["perspective"]), False, 1)
    assert torch.allclose(lit, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("known", [True, False])
def test_derivatives_without_values(known: bool) -> None:
    """Nothing is computed ahead of them where it is known of which lights shadows are asked; else that is found. Without an
    environment, whose points are others where only derivatives are wanted."""
    words = SCENES[-1].replace("environment ", "")
    found = []
    for values in (True, False):
        leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
        hits = hits_of(scene_of(words, leaves), CAMERAS["perspective"])
        hits._needs_values = values
        lights = set(range(len(hits._surfaces.scene.casting)))
        hits._surfaces.shadowing.update(lights if known else ())
        radiance = in_kernel.radiance(hits, True, 1)
        assert hits._surfaces.shadowing == lights
        weights = torch.rand(radiance.shape, dtype=F64, generator=torch.Generator().manual_seed(3))
        found.append((radiance, torch.autograd.grad((weights * radiance).sum(), list(leaves.values()))))
    assert float(found[0][0].detach().abs().max()) > 0.1
    assert bool(found[1][0].detach().any()) != known
    assert all(torch.equal(a, b) for a, b in zip(found[0][1], found[1][1], strict=True))


def test_the_same_bits_on_any_number_of_threads() -> None:
    words = SCENES[-1]
    leaves = {name: value.clone().requires_grad_() for name, value in numbers_of(words).items()}
    camera = CAMERAS["perspective"].resized((48, 48))
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            radiance = in_kernel.radiance(hits_of(scene_of(words, leaves), camera), True, 1)
            found.append([radiance, *torch.autograd.grad(radiance.sum(), list(leaves.values()))])
    finally:
        torch.set_num_threads(before)
    assert len(found[0][0]) > 1024
    assert all(torch.equal(a, b) for a, b in zip(*found, strict=True))


def many_channels(leaves: Leaves, **material: Any) -> eg.Scene:
    mesh, C = icosphere(2), len(leaves["base"])
    mesh = eg.Mesh(mesh.verts.double(), mesh.faces, material=eg.Material(leaves["base"], **material))
    corner, across = torch.tensor([-0.5, 1.5, 1.0]).double(), torch.eye(3).double()
    emitter = eg.AreaLight.rectangle(corner, across[0], across[2], torch.linspace(3.0, 1.0, C, dtype=F64))
    lights = [
        eg.PointLight(torch.tensor([1.0, 2.0, 3.0]).double(), 9.0, leaves["color"]),
        eg.Environment(leaves["sky"]),
    ]
    return eg.Scene([mesh, emitter], lights=lights)


def colors_of_many(channels: int) -> Leaves:
    wave = torch.arange(channels, dtype=F64)
    sky = 0.5 + 0.4 * torch.sin(wave + torch.arange(32, dtype=F64)[:, None]).reshape(4, 8, channels)
    return {"base": 0.5 + 0.4 * torch.cos(wave), "color": 1.5 + torch.sin(wave), "sky": sky}


def test_more_channels_than_the_kernel_takes_at_once() -> None:
    found = []
    for shade in (in_kernel.radiance, shading.reference):
        leaves = {name: value.requires_grad_() for name, value in colors_of_many(37).items()}
        L = shade(hits_of(many_channels(leaves), CAMERAS["perspective"]), True, 2)
        assert L.shape[1] == 37 and float(L.detach().min(0).values.max()) > 0
        found.append([L, *torch.autograd.grad(L.square().sum(), list(leaves.values()))])
    assert all(torch.allclose(a, b, rtol=1e-10, atol=1e-12) for a, b in zip(*found, strict=True))


def test_glossy_surfaces_of_many_channels_are_those_of_few() -> None:
    """Images and gradients, within their noise."""
    found = []
    for few in (False, True):
        leaves = {name: value[..., :3] if few else value for name, value in colors_of_many(20).items()}
        leaves = {name: value.clone().requires_grad_() for name, value in leaves.items()}
        scene = many_channels(leaves, metallic=0.8, roughness=0.15)
        if few:  # the area light's colour is that of the first channels
            emitter = eg.AreaLight.of(
                scene.meshes[1].replace(material=None), torch.linspace(3.0, 1.0, 20, dtype=F64)[:3]
            )
            scene = scene.replace(meshes=[scene.meshes[0], emitter])
        image = eg.render(scene, CAMERAS["perspective"], spp=64, light_samples=4)[..., :3]
        grads = torch.autograd.grad(image.mean(), list(leaves.values()))
        found.append([image.mean((0, 1)), grads[0][:3], grads[1][:3], grads[2][..., :3].sum((0, 1))])
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm()) < 0.02 * float(b.norm()), (a, b)


def test_nearest_texels_that_one_sees_through_are_shaded_as_in_pytorch() -> None:
    """So are their discontinuities, in the same order."""
    leaves = numbers_of("nearest texture base point area")
    scene = scene_of("nearest texture base point area", leaves)
    mesh, *others = scene.meshes
    assert mesh.material is not None
    material, alpha = dataclasses.replace(mesh.material, alpha_mode="BLEND"), torch.full((2, 2), 0.5, dtype=F64)
    scene = scene.replace(meshes=[mesh.replace(material=material, alpha=alpha), *others])
    assert not in_kernel.is_fused(scene)
    kernel, twin = (hits_of(scene, CAMERAS["perspective"]) for _ in range(2))
    assert torch.allclose(radiance.radiance(kernel), shading.reference(twin), rtol=1e-12, atol=1e-12)
    assert kernel._discontinuities.kinds == twin._discontinuities.kinds != []
    for a, b in zip(kernel._discontinuities.values, twin._discontinuities.values, strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())


def test_which_scenes_the_kernel_shades() -> None:
    scene = scene_of("texture point", numbers_of("texture point"))
    mesh, ground = scene.meshes
    assert in_kernel.is_fused(scene)
    nearest = mesh.replace(filter="nearest")
    assert in_kernel.is_fused(scene.replace(meshes=[nearest, ground]))
    seen_through = nearest.replace(material=eg.Material(alpha_mode="BLEND"), alpha=torch.full((2, 2), 0.5, dtype=F64))
    assert not in_kernel.is_fused(scene.replace(meshes=[seen_through, ground]))
    assert mesh.texture is not None
    levels = seen_through.replace(filter="mipmap")
    assert in_kernel.is_fused(scene.replace(meshes=[levels, ground]))
    many = mesh.replace(texture=mesh.texture[..., :1].expand(-1, -1, 17).contiguous())
    assert not in_kernel.is_fused(eg.Scene([many], lights=scene.lights[:0]))


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_extremes_are_finite(dtype: torch.dtype) -> None:
    """Lights on the surface and far off, mirrors, normals against the face or of no length, faces of no area."""
    verts = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0]], dtype=dtype).requires_grad_()
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [0, 4, 2]])
    normals = torch.tensor([[0, 0, -1.0], [0, 0, 0], [1, 0, 1e-7], [0, 1e-30, 0], [0, 0, 1]], dtype=dtype)
    roughness = torch.tensor(0.0, dtype=dtype, requires_grad=True)
    for place in ([0.25, 0.25, 0.0], [0.0, 0.0, 1e-12], [1e9, 0.0, 1e9], [0.0, 0.0, -3.0]):
        position = torch.tensor(place, dtype=dtype, requires_grad=True)
        mesh = eg.Mesh(verts, faces, normals=normals, material=eg.Material(0.5, metallic=1.0, roughness=roughness))
        scene = eg.Scene(
            [mesh], lights=[eg.PointLight(position), eg.SpotLight(position, torch.tensor([0.0, 0.0, -1.0]))]
        )
        image = eg.render(scene, eg.Camera.look_at((0.3, 0.2, 3.0), (0.0, 0.0, 0.0), size=(16, 16)), spp=4)
        grads = torch.autograd.grad(image.sum(), [verts, roughness, position])
        assert bool(torch.isfinite(image).all()) and all(bool(torch.isfinite(g).all()) for g in grads)


def pyramid(texture: Tensor) -> eg.Scene:
    """Larger than its image, lit from both sides."""
    verts = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0.8]])
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    uvs = (verts[:, :2] + 1) / 2
    lights = [eg.PointLight(torch.tensor([0.5, -0.4, z]), power) for z, power in ((3.0, 30.0), (-3.0, 5.0))]
    return eg.Scene(
        [eg.Mesh(verts, faces, texture=texture, uvs=uvs, uv_faces=faces, material=eg.Material())], lights=lights
    )


NEAR = eg.Camera.look_at((0.3, -0.9, 1.6), (0.2, 0.0, 0.0), size=(24, 24))
AROUND_PYRAMID = {
    "pinhole": NEAR,
    "distorted": NEAR.replace(distortion=torch.tensor([-0.1, 0.02, 0.001, -0.001])),
    "panorama": eg.Camera.panorama(NEAR.world_to_camera, (24, 48)),
}


@pytest.mark.unwatched
@pytest.mark.parametrize(
    ("samples", "view", "filter"), diagonal([None, 150], list(AROUND_PYRAMID), ["box", "tent", "gaussian"])
)
def test_textured_faces_by_samples_of_pixels(samples: int | None, view: str, filter: str) -> None:
    """An image is linear in the base colour: the derivative along the texture is the image."""
    generator = torch.Generator().manual_seed(3)
    texture, camera = torch.rand(16, 16, 3, generator=generator), AROUND_PYRAMID[view]
    weights, found = torch.rand(*camera.size, 3, generator=generator), []
    for seed in range(12 if samples is None else 48):
        texture = texture.detach().requires_grad_()
        image = eg.render(
            pyramid(texture), camera, spp=64, seed=seed, filter=filter, surface_samples=samples, visibility=False
        )
        (gradient,) = torch.autograd.grad((weights * image).sum(), texture)
        found.append([float((gradient * texture).sum().detach()), float((weights * image).sum().detach())])
    (along, image), error = (
        torch.tensor(found).double().mean(0),
        torch.tensor(found).double().std(0) / len(found) ** 0.5,
    )
    assert float(error.norm()) < 0.01 * float(image)
    assert abs(float(along - image)) < 4 * float(error.norm())


def test_textured_faces_take_a_sample_a_pixel() -> None:
    """Fewer where fewer are asked for, and the error of a gradient grows."""
    camera = CAMERAS["perspective"].resized((96, 96))
    weights = torch.randn(96, 96, 3, dtype=F64, generator=torch.Generator().manual_seed(2))

    def spread(**options: int) -> float:
        found = []
        for seed in range(8):
            leaves = {name: value.clone().requires_grad_() for name, value in numbers_of("point texture").items()}
            image = eg.render(scene_of("point texture", leaves), camera, spp=16, seed=seed, **options)
            found.append(torch.autograd.grad((weights * image).sum(), leaves["texture"])[0])
        return float(torch.stack(found).std(0).norm())

    moving = scene_of("point texture", {k: v.requires_grad_() for k, v in numbers_of("point texture").items()})
    covered = float(eg.render_aovs(moving, camera, ["alpha"], 16)["alpha"].sum().detach())
    planned = eg.plan(moving, camera, spp=16)["interior"].samples
    assert covered < planned < 4 * covered
    assert spread() < 0.6 * spread(surface_samples=planned // 8)
