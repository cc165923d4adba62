"""Rigid motions of a mesh after which it is where it was, and poses that differ by no more than these.

A symmetry S (4, 4) maps points of the mesh, in its own coordinates, onto the mesh: poses P and P · S show the same. As in BOP's
models_info.json there are discrete ones, given one by one, and continuous ones, all rotations about an axis (Hodaň et al., "BOP
Challenge 2020 on 6D Object Localization", 2020).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from ..check import as_double, check_flag, check_int, check_positive
from .mesh import Mesh
from .nearest import SurfaceIndex
from .scene import Scene, as_scene
from .symmetry_axis import SymmetryAxis, rigid, skew
from .symmetry_search import SymmetrySearch

RIGID = 1e-3  # how far R Rᵀ may be from 1: files round to a few digits
PARALLEL = 1e-3  # sine of the angle between axes that are one


class PoseError(NamedTuple):
    """The distance of a pose from a reference."""

    degrees: float  # of the rotation between them
    distance: float  # between their translations, in units of the world


@dataclass(frozen=True, eq=False)
class Symmetries:
    """The symmetries of a mesh: each of the discrete ones, followed by a rotation about each axis.

    Symmetries.find(mesh) finds them. Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    discrete : (N, 4, 4), default the identity alone
        Rigid motions in the mesh's coordinates, for column vectors. The identity is put first where it is missing.
    continuous : sequence of Symmetries.Axis
        Two axes that are not parallel make a sphere: it may be turned in any way about their common point.
    """

    discrete: Tensor | None = None
    continuous: Sequence[SymmetryAxis] = ()

    Axis: ClassVar[type[SymmetryAxis]] = SymmetryAxis

    def __post_init__(self) -> None:
        given = torch.eye(4)[None] if self.discrete is None else self.discrete
        motions = as_double("discrete", given, ("N", 4, 4)).cpu()
        for i, motion in enumerate(motions):
            R = motion[:3, :3]
            if motion[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
                raise ValueError(
                    f"discrete[{i}]: expected the last row 0, 0, 0, 1, got {motion[3].tolist()}; is it transposed?"
                )
            if float((R @ R.T - torch.eye(3)).abs().max()) > RIGID or float(torch.linalg.det(R)) < 0.0:
                raise ValueError(
                    f"discrete[{i}]: expected a rotation and a translation, got a scale, a shear or a mirror image"
                )
        one = torch.eye(4, dtype=torch.float64)
        same = (motions - one).abs().amax((1, 2)) == 0.0
        object.__setattr__(self, "discrete", torch.cat([one[None], motions[~same]]))
        axes = tuple(self.continuous)
        for i, axis in enumerate(axes):
            if not isinstance(axis, SymmetryAxis):
                raise TypeError(
                    f"continuous[{i}]: expected a Symmetries.Axis, got {type(axis).__name__}; "
                    "eg.Symmetries.Axis(direction) makes one"
                )
        object.__setattr__(self, "continuous", axes)

    @classmethod
    def find(
        cls,
        mesh: Mesh | Scene,
        tolerance: float = 0.01,
        *,
        textured: bool = True,
        color_tolerance: float = 0.1,
        max_order: int = 24,
    ) -> Symmetries:
        """Return the rotations that map a mesh onto itself. The same mesh gives the same rotations in the same order.

        The distance is that of 600 points of the surface and as many vertices: a detail smaller than their spacing that is
        nearer than the tolerance breaks no symmetry. A mesh like a sphere has continuous symmetries about three axes. Mirror
        images are no symmetries, because no motion makes them. Raises TypeError, ValueError that names the argument, or
        ImportError without SciPy.

        Parameters
        ----------
        mesh : Mesh or Scene
        tolerance : float, default 0.01
            Largest distance of points of the rotated mesh from the mesh, as a share of its size: twice the largest distance from
            its centroid. A prism with so many sides that it is a cylinder within it counts as one.
        textured : bool, default True
            Whether colours must agree, too; False finds the symmetries of the shape alone. A plain mesh has none.
        color_tolerance : float, default 0.1
            Largest difference of the colours of corresponding points, all but one in a hundred of the points, from 0 to 1 of the
            brightest. Square roots of radiance (or of base colours) are compared, which is about how the eye sees them.
        max_order : int, default 24
            Highest order n of a rotation by 360° / n that is looked for.
        """
        scene = as_scene(mesh)
        check_positive("tolerance", tolerance, least=1e-6, most=0.5)
        check_positive("color_tolerance", color_tolerance, least=0.0, most=1.0)
        check_int("max_order", max_order, 2, 360)
        check_flag("textured", textured)
        return cls(*SymmetrySearch(SurfaceIndex(scene), tolerance, textured, color_tolerance, max_order).run())

    @classmethod
    def from_bop(cls, info: Mapping[str, Any]) -> Symmetries:
        """Return the symmetries of an entry of BOP's models_info.json.

        Its keys are symmetries_discrete (lists of 16 numbers by rows) and symmetries_continuous (objects with axis and offset);
        without them there is the identity alone. Raises ValueError.
        """
        motions = info.get("symmetries_discrete", [])
        if any(not isinstance(one, Sequence) or len(one) != 16 for one in motions):
            raise ValueError("symmetries_discrete: expected lists of 16 numbers, 4 × 4 by rows, got something else")
        axes = []
        for i, axis in enumerate(info.get("symmetries_continuous", [])):
            if not isinstance(axis, Mapping) or not {"axis", "offset"} <= set(axis):
                raise ValueError(f"symmetries_continuous[{i}]: expected the keys axis and offset, got {axis!r}")
            axes.append(SymmetryAxis(_doubles(axis["axis"]), _doubles(axis["offset"])))
        return cls(_doubles(motions).reshape(-1, 4, 4) if motions else None, axes)

    def to_bop(self) -> dict[str, Any]:
        """Return the entry that from_bop() reads: keys for what there is, without the identity."""
        found: dict[str, Any] = {}
        if len(self.motions) > 1:
            found["symmetries_discrete"] = [motion.flatten().tolist() for motion in self.motions[1:]]
        if self.continuous:
            found["symmetries_continuous"] = [
                {"axis": axis.direction.tolist(), "offset": axis.offset.tolist()} for axis in self.continuous
            ]
        return found

    @property
    def motions(self) -> Tensor:
        """Return `discrete` (N, 4, 4) float64, the identity first."""
        assert self.discrete is not None
        return self.discrete

    @property
    def trivial(self) -> bool:
        """Return whether there is none but the identity."""
        return len(self.motions) == 1 and not self.continuous

    @property
    def spherical(self) -> bool:
        """Return whether all rotations about a point are symmetries."""
        return any(
            float(torch.linalg.cross(self.continuous[0].direction, axis.direction).norm()) > PARALLEL
            for axis in self.continuous[1:]
        )

    def transforms(self, step: float = 0.01) -> Tensor:
        """Return all symmetries (T, 4, 4), continuous ones in ⌈π / step⌉ equal angles each.

        Between two angles no point moves by more than `step` of the object's diameter. The order and the angles are those of
        BOP's own toolkit: where there are axes, each discrete one is followed by the rotations about each axis. Of a sphere
        there are therefore only the rotations about its axes; closest() knows all of them. Raises ValueError.
        """
        check_positive("step", step, least=1e-4, most=1.0)
        if not self.continuous:
            return self.motions.clone()
        count = math.ceil(math.pi / step)
        angles = torch.arange(count, dtype=torch.float64) * (2.0 * math.pi / count)
        turns = torch.cat([axis.rotations(angles) for axis in self.continuous])
        return (turns[None] @ self.motions[:, None]).reshape(-1, 4, 4)

    def closest(self, pose: object, reference: object) -> Tensor:
        """Return the pose (4, 4) float64 whose rotation is nearest to the reference's, of all poses that show the same as
        `pose`.

        It is exact for continuous symmetries, too: with A and B the rotations of both, the trace of Bᵀ A S is a sine of the
        angle about the axis. All symmetries keep one point of the mesh where it is, so no pose is nearer by its translation
        alone. Of poses that are equally near the first is returned. Raises TypeError or ValueError.

        Parameters
        ----------
        pose, reference : (4, 4), or an object with such a `matrix`, as PoseFit
            Mesh to world for column vectors; a scale may be included.
        """
        P, Q = _pose("pose", pose), _pose("reference", reference)
        if self.spherical:
            A, B = P[:3, :3], Q[:3, :3]
            center = _common_point(self.continuous)
            R = B * (torch.linalg.det(A) / torch.linalg.det(B)) ** (1.0 / 3.0)
            return rigid(R[None], (A @ center + P[:3, 3] - R @ center)[None])[0]
        motions = self.motions
        M = motions[:, :3, :3] @ Q[:3, :3].T @ P[:3, :3]  # (N, 3, 3): the trace of M C is that of Bᵀ A C D
        value = M.diagonal(dim1=-2, dim2=-1).sum(-1)
        if self.continuous:
            axis = self.continuous[0]
            along = torch.einsum("i,nij,j->n", axis.direction, M, axis.direction)
            across = torch.einsum("nij,ji->n", M, skew(axis.direction))
            angles = torch.atan2(across, value - along)
            motions = axis.rotations(angles) @ motions
            value = along + torch.hypot(across, value - along)
        best = int((value >= value.max() - 1e-9 * value.abs().max()).nonzero()[0])
        return P @ motions[best]

    def error(self, pose: object, reference: object) -> PoseError:
        """Return how far the closest() of the equivalent poses is from the reference. Raises TypeError or ValueError."""
        P, Q = self.closest(pose, reference), _pose("reference", reference)
        R = Q[:3, :3].T @ P[:3, :3]
        R = R / torch.linalg.det(R) ** (1.0 / 3.0)
        # The sine is needed, too, because the cosine alone has no digits near 0.
        sine = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]).norm()
        angle = math.atan2(float(sine), float(0.5 * (R.trace() - 1.0)))
        return PoseError(math.degrees(angle), float((P[:3, 3] - Q[:3, 3]).norm()))

    def scaled(self, factor: float) -> Symmetries:
        """Return the symmetries of the mesh in other units: of a mesh in mm, `scaled(0.001)` are those in m. Raises
        ValueError."""
        check_positive("factor", factor, least=1e-12, most=1e12)
        motions = self.motions.clone()
        motions[:, :3, 3] *= factor
        return Symmetries(motions, [SymmetryAxis(axis.direction, axis.offset * factor) for axis in self.continuous])

    def __repr__(self) -> str:
        if self.spherical:
            return "Symmetries(those of a sphere)"
        axes = f", {len(self.continuous)} continuous" if self.continuous else ""
        return f"Symmetries({len(self.motions)} discrete with the identity{axes})"


def _common_point(axes: Sequence[SymmetryAxis]) -> Tensor:
    """Return the point (3,) nearest to all axes, by least squares of the distances: of those of a sphere its centre."""
    one = torch.eye(3, dtype=torch.float64)
    across = [one - torch.outer(axis.direction, axis.direction) for axis in axes]
    return torch.linalg.solve(
        sum(across, 0 * one), sum((P @ a.offset for P, a in zip(across, axes, strict=True)), 0 * one[0])
    )


def _pose(name: str, value: object) -> Tensor:
    matrix = as_double(name, getattr(value, "matrix", value), (4, 4)).cpu()
    if matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"{name}: expected the last row 0, 0, 0, 1, got {matrix[3].tolist()}; is it transposed?")
    if not float(torch.linalg.det(matrix[:3, :3])) > 0.0:
        raise ValueError(f"{name}: expected a rotation times a scale above 0, got a determinant that is not above 0")
    return matrix


def _doubles(value: object) -> Tensor:
    try:
        return torch.tensor(value, dtype=torch.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"symmetries: expected numbers, got something else ({error})") from None
