"""hits.light_points(light, by=points_by_material): the points of render(), for shaders written in PyTorch."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from lit_scenes import F64, ball, plane, vector
from oracles import shading
from sampling_options import with_sampling
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel
from edgegrad.light.bsdf import Scattering
from edgegrad.points.image_context import ImageContext

pytestmark = pytest.mark.quick

CAMERA = eg.Camera.look_at((0.4, 0.9, 4.0), (0.0, 0.0, 0.0), fov_y=40.0, size=(20, 20))


def scene(base: Tensor, power: Tensor, texels: Tensor) -> eg.Scene:
    gold = eg.Material(base, metallic=0.9, roughness=0.3)
    emitter = eg.shapes.rectangle(
        vector(-0.5, 2.0, 1.5),
        vector(1, 0, 0),
        vector(0, 0.4, -0.6),
        material=eg.Material(base_color=0.0, emission=power),
    )
    floor = plane(2.0, material=eg.Material(vector(0.4, 0.5, 0.6)))
    bare = plane(0.2).replace(verts=plane(0.2).verts + vector(1.0, 1.0, 0.3))
    floor = floor.replace(verts=floor.verts - vector(0, 0, 1.2))
    sky = eg.lights.Environment(texels, rotation=torch.linalg.qr(vector(1, 2, 3, 0, 1, 5, 2, 1, 0).reshape(3, 3))[0])
    return eg.Scene([ball(2, material=gold), floor, bare, emitter], lights=[sky.replace(visible=False)])


def leaves() -> dict[str, Tensor]:
    texels = torch.rand((6, 12, 3), dtype=F64, generator=torch.Generator().manual_seed(1))
    texels[1, 3:5] = 8.0
    return {"base": vector(0.9, 0.6, 0.3), "power": vector(4.0, 3.0, 2.0), "texels": texels}


@pytest.mark.parametrize("light", [0, 1], ids=["sky", "emitter"])
def test_the_kernel_draws_what_pytorch_draws(light: int):
    frame = ImageContext(scene(**leaves()), make_request(scene(**leaves()), CAMERA, 2, 0))
    ((_, found),) = frame.sampler.pixel_hits(1 << 40)
    seed = frame.seeds("image", len(found.face))
    hits = frame.moving_hits(found.face, frame.sampler.rays_at(found.x), found.x, seed)
    assert set(hits.mesh.tolist()) == {0, 1, 2}
    of_light = hits.lights[light]
    for a, b in zip(
        shading.points_by_material(hits, of_light, 3), in_kernel.light_points(hits, of_light, 3), strict=True
    ):
        some = a.density.isfinite()
        assert torch.equal(some, b.density.isfinite()) and int(some.sum()) > 200
        assert torch.equal(a.index[some], b.index[some])
        torch.testing.assert_close(a.uv[some], b.uv[some], rtol=0, atol=1e-9)
        torch.testing.assert_close(a.density[some], b.density[some], rtol=1e-9, atol=0)


def test_a_shader_of_its_own_gives_what_render_gives():
    """The image, and gradients by base colour, radiance of the light and texels, within the noise of both."""

    def shader(own: dict[str, Tensor]) -> Any:
        material = [(own["base"], vector(0.9), vector(0.3)), (vector(0.4, 0.5, 0.6), None, None)]

        def shade(hits: eg.points.Hits) -> Tensor:
            total = torch.zeros((len(hits), 3), dtype=F64)
            for number, (base, metallic, roughness) in enumerate(material):
                rows = (hits.mesh == number).nonzero()[:, 0]
                some = hits.select(rows)
                n = some.shading_normal if number == 0 else some.normal
                of_mesh = torch.zeros((len(rows), 3), dtype=F64)
                scattering = Scattering(base[None], *(None if x is None else x[None] for x in (metallic, roughness)))
                for light in some.lights:
                    points = some.light_points(light, by=eg.lights.points_by_material)
                    l = light.incident(points, some.position)
                    cosine = (n * l).sum(1, keepdim=True)
                    seen = (
                        some.visible_from(light, points)[:, None]
                        * (cosine > 0)
                        * (some.normal * l).sum(1, keepdim=True).gt(0)
                    )
                    f = scattering.evaluate(some.view, n, normalize(l, dim=1))
                    of_mesh = of_mesh + torch.where(seen > 0, f * cosine * light.arriving(points, some.position), 0.0)
                total = total.index_copy(0, rows, of_mesh)
            bare = (hits.mesh == 2).to(F64)[:, None] * 0.7
            emits = (hits.mesh == 3).to(F64)[:, None] * own["power"]
            return total + bare + emits

        return shade

    found = []
    for by_shader in (True, False):
        values = []
        for seed in range(12):
            own = {name: value.clone().requires_grad_() for name, value in leaves().items()}
            options: dict[str, Any] = {"shader": shader(own)} if by_shader else {}
            image = eg.render(scene(**own), CAMERA, spp=16, seed=seed, **with_sampling(options, surface=3000))
            weights = torch.linspace(0.5, 1.5, 20, dtype=F64)[:, None]
            got = torch.autograd.grad((image.mean(2) * weights).sum(), list(own.values()))
            values.append(torch.cat([image.detach().mean((0, 1)), got[0], got[1], got[2].sum((0, 1))]))
        found.append(torch.stack(values).double())
    mean, error = ([x.mean(0) for x in found], [x.std(0) / len(x) ** 0.5 for x in found])
    allowed = 4 * (error[0] ** 2 + error[1] ** 2).sqrt() + 5e-3 * mean[1].abs()
    assert bool((allowed < 0.12 * mean[1].abs()).all()), allowed / mean[1]
    assert bool(((mean[0] - mean[1]).abs() < allowed).all()), (mean[0] / mean[1], allowed / mean[1])


def test_arguments():
    hits = eg.points.trace(scene(**leaves()), vector(0, 0, 3)[None], vector(0, 0, -1))
    with pytest.raises(TypeError, match=r"by: expected a function such as eg\.lights\.points_by_material"):
        hits.light_points(hits.lights[0], by="lobe")
    with pytest.raises(ValueError, match="sample: expected an int from 0 to 1"):
        hits.light_points(hits.lights[0], 2, 2)
    assert len(hits.light_points(hits.lights[1], 1, 2, by=eg.lights.points_by_material).index) == 1
    with pytest.raises(TypeError, match="samples: expected an int, got"):
        hits.light_points(hits.lights[0], 0, 1.5)
    with pytest.raises(TypeError, match="by: expected a function that returns a list of 1 LightPoints, got None"):
        hits.light_points(hits.lights[0], by=lambda *_: None)
