"""Mitsuba's integrator "path" on scenes of room_scenes.py with Lambertian materials: images that know nothing of edgegrad."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

import edgegrad as eg


class MitsubaRoom:
    """A scene as Mitsuba's variant scalar_rgb sees it, which needs no LLVM. Raises ImportError where Mitsuba is not installed."""

    def __init__(self, scene: eg.Scene, camera: eg.Camera, bounces: int) -> None:
        self._mi = mi = importlib.import_module("mitsuba")
        mi.set_variant("scalar_rgb")
        mi.set_log_level(mi.LogLevel.Error)
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
                "sampler": {"type": "independent", "sample_count": 1},
            },
        }  # fmt: skip
        for i, light in enumerate(scene.lights):
            if isinstance(light, eg.PointLight):
                power = self._rgb(torch.as_tensor(light.intensity))
                parts[f"light{i}"] = {"type": "point", "position": light.position.tolist(), "intensity": power}
            else:
                assert isinstance(light, eg.Environment)
                parts[f"light{i}"] = {"type": "constant", "radiance": self._rgb(light.radiance)}
        self._scene = mi.load_dict(parts | {f"mesh{i}": self._shape(f"mesh{i}", m) for i, m in enumerate(scene.meshes)})

    def _rgb(self, value: Tensor) -> dict[str, Any]:
        return {"type": "rgb", "value": value.double().expand(3).tolist()}

    def _shape(self, name: str, mesh: eg.Mesh) -> Any:
        mi, material = self._mi, mesh.material
        assert material is not None and not material.is_glossy
        assert isinstance(material.base_color, (Tensor, float)) and isinstance(material.emission, (Tensor, type(None)))
        props = mi.Properties()
        props["face_normals"] = True
        diffuse = {"type": "diffuse", "reflectance": self._rgb(torch.as_tensor(material.base_color))}
        props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse} if material.two_sided else diffuse)
        if material.emission is not None:
            props["emitter"] = mi.load_dict({"type": "area", "radiance": self._rgb(material.emission)})
        shape = mi.Mesh(name, len(mesh.verts), len(mesh.faces), props=props)
        params = mi.traverse(shape)
        params["vertex_positions"] = mesh.verts.float().numpy().ravel()
        params["faces"] = mesh.faces.numpy().astype(np.uint32).ravel()
        params.update()
        return shape

    def render(self, spp: int, seed: int) -> Tensor:
        """(H, W, 3)."""
        return torch.from_numpy(np.array(self._mi.render(self._scene, spp=spp, seed=seed)))
