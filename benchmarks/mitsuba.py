"""Mitsuba 3 as a peer: its module, lights and materials as edgegrad has them, and gradients by projective sampling.

In `Mitsuba`, unlit radiance becomes an emitter on both sides of a mesh, and the background a constant one. Both integrators stop
at the first hit.
"""

from __future__ import annotations

import importlib
import math
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.light.bsdf import DIELECTRIC, LEAST_ALPHA
from edgegrad.scene.scene import Scene

from .mitsuba_scene import describe, float_array, resized

BSDF = "metallic_roughness"  # the plugin of edgegrad's materials
INTEGRATORS = ("direct_projective", "prb_projective")
VARIANT = "llvm_ad_rgb"
LLVM = 16  # the oldest that is let through: 15 aborts the whole process on prb_projective ("Cannot select: fminimum")
SPLIT = 8  # interior samples for each boundary sample: one of the latter costs as much as about thirty of the former


def available() -> str | None:
    """Return Mitsuba's version, or None where it is not installed or finds no LLVM."""
    try:
        return load()[0].__version__
    except (ImportError, RuntimeError):
        return None


def load() -> tuple[Any, Any]:
    """Return the modules mitsuba and drjit, in the variant that runs on the CPU with derivatives."""
    try:
        mi, dr = importlib.import_module("mitsuba"), importlib.import_module("drjit")
    except ImportError as error:
        raise ImportError(f"mitsuba: not installed ({error}); pip install mitsuba") from error
    try:
        mi.set_variant(VARIANT)
        mi.set_log_level(mi.LogLevel.Error)  # the sampler warns whenever it rounds a count up
        dr.eval(mi.Float(1.0) + dr.opaque(mi.Float, 1.0))  # LLVM is looked for at the first array
        version = dr.detail.llvm_version()
    except Exception as error:
        raise RuntimeError(f"mitsuba: no LLVM ({error}); install libllvm or set DRJIT_LIBLLVM_PATH") from error
    if version[0] < LLVM:
        raise RuntimeError(
            f"mitsuba: expected LLVM {LLVM} or newer, got {version}; install one or set DRJIT_LIBLLVM_PATH"
        )
    return mi, dr


def sky_image(radiance: Tensor) -> Tensor:
    """Return the image (h, w, C) of an environment as Mitsuba's `envmap` takes it, (2 h + 1, w, C).

    Mitsuba has the first and the last row at the poles and all others evenly between. In edgegrad the centres of texels lie half
    a row off the poles, so an unchanged image would be stretched by h / (h − 1). Here every second row is one of the image, and
    both interpolate alike.
    """
    between = (radiance[1:] + radiance[:-1]) / 2
    poles_and_between = torch.cat([radiance[:1], between, radiance[-1:]])
    rows = torch.stack([poles_and_between[:-1], radiance], 1).flatten(0, 1)
    return torch.cat([rows, poles_and_between[-1:]])


def sky(mi: Any, radiance: Tensor) -> dict[str, Any]:
    """Return an `envmap` of the image (h, w, C) of an environment, turned by half a turn to edgegrad's axes."""
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    return {"type": "envmap", "bitmap": mi.Bitmap(sky_image(radiance).float().numpy()), "to_world": turned}


def sensor(
    mi: Any, eye: tuple[float, ...], target: tuple[float, ...], fov_y: float, size: tuple[int, int]
) -> dict[str, Any]:
    """Return the camera of Camera.look_at with y up; `size` is (height, width), `fov_y` in degrees."""
    film = {"type": "hdrfilm", "width": size[1], "height": size[0], "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at(list(eye), list(target), [0, 1, 0])
    return {"type": "perspective", "fov": fov_y, "fov_axis": "y", "to_world": to_world, "film": film}


def bsdf_class(mi: Any, dr: Any) -> type:
    """Return edgegrad's Material as a plugin, for any variant of Mitsuba.

    It is glTF's model (appendix B) with correlated masking (Heitz 2014, eq. 99), or Lambert's where `roughness` is negative,
    under an optional normal map with the shadow terminator of Chiang, Li and Burley (2019). Mitsuba's `principled` mixes a
    metal and a dielectric, not their reflectances: at metallic 0.8 that is a tenth brighter. Directions are drawn by the
    visible normals in a share (1 + metallic) / 2, else by the cosine; how they are drawn is not differentiated.
    """

    class MetallicRoughness(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.base_color = mi.Color3f(*(props[f"base_color{c}"] for c in range(3)))
            self.metallic, self.roughness = mi.Float(props["metallic"]), mi.Float(props["roughness"])
            self.glossy, self.two_sided, self.map = props["roughness"] >= 0, props["two_sided"], None
            if "normal_map" in props:
                self.map = props["normal_map"]
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
            self.m_flags = self.m_components[0]

        def traverse(self, callback: Any) -> None:
            for name in ("base_color", "metallic", "roughness"):
                callback.put(name, getattr(self, name), mi.ParamFlags.Differentiable)

        def _alpha(self) -> Any:
            return dr.maximum(dr.square(self.roughness), LEAST_ALPHA)

        def _lobe(self) -> tuple[Any, Any]:
            """Return the distribution of visible normals and the share of samples drawn by it."""
            alpha, share = dr.detach(self._alpha()), dr.detach(0.5 + 0.5 * self.metallic)
            return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, alpha), share

        def _frame(self, si: Any, active: Any) -> tuple[Any, Any]:
            """Return the sign of the visible side, and the frame of the mapped normal there, on the front."""
            side = dr.select(si.wi.z > 0, mi.Float(1), mi.Float(-1))
            if self.map is None:
                return side, mi.Frame3f(mi.Normal3f(0, 0, 1))
            return side, mi.Frame3f(dr.normalize(mi.Normal3f(2 * self.map.eval_3(si, active) - 1)))

        def sample(self, ctx: Any, si: Any, one: Any, two: Any, active: Any = True) -> Any:
            side, frame = self._frame(si, active)
            l = mi.warp.square_to_cosine_hemisphere(two)
            if self.glossy:
                lobe, share = self._lobe()
                v = frame.to_local(side * si.wi)
                h, _ = lobe.sample(v, two)
                l = dr.select(one < share, mi.reflect(v, h), l)
            sample = dr.zeros(mi.BSDFSample3f)
            sample.wo, sample.eta = side * frame.to_world(l), 1.0
            value, sample.pdf = self.eval_pdf(ctx, si, sample.wo, active)
            sample.sampled_type, sample.sampled_component = mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(0)
            return sample, dr.select(sample.pdf > 0, value / dr.select(sample.pdf > 0, sample.pdf, 1.0), 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            side, frame = self._frame(si, active)
            gv, gl = side * si.wi.z, side * wo.z  # by the normal of the face
            v, l = frame.to_local(side * si.wi), frame.to_local(side * wo)
            nl = l.z
            above = active & (gl > 0) & (nl > 0) & (gv > 0)
            above &= mi.Mask(True) if self.two_sided else si.wi.z > 0
            f, pdf = self.base_color / math.pi, nl / math.pi
            if self.glossy:
                lobe, share = self._lobe()
                h = dr.normalize(v + l)
                a2, vh, nv = dr.square(self._alpha()), dr.dot(v, h), dr.maximum(v.z, 0)
                D = a2 / (math.pi * dr.square(h.x * h.x + h.y * h.y + a2 * h.z * h.z))
                masking = 0.5 / (nl * dr.sqrt(a2 + (1 - a2) * nv * nv) + nv * dr.sqrt(a2 + (1 - a2) * nl * nl))
                f0 = DIELECTRIC + (self.base_color - DIELECTRIC) * self.metallic
                fresnel = f0 + (1 - f0) * (1 - vh) ** 5
                f = (1 - fresnel) * self.base_color * (1 - self.metallic) / math.pi + fresnel * D * masking
                pdf = (1 - share) * pdf + share * lobe.pdf(v, h) / (4 * vh)
            if self.map is not None:
                G = dr.clip(gl / (dr.maximum(frame.n.z, 1e-6) * dr.maximum(nl, 1e-12)), 0, 1)
                f = f * (G + G * G - G * G * G)
            return dr.select(above, f * nl, mi.Color3f(0.0)), dr.select(above, pdf, 0.0)

        def to_string(self) -> str:
            return "MetallicRoughness[]"

    return MetallicRoughness


def bsdf(base_color: Sequence[float], metallic: float, roughness: float, two_sided: bool = False) -> dict[str, Any]:
    """Return the description of a material by the plugin BSDF, which `register` makes known."""
    colors = {f"base_color{c}": float(value) for c, value in enumerate(base_color)}
    return {"type": BSDF, "metallic": metallic, "roughness": roughness, "two_sided": two_sided, **colors}


def register(mi: Any, dr: Any) -> None:
    """Make the plugin BSDF known to the present variant."""
    mi.register_bsdf(BSDF, bsdf_class(mi, dr))


class Mitsuba:
    """One Mitsuba integrator ("direct_projective" or "prb_projective") on one edgegrad scene, before one camera.

    adjoint   (H, W, 3)   ∂loss/∂image, the constant that the image is multiplied with
    boundary  False leaves out what moves at silhouettes (sppp = 0)
    interior  False leaves out the inside of faces (sppc = 0); so it is anyway where no radiance varies over a face
    guiding   of lit scenes: an octree guides the samples of shadow boundaries
    objects   number of meshes, the first ones, whose gradient is wanted; all when None
    bounces   of lit scenes: how often light is scattered; more than once by prb_projective alone
    compile_seconds  seconds that first calls took longer than second ones; little where Dr.Jit finds kernels on disk (~/.drjit)

    These are its best settings: it stops at the first hit, takes no indirect boundary samples (nor guiding, which serves only
    those), uses the stratified sampler "multijitter", and takes SPLIT interior samples for each boundary sample. In lit scenes
    it stops at the first light and takes as many indirect boundary samples as interior ones. The shadows of point lights have
    no gradient there, since Mitsuba finds their borders from points on emitters.
    It is biased where radiance jumps across an edge that two faces share. Mitsuba samples no such crease, and at a silhouette
    may take the colour of the face behind it (colours of faces: a cube was 85 % off).

    Raises ImportError without Mitsuba, RuntimeError without LLVM, ValueError for scenes that Mitsuba cannot show.
    """

    def __init__(
        self,
        scene: Scene,
        camera: Camera,
        adjoint: Tensor,
        integrator: str,
        boundary: bool = True,
        interior: bool = True,
        guiding: bool = False,
        objects: int | None = None,
        bounces: int = 1,
    ) -> None:
        if integrator not in INTEGRATORS:
            raise ValueError(f"integrator: expected one of {', '.join(INTEGRATORS)}, got {integrator!r}")
        if bounces > 1 and integrator == "direct_projective":
            raise ValueError(f"bounces: expected 1 of direct_projective, got {bounces}; prb_projective has more")
        if scene.channels != 3:
            raise ValueError(f"scene: expected 3 channels, got {scene.channels}; not supported by this peer")
        background = torch.zeros(3) if scene.background is None else scene.background
        if background.dim() != 1:
            raise ValueError("background: expected one colour (3,), got an image; not supported by this peer")
        self.mi, self.dr = mi, dr = load()
        dr.set_thread_count(torch.get_num_threads())
        self.compile_seconds = 0.0
        self._boundary = boundary
        self._lit = scene.is_lit
        self._interior = interior and any(
            m.material is not None or m.colors is not None or m.corner_colors is not None or m.texture is not None
            for m in scene.meshes
        )
        scene, camera, self._scale = resized(scene, camera)
        self._warm: set[tuple[int, int, int]] = set()
        self._integrator = mi.load_dict({"type": integrator, "sppi": 0, "guiding": "octree" if guiding else "none"})
        # An attribute, as direct_projective overrides the setting.
        self._integrator.max_depth = bounces + 1 if self._lit else 1
        self._integrator.sample_border_warning = False  # only for filters wider than a pixel
        self._scene = mi.load_dict(describe(mi, dr, scene, camera, background, self._scale))
        self._params = mi.traverse(self._scene)
        self._keys = [f"mesh{i}.vertex_positions" for i in range(len(scene.meshes[:objects]))]
        self._verts = [dr.detach(mi.Float(self._params[key])) for key in self._keys]
        self._adjoint = mi.TensorXf(float_array(adjoint))
        dr.eval(self._verts, self._adjoint)

    def image(self, spp: int, seed: int = 0) -> Tensor:
        """The image (H, W, 3), float64."""
        image = self.mi.render(self._scene, integrator=self._integrator, spp=spp, seed=seed)
        return torch.from_numpy(np.array(image)).double()

    def gradient(self, samples: float, seed: int, primal_spp: int = 16) -> tuple[list[Tensor], float]:
        """∂(sum of image · adjoint)/∂verts, (V, 3) float64 for each mesh, and the wall seconds of one step of an optimisation:
        vertices set and the ray structure built anew, image, derivatives.

        samples  interior samples a pixel; a SPLITth of that at boundaries. Whole numbers, at least one, as Mitsuba has it; the
                 sampler may round them up a little (32 to 35; squares stay)
        seed     another seed, another independent estimate
        """
        sppc = max(1, round(samples)) if self._interior else 0
        sppp = max(1, round(samples / SPLIT)) if self._boundary else 0
        # As attributes: numbers given to mi.render would hold for both kinds of samples.
        self._integrator.sppc, self._integrator.sppp = sppc, sppp
        self._integrator.sppi = max(1, round(samples)) if self._lit and self._boundary else 0
        self._scene.sensors()[0].sampler().set_sample_count(primal_spp)
        first = None
        if (sppc, sppp, primal_spp) not in self._warm:  # Dr.Jit's kernels hold these numbers
            first = self._step(seed)[1]
            self._warm.add((sppc, sppp, primal_spp))
        grads, seconds = self._step(seed)
        self.compile_seconds += max(0.0, first - seconds) if first is not None else 0.0
        return [self._scale * torch.from_numpy(np.array(g)).double().reshape(-1, 3) for g in grads], seconds

    def _step(self, seed: int) -> tuple[list[Any], float]:
        mi, dr = self.mi, self.dr
        dr.sync_thread()
        begin = time.perf_counter()
        for key, verts in zip(self._keys, self._verts, strict=True):
            moved = mi.Float(verts)
            dr.enable_grad(moved)
            self._params[key] = moved
        self._params.update()
        if self._integrator.sppc + self._integrator.sppp == 0:
            return [dr.zeros(mi.Float, dr.width(verts)) for verts in self._verts], time.perf_counter() - begin
        image = mi.render(self._scene, self._params, integrator=self._integrator, seed=2 * seed, seed_grad=2 * seed + 1)
        dr.backward(dr.sum(image * self._adjoint, axis=None))
        grads = [dr.grad(self._params[key]) for key in self._keys]
        dr.eval(grads)
        dr.sync_thread()
        return grads, time.perf_counter() - begin
