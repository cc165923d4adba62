"""Images of lit scenes, which the kernel shades whole, and their gradients."""

from __future__ import annotations

import pytest
import torch
from combinations import diagonal
from lit_words import CAMERAS, F64, SCENES, numbers_of, scene_of
from scenes import icosphere
from threads import check_threads
from torch import Tensor

import edgegrad as eg
from edgegrad.light import radiance
from edgegrad.points import discontinuous_pixels

pytestmark = pytest.mark.watched


def test_shadow_boundaries_by_what_the_light_adds() -> None:
    """The gradient is that of the radiance on both sides of the boundary, some 1e-4 px from it, where any other shader is
    asked."""
    leaves = {
        name: value.clone().requires_grad_() for name, value in numbers_of("normals point area sky colors").items()
    }
    scene = scene_of("normals point area sky colors emission", {**leaves, "emission": torch.ones(3)})
    camera, found = CAMERAS["perspective"], []
    weights = torch.rand(24, 24, 3, generator=torch.Generator().manual_seed(1))
    for shader in (None, lambda hits: radiance.radiance(hits, True, 1)):
        image = eg.render(scene, camera, spp=4, shader=shader, sampling=eg.Sampling(edges=4000), seed=0)
        found.append(torch.autograd.grad((weights * image).sum(), [leaves["verts"], leaves["point"]]))
    for a, b in zip(*found, strict=True):
        assert float((a - b).norm()) < 1e-4 * float(a.norm()) > 0


def test_shadow_boundaries_with_nearest_texels() -> None:
    """Emission is left out of what a light adds, and its nearest texels with it: one texel is looked up linearly."""
    found = []
    for filter in ("nearest", "linear"):
        leaves = {name: value.clone().requires_grad_() for name, value in numbers_of("normals point").items()}
        scene = scene_of("normals point", leaves)
        uvs, faces = torch.eye(3)[:, :2], torch.arange(3).expand(len(scene.meshes[0].faces), 3)
        glow = eg.Texture(torch.full((1, 1, 3), 0.3, dtype=F64), uvs, faces, filter=filter)
        glowing = scene.meshes[0].replace(material=eg.Material(emission=glow))
        image = eg.render(scene.replace(meshes=[glowing, scene.meshes[1]]), CAMERAS["perspective"], spp=4, seed=0)
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
    """They are those of hits that are shaded one by one, where pixels that borders of shadows and texels cross are shaded
    again."""
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
        (plain, {"sampling": eg.Sampling(lights=3), "filter": "tent", "spp": 4}),
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
                found.append(eg.render(scene, camera, **{"seed": 0, **options}))
        assert float(found[0].max()) > 0.1
        assert float((found[0] - found[1]).abs().max()) <= 1e-12 * float(found[0].abs().max())
    assert ("point" not in words) or any(int(pixels.sum()) > 10 for pixels, _ in again)


def test_the_same_whole_image_on_any_number_of_threads() -> None:
    scene = scene_of(SCENES[-1], numbers_of(SCENES[-1]))
    check_threads(lambda: [eg.render(scene, CAMERAS["perspective"].resized((64, 64)), spp=4, seed=0)])


def test_radiance_that_is_not_finite_is_named() -> None:
    light = eg.lights.PointLight(torch.tensor([0.0, 0.0, 3.0]), 1e25, torch.full((3,), 1e25))
    ball = icosphere(2)
    scene = eg.Scene([eg.Mesh(ball.verts.float(), ball.faces, material=eg.Material())], lights=[light])
    with pytest.raises(ValueError, match=r"expected finite numbers, got .*inf"):
        eg.render(scene, CAMERAS["perspective"], seed=0)


def test_all_tensors_get_gradients_though_the_image_depends_on_few() -> None:
    """Zeros of those that it does not depend on: alpha that cuts nothing out, a light that is behind, the lens."""
    ball = icosphere(1)
    alpha = torch.ones(2, 2, requires_grad=True)
    emitter = eg.lights.SpotLight(
        *(torch.tensor(v, requires_grad=True) for v in ([0.0, 0.0, 9.0], [0.0, 0.0, 1.0])), 3.0
    )
    distortion = torch.zeros(8, requires_grad=True)
    mesh = eg.Mesh(
        ball.verts.float().requires_grad_(), ball.faces, uvs=torch.rand(len(ball.verts), 2), uv_faces=ball.faces,
        material=eg.Material(), alpha=alpha,
    )  # fmt: skip
    camera = CAMERAS["perspective"].replace(distortion=distortion)
    sun = eg.lights.DirectionalLight(torch.tensor([-0.2, -0.5, -1.0]), 2.0)
    image = eg.render(eg.Scene([mesh], lights=[sun, emitter]), camera, 4, seed=0)
    leaves = [mesh.verts, alpha, emitter.position, emitter.direction, distortion]
    found = torch.autograd.grad(image.sum(), leaves)
    assert all(bool(torch.isfinite(g).all()) for g in found)
    assert [bool((g != 0).any()) for g in found] == [True, False, False, False, True]


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
            [mesh],
            lights=[eg.lights.PointLight(position), eg.lights.SpotLight(position, torch.tensor([0.0, 0.0, -1.0]))],
        )
        image = eg.render(scene, eg.Camera.look_at((0.3, 0.2, 3.0), (0.0, 0.0, 0.0), size=(16, 16)), spp=4, seed=0)
        grads = torch.autograd.grad(image.sum(), [verts, roughness, position])
        assert bool(torch.isfinite(image).all()) and all(bool(torch.isfinite(g).all()) for g in grads)


def pyramid(texture: Tensor) -> eg.Scene:
    """Larger than its image, lit from both sides."""
    verts = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0], [0, 0, 0.8]])
    faces = torch.tensor([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    uvs = (verts[:, :2] + 1) / 2
    lights = [eg.lights.PointLight(torch.tensor([0.5, -0.4, z]), power) for z, power in ((3.0, 30.0), (-3.0, 5.0))]
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
            pyramid(texture),
            camera,
            spp=64,
            seed=seed,
            filter=filter,
            sampling=eg.Sampling(surface=samples),
            visibility=False,
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
    covered = float(eg.render_aovs(moving, camera, ["alpha"], 16, seed=0)["alpha"].sum().detach())
    planned = eg.plan(moving, camera, spp=16)["interior"].samples
    assert covered < planned < 4 * covered
    assert spread() < 0.6 * spread(sampling=eg.Sampling(surface=planned // 8))
