"""Images and gradients of faces with shading normals under an even sky, against exact ones (sky_oracle.py)."""

from __future__ import annotations

import pytest
import torch
from finite_differences import Estimate, check, estimate
from sky_oracle import F64, Flat, Pinhole, even_directions, radiant_flux
from torch import Tensor
from torch.nn.functional import normalize

import edgegrad as eg

RADIANCE, ALBEDO, GROUND_ALBEDO = 0.9, 0.25, 0.8
SIZE, WINDOW = (14, 18), (3, 2, 16, 12)  # (height, width), and left, top, right, bottom, px


class Case:
    """Two random triangles before a sloping bright ground. They grow and turn, so that nearly all that changes darkens.

    level   height of the ground; at −0.5 and above it passes through triangles
    tilt    by how much the normal that shades a triangle differs from its own
    width   distance of two corners of the second triangle; None: random
    """

    def __init__(self, seed: int, level: float, tilt: float, width: float | None = None) -> None:
        generator = torch.Generator().manual_seed(seed)

        def random(*shape: int) -> Tensor:
            return 2 * torch.rand(shape, generator=generator, dtype=F64) - 1

        self.corners = 1.1 * random(2, 3, 3)
        if width is not None:
            side = normalize(self.corners[1, 1] - self.corners[1, 0], dim=0)
            self.corners[1, 1] = self.corners[1, 0] + width * side
        self.motion = self.corners - self.corners.mean(1, keepdim=True) + 0.3 * random(2, 3, 3)
        a, b, c = self.corners.unbind(1)
        own = normalize(torch.linalg.cross(b - a, c - a), dim=1)
        self.normals = normalize(own + tilt * random(2, 3), dim=1)
        x, z = torch.tensor([[-5.0, 5.0, 5.0, -5.0], [-6.0, -6.0, 3.0, 3.0]], dtype=F64)
        slope = 0.05 * random(2)
        self.ground = torch.stack([x, level + slope[0] * x + slope[1] * z, z], 1)
        eye = torch.tensor([0.0, 3.5, 4.0], dtype=F64) + 0.2 * random(3)
        self.camera = eg.Camera.look_at(eye, (0.0, -0.6, 0.0), (0.0, 1.0, 0.0), fov_y=32.0, size=SIZE)

    def exact(self, seeds: int, directions: int) -> tuple[Estimate, Estimate]:
        """Compute the flux through the window and its derivative by the motion."""
        camera = Pinhole(self.camera.K, self.camera.world_to_camera, WINDOW)
        values, derivatives = [], []
        for seed in range(seeds):
            theta = torch.zeros((), dtype=F64, requires_grad=True)
            moved = self.corners + theta * self.motion
            polygons = [Flat(face, ALBEDO, n) for face, n in zip(moved, self.normals, strict=True)]
            polygons.append(Flat(self.ground, GROUND_ALBEDO))
            flux = radiant_flux(polygons, camera, RADIANCE, even_directions(directions, seed))
            values.append(flux.item())
            derivatives.append(torch.autograd.grad(flux, theta)[0].item())
        return estimate(values), estimate(derivatives)

    def rendered(self, seeds: int, samples: int) -> tuple[Estimate, Estimate]:
        """Render the same."""
        left, top, right, bottom = WINDOW
        values, derivatives = [], []
        for seed in range(seeds):
            theta = torch.zeros((), dtype=F64, requires_grad=True)
            verts = (self.corners + theta * self.motion).reshape(-1, 3)
            mesh = _matt(verts, [[0, 1, 2], [3, 4, 5]], ALBEDO).replace(normals=self.normals.repeat_interleave(3, 0))
            ground = _matt(self.ground, [[0, 1, 2], [0, 2, 3]], GROUND_ALBEDO)
            sky = eg.lights.Environment(torch.tensor([RADIANCE], dtype=F64), visible=False)
            scene = eg.Scene([mesh, ground], lights=[sky])
            image = eg.render(
                scene, self.camera, spp=256, seed=seed, sampling=eg.Sampling(lights=4, edges=samples, surface=samples)
            )
            flux = image[top:bottom, left:right].sum()
            values.append(flux.item())
            derivatives.append(torch.autograd.grad(flux, theta)[0].item())
        return estimate(values), estimate(derivatives)


def _matt(verts: Tensor, faces: list[list[int]], albedo: float) -> eg.Mesh:
    white = torch.ones((len(verts), 1), dtype=F64)
    return eg.Mesh(verts, torch.tensor(faces), colors=white, material=eg.Material(albedo))


def compare(name: str, case: Case, seeds: int, directions: int, samples: int) -> None:
    flux, derivative = case.exact(seeds, directions)
    image, gradient = case.rendered(seeds, samples)
    for what, truth, found in (("image", flux, image), ("gradient", derivative, gradient)):
        error = (truth.error**2 + found.error**2) ** 0.5
        check(f"{name}, {what}", truth.mean, Estimate(found.mean, error))


def test_gradient_of_triangles_with_normals() -> None:
    """They pass through the ground."""
    compare("through", Case(9, -0.5, 0.15), 4, 1024, 30_000)


@pytest.mark.slow
@pytest.mark.parametrize("tilt", [0.0, 0.6])
@pytest.mark.parametrize("level", [-1.6, -0.5, -0.1])
@pytest.mark.parametrize("seed", [1, 2, 7, 21])
def test_gradient_of_many_triangles_with_normals(seed: int, level: float, tilt: float) -> None:
    compare(f"seed {seed}", Case(seed, level, tilt), 8, 4096, 100_000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 7, 21])
def test_gradient_of_many_slivers_with_their_own_normals(seed: int) -> None:
    """Central differences with usual steps are off here (docs/limits.md); the derivative is not."""
    compare(f"sliver {seed}", Case(seed, -1.4, 0.0, width=0.005), 8, 4096, 100_000)
