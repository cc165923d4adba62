"""Checks of what render() can differentiate where light is scattered more than once.

Every tensor of a scene has its derivative inside surfaces (csrc/shading/lit/path_radiance.h). The borders of lights' shadows
have theirs (indirect_shadows.py). So have secondary edges, and the lines along which surfaces pass through each other
(secondary_edges.py). Some discontinuities have no samples. Without them a gradient would be wrong without notice, so it is
refused.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..kernel.request import Request
from ..scene.environment import Environment
from ..scene.lights import DirectionalLight, PointLight, SpotLight
from ..scene.scene import Scene
from ..scene.tree import named_tensors
from .in_kernel import is_fused, nearest_textures


def check_bounces(scene: Scene, camera: Camera, request: Request) -> None:
    """Raise ValueError for scenes whose surfaces cannot light each other, and for derivatives that are not complete."""
    if not is_fused(scene):
        raise ValueError(
            'bounces: expected at most 16 channels, and no texture of the filter "nearest" where meshes blend, for light that '
            'is scattered more than once; filter="linear", or bounces=1'
        )
    if not request.gradient.visibility:
        return
    for name, tensor, where in _without_samples(scene, camera):
        if _has_derivative(tensor):
            raise _refused(name, where)


def _refused(name: str, where: str) -> ValueError:
    return ValueError(
        f"bounces: {name} requires a gradient, and where light is scattered more than once it has none {where}; give bounces=1, "
        "detach it, or leave out all that moves at borders with visibility=False. Colours, textures, roughness, normal maps, and "
        "how bright lights are and where, if they are no meshes, have whole gradients"
    )


def _without_samples(scene: Scene, camera: Camera) -> Iterator[tuple[str, Tensor, str]]:
    """Yield tensors that move discontinuities without samples: their names, and where these discontinuities are."""
    if scene.blends:
        for name, tensor in (*_moving(scene, camera), *_lights(scene)):
            yield name, tensor, "where one sees through surfaces"
    for number, mesh in enumerate(scene.meshes):
        for texture in nearest_textures(mesh):
            where = "at the borders of nearest texels"
            if texture.uvs is not None:
                yield f"uvs of a nearest texture of meshes[{number}]", texture.uvs, where
            elif mesh.uvs is not None:
                yield f"meshes[{number}].uvs", mesh.uvs, where


def _moving(scene: Scene, camera: Camera) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of camera and meshes, by name, that move discontinuities seen through alpha-blended faces."""
    yield from named_tensors(camera, "camera")
    for number, mesh in enumerate(scene.meshes):
        yield f"meshes[{number}].verts", mesh.verts
        if mesh.alpha is not None:
            yield f"meshes[{number}].alpha", mesh.alpha
            if mesh.uvs is not None:
                yield f"meshes[{number}].uvs", mesh.uvs


def _lights(scene: Scene) -> Iterator[tuple[str, Tensor]]:
    """Yield the tensors of lights, by name, that move the boundaries of their shadows."""
    for number, light in enumerate(scene.lights):
        name = f"lights[{number}]"
        if isinstance(light, DirectionalLight):
            yield f"{name}.direction", light.direction
        if isinstance(light, (PointLight, SpotLight)):
            yield f"{name}.position", light.position
        if isinstance(light, Environment) and light.rotation is not None:
            yield f"{name}.rotation", light.rotation


def _has_derivative(tensor: Tensor) -> bool:
    """Return whether the tensor itself has a derivative, while moves() says yes to all under torch.func."""
    if torch.is_grad_enabled() and tensor.requires_grad:
        return True
    dual = torch.autograd.forward_ad
    return dual._current_level >= 0 and dual.unpack_dual(tensor).tangent is not None
