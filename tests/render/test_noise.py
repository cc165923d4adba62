"""The noise of gradients: it falls as `spp` grows, and noise() estimates it."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from noise_scenes import NOISE_SCENES, NoiseScene
from torch import Tensor

import edgegrad as eg
from edgegrad.noise import _estimate as noise_of


def relative_noise(values: list[Tensor]) -> float:
    """Return the root mean square deviation of one of these from their mean, over the size of the mean."""
    found = torch.stack([value.reshape(-1).double() for value in values])
    mean = found.mean(0)
    variance = float((found - mean).square().sum() / (len(found) - 1))
    return math.sqrt(variance / (float(mean.square().sum()) - variance / len(found)))


def gradients(scene: NoiseScene, spp: int, seeds: range) -> list[Tensor]:
    return [torch.autograd.grad(scene.loss(scene.render(spp, seed)), scene.leaf)[0] for seed in seeds]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if "texel" in name else name for name in NOISE_SCENES]
)
def test_four_times_spp_halve_the_noise_of_a_gradient(name):
    """Sixteen times, in two steps of at most 0.6."""
    scene = NOISE_SCENES[name]()
    seeds = range(scene.seeds)
    few, many = (relative_noise(gradients(scene, spp, seeds)) for spp in (16, 256))
    assert many < 0.6**2 * few, (few, many)


def test_plan_counts_samples_by_spp():
    """In proportion from 16 on, in each row that casts rays for the gradient."""
    scene = NOISE_SCENES["bounces"]()
    few, many = (eg.plan(scene.scene, scene.camera, spp, **scene.options) for spp in (16, 64))
    for row in ("image", "interior", "boundary", "secondary edges", "indirect shadow boundaries", "shadow boundaries"):
        assert many[row].samples == pytest.approx(4 * few[row].samples, abs=4) and few[row].samples, row
    assert "4 × spp halve the noise; see eg.noise()" in str(few)
    lit = NOISE_SCENES["point light"]()
    assert "96 samples a pixel of boundary" in eg.plan(lit.scene, lit.camera, 64)["shadow boundaries"].why


def before_cameras(scene: NoiseScene) -> NoiseScene:
    """Return the scene before a batch of two cameras."""
    other = eg.Camera.look_at((-1.5, 1.0, 3.2), (0, 0, 0), (0.0, 1.0, 0.01), 35.0, scene.camera.size).to(torch.float64)
    return scene._replace(camera=eg.Camera.stack([scene.camera, other]))


@pytest.mark.parametrize("name", ["faces", "batch", pytest.param("point light", marks=pytest.mark.slow), "shader"])
def test_noise_is_that_of_many_gradients(name):
    scene = before_cameras(NOISE_SCENES["faces"]()) if name == "batch" else NOISE_SCENES[name]()
    truth = relative_noise(gradients(scene, 4, range(64)))
    found = [
        eg.noise(scene.scene, scene.camera, scene.loss, 4, seed, by={"verts": scene.leaf}, seeds=2, **scene.options)
        for seed in range(12)
    ]
    estimate = math.sqrt(sum(each.noise["verts"] ** 2 for each in found) / len(found))
    error = sum(each.uncertainty["verts"] for each in found) / len(found) / math.sqrt(len(found))
    assert abs(estimate / truth - 1) < 4 * error < 0.5, (estimate, truth, error)
    images = [scene.render(4, seed).detach() for seed in range(16)]
    assert found[0].image == pytest.approx(relative_noise(images), rel=0.3)


def test_noise_counts_that_of_the_image_in_a_squared_loss():
    """With linear loss the gradient's own samples alone are noisy; the image's enter by the cotangent."""
    scene = NOISE_SCENES["faces"]()
    linear = eg.noise(scene.scene, scene.camera, scene.loss, 1, seed=0).noise["meshes.0.verts"]
    squared = eg.noise(scene.scene, scene.camera, lambda image: image.square().sum(), 1, seed=0)
    assert squared.noise["meshes.0.verts"] > 3 * linear
    assert squared.noise["meshes.0.verts"] < 3 * squared.image


def test_spp_for_a_noise():
    scene = NOISE_SCENES["area light"]()
    found = eg.noise(scene.scene, scene.camera, scene.loss, 16, seed=0, target=0.001)
    noise = found.noise["meshes.0.verts"] * (1 + found.uncertainty["meshes.0.verts"])
    assert found.spp_for() == found.spp_for(0.001) == math.ceil(16 * (noise / 0.001) ** 2)
    assert found.spp_for(1.1 * noise) == 16  # nothing to gain
    more = eg.noise(scene.scene, scene.camera, scene.loss, found.spp_for(noise / 3), seed=1)
    assert more.noise["meshes.0.verts"] < 1.1 * noise / 3
    few = eg.noise(scene.scene, scene.camera, scene.loss, 4, seed=0)  # below 16 the gradient's samples do not grow
    bound = few.noise["meshes.0.verts"] * (1 + few.uncertainty["meshes.0.verts"])
    assert few.spp_for(0.001) == math.ceil(16 * (bound / 0.001) ** 2)
    with pytest.raises(KeyError, match=r"tensor: expected one of meshes\.0\.verts, got 'colors'"):
        found.spp_for(0.1, "colors")
    with pytest.raises(ValueError, match="target: expected"):
        found.spp_for(0.0)


def test_noise_by_name_prints_a_table():
    scene = NOISE_SCENES["faces"]()
    mesh = scene.scene.meshes[0]
    assert mesh.colors is not None
    mesh = mesh.replace(colors=mesh.colors.clone().requires_grad_())
    camera = scene.camera.replace(K=scene.camera.K.clone().requires_grad_())
    found = eg.noise(mesh, camera, scene.loss, 4, seed=0, filter="tent", sampling=eg.Sampling(seed=3))
    assert list(found.noise) == ["verts", "colors", "camera.K"]
    assert all(0 < noise < 0.1 for noise in found.noise.values()) and 0 < found.share < 1
    lines = str(found).splitlines()
    assert lines[0].split() == ["gradient", "by", "noise", "±", "spp", "for", "5", "%"]
    assert [line.split()[0] for line in lines[1:-1]] == ["verts", "colors", "camera.K", "image"]
    assert lines[-1].startswith("at 4 samples per pixel; ")


def test_noise_above_the_gradient_is_a_lower_bound():
    """Of two gradients that are nothing but noise."""
    estimate = noise_of([torch.tensor([1.0, 0.0]), torch.tensor([-1.0, 0.1])])
    assert 1 < estimate[0] < math.inf
    assert noise_of([torch.ones(3), torch.ones(3)]) == (0.0, 0.0)
    assert math.isnan(noise_of([torch.zeros(3), torch.zeros(3)])[0])


def test_noise_takes_seeds_as_render_does():
    scene = NOISE_SCENES["faces"]()

    def found(seed: int | None = None, **options: Any) -> float:
        return eg.noise(scene.scene, scene.camera, scene.loss, 4, seed, **options).noise["meshes.0.verts"]

    assert found(3) == found(3) != found(4)
    drawn = [found(generator=torch.Generator().manual_seed(k)) for k in (1, 1, 2)]
    assert drawn[0] == drawn[1] != drawn[2]
    torch.manual_seed(5)
    first = found()
    assert first != found()
    torch.manual_seed(5)
    assert first == found()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"loss": 3}, "loss: expected a function of the image, got int"),
        ({"loss": lambda image: image}, "loss: expected a scalar, got shape"),
        ({"loss": lambda image: 1.0}, "loss: expected a function that returns a scalar tensor, got float"),
        ({"loss": lambda image: image.detach().sum()}, "loss: expected a differentiable function of the image"),
        ({"loss": lambda image: image.sum() * math.inf}, "loss: expected a finite number, got inf"),
        (
            {"loss": lambda image: (0 * image).sum().sqrt()},
            "the gradient of the image: expected finite numbers, got nan",
        ),
        ({"seeds": 1}, "seeds: expected at least 2"),
        ({"target": -1.0}, "target: expected"),
        ({"by": {}}, "by: expected a mapping of names to tensors, got an empty one"),
        ({"by": {"pose": torch.zeros(3)}}, "by: expected tensors that require a gradient, got 'pose'"),
        ({"spp": 0}, "spp: expected"),
        ({"colour": 1}, "noise: expected only the options"),
        ({"scene": 3}, "scene: expected"),
        ({"camera": 3}, "camera: expected"),
    ],
)
def test_messages(change, message):
    scene = NOISE_SCENES["faces"]()
    arguments = {"scene": scene.scene, "camera": scene.camera, "loss": scene.loss, "seed": 0, **change}
    with pytest.raises((TypeError, ValueError), match=re.escape(message)):
        eg.noise(**arguments)


def test_nothing_requires_a_gradient():
    scene = NOISE_SCENES["faces"]()
    still = eg.Scene([scene.scene.meshes[0].replace(verts=scene.leaf.detach())])
    with pytest.raises(ValueError, match="scene: expected a tensor of the scene or of the camera that requires"):
        eg.noise(still, scene.camera, scene.loss)


def test_no_gradient_is_not_a_perfect_one():
    scene, other = NOISE_SCENES["faces"](), torch.zeros(3, requires_grad=True)
    found = eg.noise(
        scene.scene, scene.camera, scene.loss, 4, 0, by={"verts": scene.leaf, "other": other}, **scene.options
    )
    assert math.isnan(found.noise["other"]) and "no gradient" in str(found)
    assert found.spp_for(1e-3, "verts") == found.spp_for(1e-3) > 16 and found.spp_for(1e-3, "other") == 4
    with pytest.raises(ValueError, match="loss: expected one that changes with other, got gradients of zero"):
        eg.noise(scene.scene, scene.camera, scene.loss, 4, 0, by={"other": other}, **scene.options)
