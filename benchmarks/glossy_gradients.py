"""Noise in gradients of glossy surfaces with default samples.

The loss is the squared difference to the image of a scene that one parameter tells from this one, without its noise: the gradient
is that of an image times a fixed residual. Printed is the standard deviation of the gradient over its size, as vectors, in
percent; and where Mitsuba is installed, with its derivatives, how much longer it takes to the same error.
"""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg

from . import mitsuba
from .document import duration
from .glossy import SIZE, sky
from .scenes import icosphere
from .table import Bench, Row

Parameters = dict[str, Tensor]
# What tells the other image from this one.
CHANGES = {
    "roughness": torch.tensor(0.03), "metallic": torch.tensor(-0.1), "base color": torch.tensor(-0.1),
    "normals": 0.02 * torch.tensor([1.0, -0.7, 0.5]), "translation": 0.02 * torch.tensor([1.0, -0.7, 0.5]),
    "texels": 0.3 * torch.rand((8, 16, 3), generator=torch.Generator().manual_seed(1)),
}  # fmt: skip
SPP = (4, 16, 64)  # Mitsuba's
UVS = 0.01 * torch.tensor([1.0, 0.7])


def ball(kind: str, roughness: float) -> tuple[Parameters, Callable[[Parameters], eg.Scene]]:
    """Return a ball of metallic 0.8. One shift moves all normals, one all vertices; a factor scales 8 × 8 texels of the sky."""
    given = {
        "roughness": torch.tensor(roughness),
        "metallic": torch.tensor(0.8),
        "base color": torch.tensor([0.9, 0.6, 0.3]),
    }
    given |= {"normals": torch.zeros(3), "translation": torch.zeros(3), "texels": torch.ones(8, 16, 3)}
    verts, image = normalize(icosphere(5).verts.float(), dim=1), sky(kind)
    if kind == "even":  # brighter above: under one that is the same from all around normals hardly matter
        image = image * torch.linspace(1.5, 0.5, len(image))[:, None, None]

    def scene(p: Parameters) -> eg.Scene:
        material = eg.Material(p["base color"], metallic=p["metallic"], roughness=p["roughness"])
        mesh = eg.Mesh(verts + p["translation"], icosphere(5).faces, normals=verts + p["normals"], material=material)
        radiance = image * p["texels"].repeat_interleave(8, 0).repeat_interleave(8, 1)
        return eg.Scene([mesh], lights=[eg.lights.Environment(radiance)])

    return given, scene


def sheet() -> tuple[Parameters, Callable[[Parameters], eg.Scene]]:
    """Return a metal sheet with a wavy normal map under a point light; its texture coordinates are the parameters."""
    line = torch.linspace(-1, 1, 9)
    y, x = torch.meshgrid(line, line, indexing="ij")
    i = torch.arange(81).reshape(9, 9)
    a, b, c, d = (part.reshape(-1) for part in (i[:-1, :-1], i[:-1, 1:], i[1:, 1:], i[1:, :-1]))
    faces = torch.cat([torch.stack([a, b, c], 1), torch.stack([a, c, d], 1)])
    verts, t = torch.stack([x, y, 0 * x], -1).reshape(-1, 3), torch.arange(32) * (math.pi / 16)
    height = 0.75 * torch.sin(2 * t)[:, None] * torch.cos(3 * t)
    slopes = [height.roll(1, k) - height.roll(-1, k) for k in (1, 0)]
    image = normalize(torch.stack([*slopes, torch.ones_like(height)], -1), dim=-1) * 0.5 + 0.5

    def scene(p: Parameters) -> eg.Scene:
        map_ = eg.Texture(image, p["uvs"], faces)
        material = eg.Material(torch.tensor([0.9, 0.6, 0.3]), metallic=0.8, roughness=0.2, normal_map=map_)
        return eg.Scene(
            [eg.Mesh(verts, faces, material=material)],
            lights=[eg.lights.PointLight(torch.tensor([1.0, 1.0, 3.0]), 30.0)],
        )

    return {"uvs": (verts[:, :2] + 1) / 2}, scene


def residuals(
    given: Parameters, scene: Callable[[Parameters], eg.Scene], changes: Parameters, camera: eg.Camera
) -> dict[str, Tensor]:
    """Return the derivative of each loss with respect to the image, (H, W, 3)."""

    def clean(p: Parameters) -> Tensor:
        with torch.no_grad():
            return eg.render(scene(p), camera, spp=64, sampling=eg.Sampling(lights=4), seed=900)

    return {name: 2 * (clean(given) - clean({**given, name: given[name] + by})) for name, by in changes.items()}


def noise(
    given: Parameters, scene: Callable[[Parameters], eg.Scene], changes: Parameters, camera: eg.Camera, seeds: int
) -> dict[str, float]:
    """Return the noise of the gradient with respect to each parameter, in percent."""
    residual = residuals(given, scene, changes, camera)
    found: dict[str, list[Tensor]] = {name: [] for name in changes}
    for seed in range(seeds):
        p = {name: value.clone().requires_grad_() for name, value in given.items()}
        image = eg.render(scene(p), camera, seed=seed)
        for name in changes:
            (g,) = torch.autograd.grad((image * residual[name]).sum(), p[name], retain_graph=True)
            found[name].append(g.double().flatten())
    return {name: _relative(torch.stack(gradients)) for name, gradients in found.items()}


def _relative(g: Tensor) -> float:
    """Return the deviation relative to the size of the mean, in percent."""
    return 100 * float(g.var(0).sum().sqrt()) / _size(g)


def _size(g: Tensor) -> float:
    """Return the size of the mean; the noise in its square is subtracted."""
    return float((g.mean(0).square().sum() - g.var(0).sum() / len(g)).clamp(min=1e-30).sqrt())


# What Mitsuba calls the parameters.
KEYS = {
    "roughness": "ball.bsdf.roughness", "metallic": "ball.bsdf.metallic", "base color": "ball.bsdf.base_color",
    "normals": "ball.vertex_normals", "translation": "ball.vertex_positions", "texels": "sky.data",
}  # fmt: skip


class MitsubaGradients:
    """Mitsuba's gradients of the same ball, loss and camera.

    `prb` differentiates at samples of the light and of the BSDF, and not how these are drawn. `prb_projective` is used for what
    moves silhouettes.
    """

    PRIMAL = 16  # samples a pixel of the image, edgegrad's default

    def __init__(self, scene: eg.Scene, given: Parameters, residual: dict[str, Tensor]) -> None:
        self.mi, self.dr = mi, dr = mitsuba.load()
        dr.set_thread_count(torch.get_num_threads())
        (mesh,), (light,) = scene.meshes, scene.lights
        assert isinstance(light, eg.lights.Environment) and mesh.normals is not None
        mitsuba.register(mi, dr)
        props = mi.Properties()
        props["bsdf"] = mi.load_dict(
            mitsuba.bsdf(given["base color"].tolist(), float(given["metallic"]), float(given["roughness"]))
        )
        ball = mi.Mesh("ball", len(mesh.verts), len(mesh.faces), props, has_vertex_normals=True)
        shape = mi.traverse(ball)
        shape["vertex_positions"] = mi.Float(mesh.verts.numpy().ravel())
        shape["vertex_normals"] = mi.Float(mesh.normals.numpy().ravel())
        shape["faces"] = mi.UInt32(mesh.faces.numpy().astype(np.uint32).ravel())
        shape.update()
        self.radiance = light.radiance
        sensor = mitsuba.sensor(mi, (0, 0.3, 3.2), (0, 0, 0), 40, (SIZE, SIZE))
        sky_ = mitsuba.sky(mi, light.radiance)
        self.scene = mi.load_dict({"type": "scene", "sensor": sensor, "sky": sky_, "ball": ball})
        self.integrators = {name: mi.load_dict({"type": name, "max_depth": 2}) for name in ("prb", "prb_projective")}
        self.params = mi.traverse(self.scene)
        self.values = {name: type(self.params[key])(self.params[key]) for name, key in KEYS.items()}
        self.residual = {name: mi.TensorXf(r.numpy()) for name, r in residual.items()}

    def __call__(self, name: str, spp: int, seed: int) -> Tensor:
        """Return the gradient with respect to one parameter."""
        mi, dr, key = self.mi, self.dr, KEYS[name]
        given = type(self.values[name])(self.values[name])
        dr.enable_grad(given)
        self.params[key] = given
        self.params.update()
        numbers: dict[str, int] = {"seed": 2 * seed, "seed_grad": 2 * seed + 1}
        integrator = self.integrators["prb_projective" if name == "translation" else "prb"]
        if name == "translation":  # as attributes: numbers given to mi.render would hold for both kinds of samples
            integrator.sppc, integrator.sppp, integrator.sppi = spp, spp, 0
            self.scene.sensors()[0].sampler().set_sample_count(self.PRIMAL)
        else:
            numbers |= {"spp": self.PRIMAL, "spp_grad": spp}
        image = mi.render(self.scene, self.params, integrator=integrator, **numbers)
        dr.backward(dr.sum(image * self.residual[name], axis=None))
        found = torch.from_numpy(np.array(dr.grad(given))).double()
        self.params[key] = type(given)(self.values[name])
        if name in ("normals", "translation"):
            return found.reshape(-1, 3).sum(0)
        return self.by_blocks(found[..., :3]) if name == "texels" else found.flatten()

    def by_blocks(self, by_data: Tensor) -> Tensor:
        """Return the gradient with respect to factors of our sky from that of Mitsuba's texels.

        Mitsuba's image repeats its last column before the first one, and its first after the last one.
        """
        factor = torch.ones((8, 16, 3), dtype=torch.float64, requires_grad=True)
        image = mitsuba.sky_image(self.radiance * factor.repeat_interleave(8, 0).repeat_interleave(8, 1))
        data = torch.cat([image[:, -1:], image, image[:, :1]], 1)
        return torch.autograd.grad((data * by_data).sum(), factor)[0].flatten()


def against_mitsuba(bench: Bench, kind: str, roughness: float, camera: eg.Camera) -> list[Row]:
    """Measure how much longer Mitsuba takes to the error of a gradient with default samples, in processor time.

    Both sides are unbiased, so errors are deviations, relative to the size of edgegrad's gradient. Mitsuba's fall with the root
    of its samples, whose number follows from all that were measured. Its time is interpolated, and at least that of the fewest.
    """
    given, scene = ball(kind, roughness)
    residual = residuals(given, scene, CHANGES, camera)
    theirs, seeds = MitsubaGradients(scene(given), given, residual), bench.repeats(24)

    def ours(name: str, seed: int) -> Tensor:
        p = {n: value.clone().requires_grad_(n == name) for n, value in given.items()}
        (g,) = torch.autograd.grad((eg.render(scene(p), camera, seed=seed) * residual[name]).sum(), p[name])
        return g.double().flatten()

    rows = []
    for name in CHANGES:
        bench.bar.set_postfix_str(f"{kind}, {roughness}, {name}")
        found, seconds = _measured(lambda seed, n=name: ours(n, seed), seeds)
        size, error = _size(found), _relative(found)
        swept = []
        for spp in SPP:
            others, taken = _measured(lambda seed, n=name, s=spp: theirs(n, s, seed), seeds)
            swept.append((100 * float(others.var(0).sum().sqrt()) / size, taken))
        spp = statistics.fmean(e * e * n for (e, _), n in zip(swept, SPP, strict=True)) / error**2
        slope = (swept[-1][1] - swept[0][1]) / (SPP[-1] - SPP[0])
        needed = swept[0][1] + slope * max(spp - SPP[0], 0)
        errors = ", ".join(f"{e:.3g} % in {duration(t)}" for e, t in swept)
        rows.append(
            Row(
                f"… {kind} sky, roughness {roughness}, by {name}: Mitsuba's time over edgegrad's", needed / seconds,
                unit=" ×", must=10.0, aim=30.0, more_is_better=True,
                note=f"edgegrad {error:.3g} % in {duration(seconds)}; Mitsuba at {SPP} spp {errors}",
            )
        )  # fmt: skip
    return rows


def _measured(gradient: Callable[[int], Tensor], seeds: int) -> tuple[Tensor, float]:
    """Gradients (seeds, n), and seconds of the processor of one."""
    gradient(10_000)  # compiled, and warm
    found, seconds = [], []
    for seed in range(seeds):
        begin = time.process_time()
        found.append(gradient(seed))
        seconds.append(time.process_time() - begin)
    return torch.stack(found), statistics.median(seconds)


def glossy_gradients(bench: Bench) -> list[Row]:
    camera = eg.Camera.look_at((0.0, 0.3, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (SIZE, SIZE))
    rows, seeds = [], bench.repeats(24)
    for kind in ("even", "lights"):
        for roughness in (0.5, 0.2, 0.1, 0.05):
            found = noise(*ball(kind, roughness), CHANGES, camera, seeds)
            sky_ = "smooth sky" if kind == "even" else "sky with small lights"
            rows += [
                Row(
                    f"a metal ball, {sky_}, roughness {roughness}: gradient by {name}",
                    value,
                    unit=" %",
                    must=10.0,
                    aim=5.0,
                )
                for name, value in found.items()
            ]
    above = eg.Camera.look_at((0.6, -1.2, 2.6), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 45.0, (SIZE, SIZE))
    value = noise(*sheet(), {"uvs": UVS}, above, seeds)["uvs"]
    rows.append(Row("a normal-mapped sheet: gradient by texture coordinates", value, unit=" %", must=40.0, aim=20.0))
    if mitsuba.available():
        for kind, roughness in (("even", 0.5), ("even", 0.2), ("lights", 0.5), ("lights", 0.2)):
            rows += against_mitsuba(bench, kind, roughness, camera)
    return rows
