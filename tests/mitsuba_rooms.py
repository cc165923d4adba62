"""Mitsuba's integrator "path" on scenes of room_scenes.py: images that know nothing of edgegrad.

Where materials are Lambertian without a normal map they are Mitsuba's own; else a BSDF of ours in its language, for Mitsuba has
neither correlated masking nor glTF's layers, nor a shadow terminator.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg
from benchmarks.error_time import mitsuba
from benchmarks.error_time.mitsuba import sky_image
from edgegrad.light.bsdf import DIELECTRIC, LEAST_ALPHA


def bsdf_class(mi: Any, dr: Any) -> type:
    """glTF's metallic-roughness model (appendix B) with correlated masking (Heitz 2014, eq. 99), or Lambert's, under a normal
    map, with a shadow terminator (Chiang, Li and Burley 2019)."""

    class Scattering(mi.BSDF):
        def __init__(self, props: Any) -> None:
            mi.BSDF.__init__(self, props)
            self.base, self.metallic = mi.Color3f(*(props[f"base{c}"] for c in range(3))), props["metallic"]
            self.two_sided, self.glossy, self.map = props["two_sided"], props["roughness"] >= 0, None
            if "normal_map" in props:
                self.map = props["normal_map"]
            if self.glossy:
                self.alpha = max(props["roughness"] ** 2, LEAST_ALPHA)
                self.facets = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, self.alpha, sample_visible=True)
            self.m_components = [mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide]
            self.m_flags = self.m_components[0]

        def _frame(self, si: Any, active: Any) -> tuple[Any, Any]:
            """The side that is seen, and the frame of the normal there, on the front."""
            side = dr.select(si.wi.z > 0, mi.Float(1), mi.Float(-1))
            if self.map is None:
                return side, mi.Frame3f(mi.Normal3f(0, 0, 1))
            return side, mi.Frame3f(dr.normalize(mi.Normal3f(2 * self.map.eval_3(si, active) - 1)))

        def sample(self, ctx: Any, si: Any, one: Any, two: Any, active: Any = True) -> Any:
            """Half by the cosine, half by the microfacets that are seen."""
            side, frame = self._frame(si, active)
            l = mi.warp.square_to_cosine_hemisphere(two)
            if self.glossy:
                v = frame.to_local(side * si.wi)
                h, _ = self.facets.sample(v, two)
                l = dr.select(one < 0.5, l, mi.reflect(v, h))
            sample = mi.BSDFSample3f()
            sample.wo = side * frame.to_world(l)
            value, pdf = self.eval_pdf(ctx, si, sample.wo, active)
            sample.pdf, sample.eta = pdf, 1.0
            sample.sampled_type, sample.sampled_component = mi.UInt32(+mi.BSDFFlags.GlossyReflection), mi.UInt32(0)
            return sample, dr.select(pdf > 0, value / dr.select(pdf > 0, pdf, 1.0), 0.0)

        def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[0]

        def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            return self.eval_pdf(ctx, si, wo, active)[1]

        def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
            side, frame = self._frame(si, active)
            gv, gl = side * si.wi.z, side * wo.z  # by the normal of the face
            v, l = frame.to_local(side * si.wi), frame.to_local(side * wo)
            nv, nl = v.z, l.z
            above = active & (gl > 0) & (nl > 0) & (gv > 0)
            above &= mi.Mask(True) if self.two_sided else si.wi.z > 0
            f, pdf = self.base / math.pi, nl / math.pi
            if self.glossy:
                h = dr.normalize(v + l)
                a2, vh, nv = self.alpha**2, dr.dot(v, h), dr.maximum(nv, 0)
                D = a2 / (math.pi * dr.square(h.x * h.x + h.y * h.y + a2 * h.z * h.z))
                masking = 0.5 / (nl * dr.sqrt(a2 + (1 - a2) * nv * nv) + nv * dr.sqrt(a2 + (1 - a2) * nl * nl))
                f0 = DIELECTRIC + (self.base - DIELECTRIC) * self.metallic
                fresnel = f0 + (1 - f0) * (1 - vh) ** 5
                f = (1 - fresnel) * self.base * (1 - self.metallic) / math.pi + fresnel * D * masking
                pdf = 0.5 * pdf + 0.5 * self.facets.pdf(v, h) / (4 * vh)
            if self.map is not None:
                G = dr.clip(gl / (dr.maximum(frame.n.z, 1e-6) * dr.maximum(nl, 1e-12)), 0, 1)
                f = f * (G + G * G - G * G * G)
            return dr.select(above, f * nl, mi.Color3f(0.0)), dr.select(above, pdf, 0.0)

        def to_string(self) -> str:
            return "Scattering[]"

    return Scattering


def spot_class(mi: Any, dr: Any) -> type:
    """glTF's (KHR_lights_punctual): Mitsuba's own falls off differently."""

    class Spot(mi.Emitter):
        def __init__(self, props: Any) -> None:
            mi.Emitter.__init__(self, props)
            self.place = mi.Point3f(*(props[f"position{c}"] for c in range(3)))
            self.axis = mi.Vector3f(*(props[f"direction{c}"] for c in range(3)))
            self.power = mi.Color3f(*(props[f"intensity{c}"] for c in range(3)))
            self.inner, self.outer = props["inner"], props["outer"]
            self.m_flags = mi.EmitterFlags.DeltaPosition

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.time, ds.pdf, ds.delta, ds.emitter = self.place, it.time, 1.0, True, mi.EmitterPtr(self)
            away = it.p - ds.p
            ds.dist = dr.norm(away)
            ds.d = -away / ds.dist
            ramp = dr.square(dr.clip((dr.dot(-ds.d, self.axis) - self.outer) / (self.inner - self.outer), 0, 1))
            return ds, self.power * ramp / dr.square(ds.dist)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def eval(self, si: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def bbox(self) -> Any:
            return mi.BoundingBox3f(self.place)

        def to_string(self) -> str:
            return "Spot[]"

    return Spot


class MitsubaRoom:
    """A scene as Mitsuba sees it, and how its light is scattered at most `bounces` times.

    Raises ImportError without Mitsuba, RuntimeError without LLVM.
    """

    def __init__(self, scene: eg.Scene, camera: eg.Camera, bounces: int, sampler: str = "independent") -> None:
        self._mi, self._dr = mi, dr = mitsuba.load()
        dr.set_thread_count(torch.get_num_threads())
        mi.register_bsdf("gltf", bsdf_class(mi, dr))
        mi.register_emitter("gltf_spot", spot_class(mi, dr))
        w2c, (height, width) = camera.world_to_camera.double().numpy(), camera.size
        # Both look along +Z; Mitsuba has +X left and +Y up.
        to_world = np.linalg.inv(w2c) @ np.diag([-1.0, -1.0, 1.0, 1.0])
        fov = 2 * np.rad2deg(np.arctan(width / 2 / float(camera.K[0, 0])))
        parts = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": bounces + 1},
            "sensor": {
                "type": "perspective", "fov": float(fov), "fov_axis": "x", "to_world": mi.ScalarTransform4f(to_world),
                "film": {
                    "type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
                    "pixel_format": "rgb", "component_format": "float32",
                },
                "sampler": {"type": sampler, "sample_count": 1},
            },
        }  # fmt: skip
        parts |= {f"light{i}": self._light(light) for i, light in enumerate(scene.lights)}
        self._scene = mi.load_dict(parts | {f"mesh{i}": self._shape(f"mesh{i}", m) for i, m in enumerate(scene.meshes)})

    def _light(self, light: Any) -> Any:
        mi = self._mi
        if isinstance(light, eg.Environment):
            if light.radiance.dim() == 1:
                return {"type": "constant", "radiance": self._rgb(light.radiance)}
            bitmap = mi.Bitmap(sky_image(light.radiance).float().numpy())
            return {
                "type": "envmap",
                "bitmap": bitmap,
                "to_world": mi.ScalarTransform4f().rotate([0, 1, 0], 180),
            }
        power = torch.as_tensor(light.intensity) * (1.0 if light.color is None else light.color)
        if isinstance(light, eg.PointLight):
            return {"type": "point", "position": light.position.tolist(), "intensity": self._rgb(power)}
        if isinstance(light, eg.DirectionalLight):
            return {"type": "directional", "direction": light.direction.tolist(), "irradiance": self._rgb(power)}
        assert isinstance(light, eg.SpotLight)
        axis = torch.nn.functional.normalize(light.direction.double(), dim=0)
        given = {"position": light.position, "direction": axis, "intensity": power.double().expand(3)}
        props = {f"{name}{c}": float(x) for name, value in given.items() for c, x in enumerate(value)}
        cosines = {name: math.cos(float(getattr(light, f"{name}_angle"))) for name in ("inner", "outer")}
        return {"type": "gltf_spot", **props, **cosines}

    def _rgb(self, value: Tensor) -> dict[str, Any]:
        return {"type": "rgb", "value": value.double().expand(3).tolist()}

    def _texture(self, texture: eg.Texture) -> dict[str, Any]:
        assert texture.filter == "linear" and texture.wrap == "repeat" and texture.uvs is None
        data = self._mi.TensorXf(np.ascontiguousarray(texture.image.flip(0).float().numpy()))
        return {"type": "bitmap", "data": data, "raw": True, "format": "variant", "wrap_mode": "repeat"}

    def _bsdf(self, material: eg.Material) -> dict[str, Any]:
        base = material.base_color
        if not material.is_glossy and material.normal_map is None:
            color = self._texture(base) if isinstance(base, eg.Texture) else self._rgb(torch.as_tensor(base))
            diffuse = {"type": "diffuse", "reflectance": color}
            return {"type": "twosided", "bsdf": diffuse} if material.two_sided else diffuse
        values = torch.as_tensor(base).double().expand(3).tolist()
        metallic, roughness = (float(torch.as_tensor(x)) for x in (material.metallic or 0.0, material.roughness or 1.0))
        found: dict[str, Any] = {f"base{c}": x for c, x in enumerate(values)}
        found |= {"type": "gltf", "two_sided": material.two_sided, "metallic": metallic}
        found["roughness"] = roughness if material.is_glossy else -1.0
        if material.normal_map is not None:
            found["normal_map"] = self._texture(material.normal_map)
        return found

    def _shape(self, name: str, mesh: eg.Mesh) -> Any:
        mi, material = self._mi, mesh.material
        assert material is not None and mesh.normals is None and mesh.alpha is None
        props = mi.Properties()
        props["face_normals"] = True
        props["bsdf"] = mi.load_dict(self._bsdf(material))
        if material.emission is not None:
            props["emitter"] = mi.load_dict({"type": "area", "radiance": self._rgb(torch.as_tensor(material.emission))})
        uvs = mesh.uvs
        shape = mi.Mesh(name, len(mesh.verts), len(mesh.faces), props=props, has_vertex_texcoords=uvs is not None)
        params = mi.traverse(shape)
        params["vertex_positions"] = mi.Float(mesh.verts.float().numpy().ravel())
        params["faces"] = mi.UInt32(mesh.faces.numpy().astype(np.uint32).ravel())
        if uvs is not None:
            assert mesh.uv_faces is not None and torch.equal(mesh.uv_faces, mesh.faces)
            params["vertex_texcoords"] = mi.Float(uvs.float().numpy().ravel())
        params.update()
        return shape

    def render(self, spp: int, seed: int) -> Tensor:
        """(H, W, 3)."""
        return torch.from_numpy(np.array(self._mi.render(self._scene, spp=spp, seed=seed)))
