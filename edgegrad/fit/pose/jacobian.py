"""Derivatives of renders as a scene and the lens that sees it move, in all directions of one pass of forward mode.

A point x of a scene that turns, grows and shifts has the tangent A x + b with A = [ω]ₓ + s 1, and a direction n the tangent
[ω]ₓ n. That is all the kernel needs to know, so nothing here is differentiated by torch: its own forward mode would load rules
for seconds at its first call in a process.

What comes out is an estimate from samples that are independent of those of the image: J, and Jᵀr with any function r of the
image, are unbiased; JᵀJ is higher than its limit by the variance of J.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    """How a scene and its camera move in D directions. float64."""

    linear: Tensor  # (D, 3, 3), [ω]ₓ + s 1: a point x of the world moves by linear x + shift
    shift: Tensor  # (D, 3)
    K: Tensor | None = None  # (D, 3, 3), of the camera's K
    distortion: Tensor | None = None  # (D, n), of the first n of the camera's coefficients

    def __len__(self) -> int:
        return len(self.linear)

    @staticmethod
    def about(center: Tensor, axes: Tensor | None = None, size: float = 1.0) -> Motion:
        """Six directions: turns in radians about a centre (3,) around the axes, the rows of (3, 3), those of the world when None,
        and shifts along them in units of `size`."""
        along = torch.eye(3, dtype=torch.float64) if axes is None else axes.double()
        turns = crossed(along)
        return Motion(torch.cat([turns, torch.zeros_like(turns)]), torch.cat([-turns @ center.double(), size * along]))

    def of_points(self, points: Tensor) -> Tensor:
        """(D, n, 3) of points (n, 3) of the world."""
        return points @ self.linear.transpose(1, 2) + self.shift[:, None]

    def of_directions(self, directions: Tensor) -> Tensor:
        """(D, n, 3) of unit vectors (n, 3): what turns them alone."""
        turn = 0.5 * (self.linear - self.linear.transpose(1, 2))
        return directions @ turn.transpose(1, 2)


@dataclass(frozen=True)
class Motions:
    """Several objects of a scene, one after the other, each with the directions in which it moves alone."""

    parts: Sequence[Motion]  # of each object
    counts: Sequence[int]  # of its vertices
    K: None = None  # the camera stays
    distortion: None = None

    def __len__(self) -> int:
        return sum(map(len, self.parts))

    def of_points(self, points: Tensor) -> Tensor:
        """(D, n, 3) of points (n, 3) of the world, those of the objects one after the other."""
        found, first = points.new_zeros(len(self), len(points), 3), 0
        for part, own, rows in zip(self.parts, points.split(list(self.counts)), self._vertices(), strict=True):
            found[first : first + len(part), rows] = part.of_points(own)
            first += len(part)
        return found

    def _vertices(self) -> Iterator[slice]:
        first = 0
        for count in self.counts:
            yield slice(first, first + count)
            first += count


class Rendered:
    """Channels of a scene, as render_aovs() gives them to the bit, and then their derivatives by motions.

    aovs    names among those of render_aovs(), but for ids, and for "image" where the scene is lit: there the radiance changes
            in ways that the kernel alone does not know

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

    def derivatives(self, motion: Motion | Motions) -> dict[str, Tensor]:
        """(D, H, W, c) by name; of several objects that move alone for "image" and "alpha"."""
        with torch.no_grad():
            dots = jvp_kernel(self._hits, self._request, self._tangents(motion), len(motion))
        return by_name(self.scene, self.aovs, dots[:, 0])

    def _tangents(self, motion: Motion | Motions) -> dict[str, Tensor]:
        """Of what the kernel is given."""
        flat, camera, beside = self._request.scene, self._request.camera, self._request.auxiliary
        points = motion.of_points(flat.verts)
        tangents = {"verts": points}
        if motion.K is not None:
            tangents["K"] = motion.K[:, None]
        if motion.distortion is not None:
            unsought = MOST_COEFFICIENTS - motion.distortion.shape[1]
            tangents["distortion"] = torch.nn.functional.pad(motion.distortion, (0, unsought))[:, None]
        if isinstance(motion, Motions):
            return tangents  # of silhouettes and colours alone
        parts = []
        if "position" in self.aovs:
            parts.append(points)
        if "depth" in self.aovs:
            parts.append(points @ camera.world_to_camera[0, 2, :3, None])
        if "shading_normal" in self.aovs:
            parts.append(motion.of_directions(beside.vertex_attributes[0, :, -3:]))
        if parts:
            tangents["vertex_attributes"] = torch.cat(parts, -1)[:, None]
        if "normal" in self.aovs:
            tangents["face_attributes"] = motion.of_directions(beside.face_attributes)
        return tangents


def derivatives(
    scene: Scene, camera: Camera, aovs: Sequence[str], motion: Motion, spp: int = 16, seed: int = 0
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Channels (H, W, c) by name, and their derivatives (D, H, W, c) by the motion: see Rendered."""
    rendered = Rendered(scene, camera, aovs, spp, seed)
    return rendered.images, rendered.derivatives(motion)


def crossed(vectors: Tensor) -> Tensor:
    """(n, 3, 3) matrices of ω × for (n, 3)."""
    basis = torch.eye(3, dtype=torch.float64)
    return torch.linalg.cross(vectors[:, None], basis[None], dim=-1).transpose(1, 2)
