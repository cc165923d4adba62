"""Default pictures of a scene: a view of all of it, plain meshes under a headlight, small pictures for notebooks."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from .camera.camera import Camera
from .files.image import write_image
from .render import render
from .scene.lights import DirectionalLight
from .scene.material import Material
from .scene.mesh import Mesh
from .scene.scene import Scene, as_scene

SIZE = (256, 256)
BACKGROUND = 0.8


def framing(
    scene: Scene,
    size: tuple[int, int],
    fov: float = 40.0,
    eye: Sequence[float] | None = None,
    target: Sequence[float] | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
) -> Camera:
    """Return a camera that sees the whole scene, from (0.5, 0.4, 0.77) of the middle of its box unless told otherwise."""
    verts = torch.cat([mesh.verts for mesh in scene.meshes]).double()
    low, high = verts.aminmax(dim=0)
    middle = (low + high) / 2 if target is None else torch.tensor(target).double()
    radius = float((verts - middle).norm(dim=1).max())
    if not 0.0 < fov < 180.0:
        raise ValueError(f"--fov: expected degrees between 0 and 180, got {fov:g}")
    narrow = math.atan(math.tan(math.radians(fov) / 2) * min(1.0, size[1] / size[0]))  # half the smaller field of view
    direction = torch.tensor([0.5, 0.4, 0.77]).double()
    distance = 1.02 * max(radius, 1e-30) / math.sin(narrow)
    place = middle + distance * direction / direction.norm() if eye is None else torch.tensor(eye).double()
    return Camera.look_at(place, middle, torch.tensor(up).double(), fov, size)


def under_headlight(scene: Scene, camera: Camera) -> Scene:
    """Return the scene with a light from behind the camera on meshes without a colour, which would be flat silhouettes; on all
    with a material where there is no light at all. It is the scene itself where nothing needs one."""
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


def thumbnail(scene: Scene | Mesh) -> bytes:
    """Return a small PNG of the whole scene, for notebooks."""
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        scene = as_scene(scene).detach().to("cpu")
        camera = framing(scene, SIZE)
        background = None if scene.background is None or scene.background.dim() == 3 else scene.background
        background = torch.full((scene.channels,), BACKGROUND) if background is None else background
        shown = under_headlight(scene.replace(background=background), camera)
        image = render(shown, camera, spp=8, seed=0, shadows=not shown.is_lit)
        image = image if image.shape[-1] in (1, 3) else image[..., :1]
        write_image(file := Path(folder) / "thumbnail.png", image.clamp(0.0, 1.0))
        return file.read_bytes()
