"""Mitsuba's integrator "path" on scenes of room_scenes.py: images that know nothing of edgegrad.

Where materials are Lambertian without a normal map they are Mitsuba's own. Others use the plugin of benchmarks/mitsuba.py, for
Mitsuba has neither correlated masking nor glTF's layers, nor a shadow terminator.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg
from benchmarks import mitsuba


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
        mitsuba.register(mi, dr)
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
        if isinstance(light, eg.lights.Environment):
            if light.radiance.dim() == 1:
                return {"type": "constant", "radiance": self._rgb(light.radiance)}
            return mitsuba.sky(mi, light.radiance)
        power = torch.as_tensor(light.intensity) * (1.0 if light.color is None else light.color)
        if isinstance(light, eg.lights.PointLight):
            return {"type": "point", "position": light.position.tolist(), "intensity": self._rgb(power)}
        if isinstance(light, eg.lights.DirectionalLight):
            return {"type": "directional", "direction": light.direction.tolist(), "irradiance": self._rgb(power)}
        assert isinstance(light, eg.lights.SpotLight)
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
        found = mitsuba.bsdf(values, metallic, roughness if material.is_glossy else -1.0, material.two_sided)
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
