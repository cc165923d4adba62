"""Light that is followed to the camera from where it falls on surfaces gives the image that paths from pixels find."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from finite_differences import estimate
from room_scenes import F64, box_room, towards_room, vector
from scenes import icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.kernel.request import make_request
from edgegrad.light import in_kernel
from edgegrad.points.image_context import ImageContext

SIZE = 24
GLOSSY: dict[str, Any] = {"metallic": 0.6, "roughness": 0.4}


def camera(kind: str) -> eg.Camera:
    seen_from = towards_room(SIZE)
    K, pose = seen_from.K, seen_from.world_to_camera
    if kind == "distorted":
        return seen_from.replace(distortion=vector(-0.2, 0.05, 0.002, 0.003))
    if kind == "orthographic":
        K = torch.tensor([[10.0, 0.5, 12], [0, 10, 12], [0, 0, 1]], dtype=F64)
        return eg.Camera(pose, K, (SIZE, SIZE), projection="orthographic")
    inside = eg.Camera.look_at((0.4, -0.6, 1.2), (-0.2, 0.3, 0.6), (0, 0, 1), 60.0, (SIZE, SIZE)).world_to_camera
    if kind == "fisheye":
        K = torch.tensor([[9.0, 0, 12], [0, 9, 12], [0, 0, 1]], dtype=F64)
        return eg.Camera.fisheye(inside[:3, :3], inside[:3, 3], K, (SIZE, SIZE))
    if kind == "panorama":
        return eg.Camera.panorama(inside, (SIZE, 2 * SIZE))
    return seen_from


def room(floor: dict[str, Any] | None = None) -> eg.Scene:
    """Return a room with a point light, and a ball with smooth normals in place of the block."""
    scene = box_room("point", floor)
    ball = icosphere(1)
    verts = 0.45 * ball.verts.to(F64) + vector(-0.2, 0.1, 0.6)
    white = eg.Material(vector(0.75, 0.75, 0.75), **GLOSSY)
    round_ = eg.Mesh(verts, ball.faces, material=white, normals=eg.Mesh(verts, ball.faces).vertex_normals())
    return scene.replace(meshes=[*scene.meshes[:4], round_, *scene.meshes[5:]])


def weights(frame: ImageContext) -> Tensor:
    """(pixels, 3) by which they count."""
    y, x = torch.meshgrid(*(torch.arange(n, dtype=F64) / n for n in (frame.height, frame.width)), indexing="ij")
    one = 0.6 + 0.35 * torch.cos(2.1 * x + 3.3 * y + 0.4) + 0.2 * torch.sin(5 * x - 2 * y)
    return one.reshape(-1, 1) * vector(1.0, 0.7, 0.4)


def from_pixels(scene: eg.Scene, seen_from: eg.Camera, spp: int, seed: int, bounces: int) -> float:
    frame = ImageContext(scene, make_request(scene, seen_from, spp, seed))
    total = 0.0
    for _, found in frame.sampler.pixel_hits(1 << 17, spp):
        hits = frame.fixed_hits(found.face, found.b, found.x, frame.seeds_of_pixels("image", found.pixel, spp))
        L = in_kernel.indirect(hits, True, bounces)
        total += float((weights(frame)[found.pixel] * found.weight[:, None] * L).sum())
    return total


def from_light(scene: eg.Scene, seen_from: eg.Camera, count: int, seed: int, bounces: int) -> float:
    """Points spread over all surfaces take the light of the scene's point light on."""
    frame = ImageContext(scene, make_request(scene, seen_from, 1, seed))
    (light,) = scene.lights
    assert isinstance(light, eg.lights.PointLight)
    corner = frame.fixed.verts[frame.fixed.faces.long()]
    area = torch.linalg.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]).norm(dim=1) / 2
    random = torch.rand(count, 3, dtype=F64, generator=torch.Generator().manual_seed(seed))
    spread = (torch.arange(count) + random[:, 0]) / count * area.sum()
    face = torch.searchsorted(area.cumsum(0), spread).clamp(max=len(area) - 1)
    root = random[:, 1].sqrt()
    b = torch.stack([1 - root, root * (1 - random[:, 2]), root * random[:, 2]], 1)
    hits = frame.fixed_hits(face, b, torch.zeros(count, 2, dtype=F64))
    to_light = light.position - hits.position
    origin = to_light / to_light.norm(dim=1, keepdim=True)
    cosine = (frame.fixed.face_normals(face) * origin).sum(1).abs()
    lit = hits.visible(light.position).double()
    falls = float(light.intensity) / to_light.square().sum(1) * cosine * lit * area.sum() / count
    arrivals = (face, b, frame.seeds("indirect shadows", count), origin, falls[:, None].expand(count, 3))
    _, x, radiance = in_kernel.towards_camera(frame, arrivals, (1, bounces - 1))
    pixel = x.floor().long()
    inside = ((pixel >= 0) & (pixel < torch.tensor([frame.width, frame.height]))).all(1)
    return float((weights(frame)[pixel[inside, 1] * frame.width + pixel[inside, 0]] * radiance[inside]).sum())


def check(scene: eg.Scene, seen_from: eg.Camera, spp: int, bounces: int, seeds: int = 6) -> None:
    pixels = seen_from.size[0] * seen_from.size[1]
    with torch.no_grad():
        expected = estimate([from_pixels(scene, seen_from, spp, seed, bounces) for seed in range(seeds)])
        found = estimate([from_light(scene, seen_from, 6 * spp * pixels, seed, bounces) for seed in range(seeds)])
    error = math.hypot(expected.error, found.error)
    assert error < 0.01 * expected.mean, (expected, found)
    assert abs(found.mean - expected.mean) < 4 * error, (expected, found)
    print(expected, found)


def test_light_tracing_gives_the_image_of_paths() -> None:
    check(room(), camera("perspective"), 40, 3)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["perspective", "distorted", "orthographic", "fisheye", "panorama"])
def test_light_tracing_through_every_lens(kind: str) -> None:
    check(room({"base_color": vector(0.8, 0.6, 0.4), **GLOSSY}), camera(kind), 192, 2)


@pytest.mark.slow
@pytest.mark.parametrize("bounces", [2, 3, 5])
def test_light_tracing_at_any_number_of_bounces(bounces: int) -> None:
    check(room({"base_color": vector(0.8, 0.6, 0.4), **GLOSSY}), camera("perspective"), 192, bounces)
