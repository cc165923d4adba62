"""Small renders of a mesh from all sides, and the rotations that they are made at."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from ....aovs import render_aovs
from ....camera.camera import Camera
from ....camera.poses import rotation
from ....files.image import linear_to_srgb
from ....scene.mesh import Mesh
from ....scene.scene import Scene
from ...placement import Pose
from ..camera_motion import cross_matrices
from ..settings import TEMPLATES
from ..task import PoseTask, focal_of


@dataclass(frozen=True)
class TemplateViews:
    """Renders at n rotations, of the object's centre in the middle of the image."""

    rotations: Tensor  # (n, 3, 3) float64, mesh to camera
    across: int  # pixels, the diagonal of the object's box
    alpha: Tensor  # (n, T, T)
    colors: Tensor  # (n, T, T, C), sRGB values; 1 where the mesh has no colours
    normals: Tensor  # (n, T, T, 3), in mesh axes

    @staticmethod
    def from_rotations(task: PoseTask, rotations: Tensor, pixels: int, seed: int) -> TemplateViews:
        """Render the object so many pixels large, as on the axis of the first picture's camera."""
        camera, side = task.shots[0].camera, pixels + 2 * round(TEMPLATES.ring * pixels)
        perspective = camera.projection != "orthographic"
        depth = 2.0 * task.size
        if perspective:
            depth = task.size * max(focal_of(camera) / (TEMPLATES.view_fill * min(camera.size)), TEMPLATES.least_depth)
        K = torch.eye(3, dtype=torch.float64)
        K[:2, :2] = camera.K[:2, :2] * (pixels / across(task, camera, depth))
        K[:2, 2] = 0.5 * side
        world = torch.eye(4, dtype=torch.float64).repeat(len(rotations), 1, 1)
        world[:, :3, :3] = rotations
        world[:, :3, 3] = world.new_tensor([0.0, 0.0, depth]) - rotations @ task.center
        cameras = Camera(world, K.repeat(len(rotations), 1, 1), (side, side), projection=camera.projection)
        scene, names = task.scene, ["alpha", "normal"]
        shape_only = task.colorless or task.aovs == ("alpha",)
        if shape_only:
            scene = Scene([Mesh(mesh.verts, mesh.faces) for mesh in scene.meshes])
        with torch.no_grad():
            seen = render_aovs(scene, cameras, names if shape_only else [*names, "image"], TEMPLATES.spp, seed)
        alpha = seen["alpha"].float()
        normals = F.normalize(seen["normal"].float(), dim=-1, eps=1e-6)
        channels = task.shots[0].target.shape[-1] - ("alpha" in task.aovs and not task.clutter)
        colors = torch.ones(*alpha.shape[:3], channels, dtype=torch.float32)
        if not shape_only:
            colors = linear_to_srgb((seen["image"].float() / alpha.clamp(min=1e-3)).clamp(0.0, 1.0))
        return TemplateViews(rotations, pixels, alpha[..., 0], colors, normals)


def across(task: PoseTask, camera: Camera, depth: float) -> float:
    """Return the pixels of the object's diagonal, that of its box, at a depth."""
    return focal_of(camera) * task.size / (1.0 if camera.projection == "orthographic" else depth)


def pose_at(task: PoseTask, R: Tensor, position: Tensor, depth: float) -> Pose:
    """Return the pose whose centre the first camera sees at `position` (2,), in pixels, and at `depth`, as a view of the
    rotation R shows it. Off the axis, the object is rotated like the ray to it. Distortion is left out."""
    camera = task.shots[0].camera
    view, K = camera.world_to_camera.double(), camera.K.double()
    ray = torch.linalg.solve(K[:2, :2], position.double() - K[:2, 2])
    center = torch.cat([ray, ray.new_tensor([depth])])
    if camera.projection != "orthographic":
        center = depth * torch.cat([ray, ray.new_ones(1)])
        R = _towards(ray) @ R
    turned = view[:3, :3].T @ R
    one = torch.ones((), dtype=torch.float64)
    t = view[:3, :3].T @ (center - view[:3, 3]) - turned @ task.center
    return Pose(turned, t, one, one)


def all_sides() -> Tensor:
    """Return the rotations (directions · rolls, 3, 3): directions on Fibonacci's sphere, each rotated about itself."""
    z, longitude = _sphere(TEMPLATES.directions)
    _, y, axis = torch.eye(3, dtype=torch.float64)
    first, second = rotations(torch.acos(z)[:, None] * y), rotations(longitude[:, None] * axis)
    roll = torch.arange(TEMPLATES.rolls, dtype=torch.float64) * (2.0 * math.pi / TEMPLATES.rolls)
    return (rotations(roll[:, None] * axis)[None] @ (first @ second)[:, None]).flatten(0, 1)


def spread(count: int) -> Tensor:
    """Return rotations (count, 3, 3) evenly over SO(3) (Alexa, Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of
    SO(3), 2022)."""
    s = torch.arange(count, dtype=torch.float64) + 0.5
    inner, outer = (s / count).sqrt(), (1.0 - s / count).sqrt()
    a, b = 2.0 * math.pi * s / math.sqrt(2.0), 2.0 * math.pi * s / 1.533751168755204288118041
    x, y, z, w = inner * a.sin(), inner * a.cos(), outer * b.sin(), outer * b.cos()
    half = torch.stack([x, y, z], -1)
    length = half.norm(dim=-1, keepdim=True)
    return rotations(half / length.clamp(min=1e-12) * 2.0 * torch.atan2(length, w[:, None]))


def ball(count: int, radius: float) -> Tensor:
    """Return rotations (count, 3, 3) by up to `radius` radians, the first by none, the others evenly. Axes lie on Fibonacci's
    sphere, and angles follow the growth of volume."""
    k, (z, longitude) = torch.arange(count, dtype=torch.float64), _sphere(count)
    around = (1.0 - z * z).sqrt()
    axes = torch.stack([around * longitude.cos(), around * longitude.sin(), z], -1)
    # Multiples of the golden ratio make angles independent of axes.
    share = torch.where(k > 0, (k * 0.6180339887498949) % 1.0, torch.zeros_like(k))
    return rotations(axes * (radius * share.pow(1.0 / 3.0))[:, None])


def _towards(ray: Tensor) -> Tensor:
    """Return the rotation (3, 3) from the axis (0, 0, 1) to the direction (x, y, 1) of a ray (2,)."""
    aside = ray.norm()
    axis = torch.stack([-ray[1], ray[0], ray.new_zeros(())]) / aside.clamp(min=1e-300)
    return rotation(axis * torch.atan(aside))


def rotations(vectors: Tensor) -> Tensor:
    """Return the rotations (n, 3, 3) by rotation vectors (n, 3)."""
    return torch.linalg.matrix_exp(cross_matrices(vectors))


def _sphere(count: int) -> tuple[Tensor, Tensor]:
    """Return height and longitude (n,) of points on Fibonacci's sphere."""
    k = torch.arange(count, dtype=torch.float64)
    return 1.0 - (2.0 * k + 1.0) / count, math.pi * (3.0 - math.sqrt(5.0)) * k
