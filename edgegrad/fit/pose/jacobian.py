"""Derivatives of renders as a scene and the lens that sees it move, in all directions with one pass of forward mode.

A point x of a scene that rotates, scales and shifts has the tangent A x + b with A = [ω]ₓ + s 1, and a direction n the
tangent [ω]ₓ n. The kernel needs to know no more, so torch differentiates nothing here: its own forward mode would load rules
for seconds at its first call in a process.

The derivatives J use samples independent of the image's: J, and Jᵀr with any function r of the image, are unbiased; JᵀJ
exceeds its limit by the variance of J.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ...aovs import IDS, aovs_request, by_name, check_aovs
from ...camera.camera import Camera
from ...camera.lens import MOST_COEFFICIENTS
from ...kernel.operators import forward_kernel, jvp_kernel
from ...scene.scene import Scene


@dataclass(frozen=True)
class Motion:
    """How a scene and its camera move in D directions, float64."""

    linear: Tensor  # (D, 3, 3), [ω]ₓ + s 1: a point x moves by linear x + shift
    shift: Tensor  # (D, 3)
    K: Tensor | None = None  # (D, 3, 3)
    distortion: Tensor | None = None  # (D, n), first n coefficients

    def __len__(self) -> int:
        return len(self.linear)

    def of_points(self, points: Tensor) -> Tensor:
        """Return the tangents (D, n, 3) of points (n, 3) in the world."""
        return points @ self.linear.transpose(1, 2) + self.shift[:, None]

    def of_directions(self, directions: Tensor) -> Tensor:
        """Return the tangents (D, n, 3) of unit vectors (n, 3), which rotate only."""
        turn = 0.5 * (self.linear - self.linear.transpose(1, 2))
        return directions @ turn.transpose(1, 2)


class Rendered:
    """Channels of a scene, equal to the bit to those of render_aovs(), and then their derivatives by motions.

    aovs    names of channels, but for ids, and for "image" where the scene is lit: its radiance changes in ways that only
            torch knows

    Nothing of it is in torch's graph. Raises ValueError for other names, and what render_aovs() raises.
    """

    def __init__(self, scene: Scene, camera: Camera, aovs: Sequence[str], spp: int = 16, seed: int = 0) -> None:
        lit = scene.is_shaded and "image" in aovs
        if unknown := [name for name in check_aovs(aovs) if name in IDS or (lit and name == "image")]:
            why = "of a scene that is lit" if lit else "that has derivatives"
            raise ValueError(f"aovs: expected a channel {why} among those of the kernel, got {unknown[0]!r}")
        self.scene, self.aovs = scene, aovs
        with torch.no_grad():
            self._request = aovs_request(scene, camera, aovs, spp, seed)
            image, self._hits, _ = forward_kernel(self._request)
        self.images = by_name(scene, aovs, image[0])  # (H, W, c) by name

    def derivatives(self, motion: Motion) -> dict[str, Tensor]:
        """Return the derivatives (D, H, W, c) by name."""
        with torch.no_grad():
            dots = jvp_kernel(self._hits, self._request, self._tangents(motion), len(motion))
        return by_name(self.scene, self.aovs, dots[:, 0])

    def _tangents(self, motion: Motion) -> dict[str, Tensor]:
        """Return the tangents of the kernel's inputs."""
        flat, camera, auxiliary = self._request.scene, self._request.camera, self._request.auxiliary
        points = motion.of_points(flat.verts)
        tangents = {"verts": points}
        if motion.K is not None:
            tangents["K"] = motion.K[:, None]
        if motion.distortion is not None:
            unsought = MOST_COEFFICIENTS - motion.distortion.shape[1]
            tangents["distortion"] = torch.nn.functional.pad(motion.distortion, (0, unsought))[:, None]
        parts = []
        if "position" in self.aovs:
            parts.append(points)
        if "depth" in self.aovs:
            parts.append(points @ camera.world_to_camera[0, 2, :3, None])
        if "shading_normal" in self.aovs:
            parts.append(motion.of_directions(auxiliary.vertex_attributes[0, :, -3:]))
        if parts:
            tangents["vertex_attributes"] = torch.cat(parts, -1)[:, None]
        if "normal" in self.aovs:
            tangents["face_attributes"] = motion.of_directions(auxiliary.face_attributes)
        return tangents


def cross_matrices(vectors: Tensor) -> Tensor:
    """Return the matrices (n, 3, 3) of ω × for vectors (n, 3)."""
    basis = torch.eye(3, dtype=torch.float64)
    return torch.linalg.cross(vectors[:, None], basis[None], dim=-1).transpose(1, 2)
