"""Scenes and cameras of edgegrad as descriptions for Mitsuba 3, in which unlit radiance is an emitter on both sides of a mesh."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.scene.environment import Environment
from edgegrad.scene.lights import PointLight
from edgegrad.scene.material import Material, Texture
from edgegrad.scene.mesh import DEFAULT_RADIANCE, Mesh
from edgegrad.scene.scene import Scene

# Radius of a scene in Mitsuba, which steps off silhouettes by lengths in world units: too long for an object of 0.1.
RADIUS = 10.0


def describe(mi: Any, dr: Any, scene: Scene, camera: Camera, background: Tensor, scale: float) -> dict[str, Any]:
    """Return the description of a scene that resized() scaled. Raises ValueError for what Mitsuba cannot show."""
    return {
        "type": "scene",
        "camera": _sensor(mi, scene, camera),
        **_lights(mi, scene, background, scale),
        **{f"mesh{i}": _shape(mi, dr, mesh, f"mesh{i}", scene.is_lit) for i, mesh in enumerate(scene.meshes)},
    }


def resized(scene: Scene, camera: Camera) -> tuple[Scene, Camera, float]:
    """Return the same view of the scene, centred and scaled to the radius RADIUS, and the scale."""
    meshes = [mesh.replace(verts=mesh.verts.detach().cpu().double()) for mesh in scene.meshes]
    verts = torch.cat([mesh.verts for mesh in meshes])
    center = verts.mean(0)
    scale = RADIUS / max(float((verts - center).norm(dim=1).max()), 1e-30)
    M = camera.world_to_camera.detach().cpu().double().clone()
    M[..., :3, 3] = scale * (M[..., :3, :3] @ center + M[..., :3, 3])
    moved = [mesh.replace(verts=scale * (mesh.verts - center)) for mesh in meshes]
    lights = [light.transformed(t=-center).transformed(scale=scale) for light in scene.lights]
    return scene.replace(meshes=moved, lights=lights), camera.replace(world_to_camera=M), scale


def _sensor(mi: Any, scene: Scene, camera: Camera) -> dict[str, Any]:
    if camera.projection != "perspective" or camera.lens != "pinhole" or camera.batch is not None:
        raise ValueError(f"camera: expected a single perspective camera, got {camera!r}; not supported by this peer")
    K, (H, W) = camera.K.detach().cpu().double(), camera.size
    if not torch.allclose(K[0, 0], K[1, 1], rtol=1e-6) or K[0, 1] != 0 or K[1, 0] != 0:
        raise ValueError(f"camera: expected fx = fy without skew, got K {K.tolist()}; not supported by this peer")
    M = camera.world_to_camera.detach().cpu().double()
    # Mitsuba's camera looks along +Z with +X to the left and +Y up.
    to_world = torch.linalg.inv(M) @ torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    depth = torch.cat([m.verts.detach().cpu().double() @ M[2, :3] + M[2, 3] for m in scene.meshes])
    far = 2.0 * float(depth.max())
    near = max(0.5 * float(depth.min()), 1e-4 * far)
    return {
        "type": "perspective",
        "to_world": mi.ScalarTransform4f(to_world.numpy()),
        "fov": math.degrees(2.0 * math.atan(0.5 * W / float(K[0, 0]))),
        "fov_axis": "x",
        "principal_point_offset_x": 0.5 - float(K[0, 2]) / W,
        "principal_point_offset_y": 0.5 - float(K[1, 2]) / H,
        "near_clip": near,
        "far_clip": far,
        "film": {
            "type": "hdrfilm", "width": W, "height": H, "pixel_format": "rgb", "component_format": "float32",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": 1},
    }  # fmt: skip


def _rgb(color: Tensor) -> dict[str, Any]:
    return {"type": "rgb", "value": color.detach().cpu().double().tolist()}


def _lights(mi: Any, scene: Scene, background: Tensor, scale: float) -> dict[str, Any]:
    """Return lights other than emissive meshes. A black background is left out, so that no light samples go there."""
    found: dict[str, Any] = {}
    for i, light in enumerate(scene.lights):
        if isinstance(light, PointLight):
            color = torch.ones(3) if light.color is None else light.color.expand(3)
            power = torch.as_tensor(light.intensity).detach() * color
            position = light.position.detach().cpu().double().tolist()
            found[f"light{i}"] = {"type": "point", "position": position, "intensity": _rgb(power)}
        elif (
            isinstance(light, Environment) and light.radiance.dim() == 1 and scene.background is None and light.visible
        ):
            found[f"light{i}"] = {"type": "constant", "radiance": _rgb(light.radiance.expand(3))}
        else:
            raise ValueError(
                f"lights[{i}]: expected points, or a constant environment that is seen, got {light!r}; not supported by this peer"
            )
    if not scene.is_lit or bool((background != 0).any()):
        found["background"] = {"type": "constant", "radiance": _rgb(background)}
    return found


def float_array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().float().contiguous().numpy()


def _by_vertex(verts: int, faces: Tensor, corners: Tensor) -> Tensor | None:
    """Return values of corners (F, 3, n) as values of vertices (V, n), or None where the corners of a vertex differ."""
    values = corners.new_zeros((verts, corners.shape[-1]))
    values[faces] = corners
    return values if torch.equal(values[faces], corners) else None


def _shape(mi: Any, dr: Any, mesh: Mesh, name: str, lit: bool) -> Any:
    """A mesh as an emitter of its colours. Vertices are never split, nor faces turned: Mitsuba would take a seam, or an edge
    that both its faces run along in one direction, for two open borders."""
    verts, faces = mesh.verts.detach().cpu().double(), mesh.faces.cpu().long()
    attributes: dict[str, Tensor] = {}
    uvs, radiance = None, _rgb(torch.full((3,), DEFAULT_RADIANCE))
    if mesh.texture is not None:
        assert mesh.uvs is not None and mesh.uv_faces is not None
        radiance = {
            "type": "bitmap", "data": mi.TensorXf(float_array(mesh.texture.flip(0))), "raw": True, "format": "variant",
            "filter_type": "bilinear", "wrap_mode": "repeat",
        }  # fmt: skip
        corners = mesh.uvs.detach().cpu().double()[mesh.uv_faces.cpu().long()]
        uvs = _by_vertex(len(verts), faces, corners)
        if uvs is None:
            attributes = {"face_u": corners[..., 0], "face_v": corners[..., 1]}
            radiance = _seamed(mi, mi.load_dict(radiance))
    elif mesh.face_colors is not None:
        attributes["face_color"] = mesh.face_colors
    elif mesh.colors is not None:
        attributes["vertex_color"] = mesh.colors
    elif mesh.corner_colors is not None:
        colors = _by_vertex(len(verts), faces, mesh.corner_colors.detach().cpu())
        if colors is None:
            raise ValueError("corner_colors: expected one colour a vertex, got creases; not supported by this peer")
        attributes["vertex_color"] = colors
    if "face_color" in attributes or "vertex_color" in attributes:
        radiance = {"type": "mesh_attribute", "name": next(iter(attributes))}

    props = mi.Properties()
    props["face_normals"] = True
    if mesh.material is not None or (lit and mesh.colors is not None and not bool((mesh.colors != 0).any())):
        _material(mi, props, mesh)
        return _filled(mi, props, name, verts, faces)
    props["bsdf"] = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}})
    props["emitter"] = _two_sided(mi, dr, mi.load_dict(radiance) if isinstance(radiance, dict) else radiance)
    shape = _filled(mi, props, name, verts, faces, uvs)
    for key, values in attributes.items():
        shape.add_attribute(key, 3, float_array(values).ravel())
    return shape


def _material(mi: Any, props: Any, mesh: Mesh) -> None:
    """Set a two-sided Lambertian constant, emission from the front of a black surface, or black."""
    material = Material(base_color=0.0) if mesh.material is None else mesh.material
    given = [
        1.0 if material.base_color is None else material.base_color,
        0.0 if material.emission is None else material.emission,
    ]
    plain = not material.is_glossy and mesh.normals is None
    plain &= mesh.material is None or (mesh.colors is None and mesh.texture is None)
    plain &= not any(isinstance(value, Texture) or torch.as_tensor(value).dim() > 1 for value in given)
    if not plain or (material.emission is None) != material.two_sided:
        raise ValueError(
            "material: expected a Lambertian constant of both sides, or emission from the front; not supported by this peer"
        )
    base, emission = (torch.as_tensor(value).detach().cpu().expand(3) for value in given)
    diffuse = {"type": "diffuse", "reflectance": _rgb(base)}
    props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": diffuse} if material.two_sided else diffuse)
    if material.emission is not None:
        props["emitter"] = mi.load_dict({"type": "area", "radiance": _rgb(emission)})


def _filled(mi: Any, props: Any, name: str, verts: Tensor, faces: Tensor, uvs: Tensor | None = None) -> Any:
    shape = mi.Mesh(name, len(verts), len(faces), props, has_vertex_texcoords=uvs is not None)
    params = mi.traverse(shape)
    params["vertex_positions"] = mi.Float(float_array(verts).ravel())
    params["faces"] = mi.UInt32(faces.numpy().astype(np.uint32).ravel())
    if uvs is not None:
        params["vertex_texcoords"] = mi.Float(float_array(uvs).ravel())
    params.update()
    return shape


def _two_sided(mi: Any, dr: Any, radiance: Any) -> Any:
    """Return an emitter that shines on both sides: Mitsuba's "area" is black from behind, which open meshes show."""

    class TwoSided(mi.Emitter):
        def __init__(self, props: Any) -> None:
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Surface

        def eval(self, si: Any, active: Any = True) -> Any:
            return radiance.eval(si, active)

        # Traced into prb_projective's loop, though a path that ends at its first hit samples no lights.

        def sample_direction(self, it: Any, sample: Any, active: Any = True) -> Any:
            return dr.zeros(mi.DirectionSample3f), mi.Color3f(0.0)

        def pdf_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Float(0.0)

        def eval_direction(self, it: Any, ds: Any, active: Any = True) -> Any:
            return mi.Color3f(0.0)

        def to_string(self) -> str:
            return "TwoSided[]"

    return TwoSided(mi.Properties())


def _seamed(mi: Any, bitmap: Any) -> Any:
    """Return a texture whose coordinates belong to corners, as attributes face_u and face_v of the mesh."""

    class Seamed(mi.Texture):
        def __init__(self, props: Any) -> None:
            mi.Texture.__init__(self, props)

        def eval(self, si: Any, active: Any = True) -> Any:
            u, v = (si.shape.eval_attribute_3(key, si, active) for key in ("face_u", "face_v"))
            inside = mi.Vector3f(
                1.0 - si.uv.x - si.uv.y, si.uv.x, si.uv.y
            )  # barycentric, as the mesh has no coordinates
            looked_up = mi.SurfaceInteraction3f(si)
            looked_up.uv = mi.Point2f(sum(u[k] * inside[k] for k in range(3)), sum(v[k] * inside[k] for k in range(3)))
            return bitmap.eval(looked_up, active)

        def is_spatially_varying(self) -> bool:
            return False  # True would let prb_projective look for points by coordinates, which the mesh has not

        def to_string(self) -> str:
            return "Seamed[]"

    return Seamed(mi.Properties())
