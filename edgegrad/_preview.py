"""Pictures that nobody described: plain meshes under a headlight, and small ones for notebooks."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import torch

from ._framing import framing
from .camera import Camera
from .image import write_image
from .lights import DirectionalLight
from .material import Material
from .scene import Scene

SIZE = (256, 256)
BACKGROUND = 0.8


def under_headlight(scene: Scene, camera: Camera) -> Scene:
    """The scene with a light from behind the camera on meshes that have no colour of their own, which would be flat silhouettes;
    on all that has a material where there is no light at all. Itself where nothing needs one."""
    plain = [mesh.material is None and mesh.channels is None for mesh in scene.meshes]
    emits = any(mesh.material is not None and mesh.material.emission is not None for mesh in scene.meshes)
    dark = scene.is_lit and not scene.lights and not emits
    if camera.batch is not None or not (dark or (any(plain) and not scene.is_lit)):
        return scene
    # Irradiance π on a matt surface that it meets head-on is radiance of its base colour.
    light = DirectionalLight(camera.world_to_camera[2, :3].detach(), math.pi)
    meshes = [
        mesh.replace(material=Material()) if is_plain else mesh
        for mesh, is_plain in zip(scene.meshes, plain, strict=True)
    ]
    return scene.replace(meshes=meshes, lights=[*scene.lights, light])


def thumbnail(scene: Scene) -> bytes:
    """A small PNG of the whole scene, for notebooks."""
    from .render import render  # which imports scenes

    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        scene = scene.detach().to("cpu")
        camera = framing(scene, SIZE)
        background = None if scene.background is None or scene.background.dim() == 3 else scene.background
        background = torch.full((scene.channels,), BACKGROUND) if background is None else background
        image = render(under_headlight(scene.replace(background=background), camera), camera, spp=8, shadows=False)
        image = image if image.shape[-1] in (1, 3) else image[..., :1]
        write_image(file := Path(folder) / "thumbnail.png", image.clamp(0.0, 1.0))
        return file.read_bytes()
