"""Poses of objects, and parameters of a fit that are poses."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..camera.poses import check_rotation, rigid, rotation
from ..check import as_double, check_finite, check_positive, check_shape
from ..optim.parameter import Parameter as Parameter
from ..optim.tensors import Record
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from ..scene.symmetries import Symmetries


class Pose(NamedTuple):
    """A pose, mesh to world: `world = scale · R v + t`, and the change of the camera's lens.

    It is float64 in results. A function that makes the scene of fit_scene() gets it in the type of the object's vertices.
    """

    R: Tensor  # (3, 3)
    t: Tensor  # (3,) world units
    scale: Tensor = torch.ones((), dtype=torch.float64)  # ()
    focal: Tensor = torch.ones((), dtype=torch.float64)  # () relative to the given camera's focal length
    principal: Tensor = torch.zeros(2, dtype=torch.float64)  # shift of the principal point, in widths of the image
    distortion: Tensor = torch.zeros(8, dtype=torch.float64)  # added to the camera's coefficients

    @property
    def matrix(self) -> Tensor:
        """Return the (4, 4) matrix for column vectors."""
        return rigid(self.scale * self.R, self.t)

    def closest(self, symmetries: Symmetries, reference: Pose) -> Pose:
        """Return, among the poses that `symmetries` make equal, the one whose rotation is nearest to the reference's."""
        matrix = symmetries.closest(self.matrix, reference.matrix)
        return self._replace(R=matrix[:3, :3] / self.scale, t=matrix[:3, 3])


def pose_from_matrix(name: str, matrix: object) -> Pose:
    """Return the pose of a 4 × 4 similarity for column vectors. Raises TypeError or ValueError."""
    if not isinstance(matrix, Tensor):
        try:
            matrix = torch.tensor(matrix, dtype=torch.float64)  # Lists would become float32.
        except (TypeError, ValueError) as error:
            raise ValueError(f"{name}: expected 4 × 4 numbers, got something else ({error})") from error
    M = matrix.detach().cpu().double()
    check_shape(name, M, (4, 4))
    check_finite(name, M)
    if M[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise ValueError(f"{name}: expected the last row 0, 0, 0, 1, got {M[3].tolist()}; is it transposed?")
    det = float(torch.linalg.det(M[:3, :3]))
    if det <= 0:
        raise ValueError(f"{name}: expected a rotation times a scale above 0, got determinant {det:.3g}; flip one axis")
    scale = det ** (1 / 3)
    R = M[:3, :3] / scale
    # 1e-3 is far above what rounding to six digits leaves, and far below any intended shear.
    if (error := float((R @ R.T - torch.eye(3)).abs().max())) > 1e-3:
        raise ValueError(
            f"{name}: expected a rotation times a scale, got |R Rᵀ − 1| up to {error:.2g}; remove the shear"
        )
    U, _, Vh = torch.linalg.svd(R)
    one = torch.ones((), dtype=torch.float64)
    return Pose(U @ Vh, M[:3, 3].clone(), scale * one, one)


def rotation_vector(R: Tensor) -> Tensor:
    """Return the axis of a rotation (3, 3) times its angle, which is below π. The cosine alone has no digits near 0, so the sine
    is used, too."""
    axis = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = float(axis.norm())
    return axis * (math.atan2(sine, 0.5 * (float(R.trace()) - 1.0)) / sine if sine > 0.0 else 1.0)


def angle(A: Tensor, B: Tensor) -> float:
    """Return the radians of the rotation from A (3, 3) to B."""
    R = A.T @ B
    sine = 0.5 * torch.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]).norm()
    return math.atan2(float(sine), float(0.5 * (R.trace() - 1.0)))


@dataclass(frozen=True, eq=False)
class PoseParameter:
    """A pose to find, in steps of a rotation vector about the object's centre and a shift in sizes of the object.

    Parameters
    ----------
    init : PoseFit, Tensor or tuple, optional
        An earlier fit, mesh to world (4, 4), (R, t) or (R, t, scale). By default the vertices stay where they are.
    of : Mesh or Scene, optional
        The object: centre and size are those of its bounding box. By default the part of the scene that the parameter's name
        names.
    rotation, shift : float, default 0.01
        Learning rates, about radians, and sizes of the object (diagonals of its bounding box), per step.
    scale : float, optional
        Learning rate of the logarithm of the scale, which is fixed by default.
    """

    init: Any = None
    of: Mesh | Scene | None = None
    rotation: float = 0.01
    shift: float = 0.01
    scale: float | None = None

    def placed(self, name: str, of: Mesh | Scene | None = None) -> Placement:
        """Return the checked parameter of an object, by default `of`. Raises TypeError or ValueError."""
        for rate in ("rotation", "shift", "scale"):
            if rate != "scale" or self.scale is not None:
                check_positive(f"{name}: {rate}", getattr(self, rate), least=0.0, most=1e30)
        thing = of if self.of is None else self.of
        if not isinstance(thing, Mesh | Scene):
            got = "none" if thing is None else type(thing).__name__
            raise TypeError(
                f"{name}: of: expected the Mesh or Scene that is moved, got {got}; give PoseParameter(…, of=mesh)"
            )
        meshes = [thing] if isinstance(thing, Mesh) else thing.meshes
        verts = torch.cat([mesh.verts.detach().cpu().double() for mesh in meshes])
        low, high = verts.aminmax(dim=0)
        size = float((high - low).norm())
        if size == 0.0:
            raise ValueError(f"{name}: of: expected an object with a size, got all vertices at one place")
        return Placement(self, _checked(name, self.init), 0.5 * (low + high), size, meshes[0].verts.dtype)


def _checked(name: str, init: Any) -> Pose:
    """Return the pose in float64 on the CPU. Raises TypeError or ValueError."""
    f64 = torch.float64
    if init is None:
        return Pose(torch.eye(3, dtype=f64), torch.zeros(3, dtype=f64))
    if not isinstance(init, tuple) or not 2 <= len(init) <= 6:
        return pose_from_matrix(f"{name}: init", getattr(init, "matrix", init))
    shapes = {"R": (3, 3), "t": (3,), "scale": ()}
    parts = zip(shapes.items(), Pose(*init), strict=False)
    R, t, scale = (as_double(f"{name}: {part}", x, shape).cpu().clone() for (part, shape), x in parts)
    check_rotation(f"{name}: R", R)
    if float(scale) <= 0.0:
        raise ValueError(f"{name}: scale: expected a number above 0, got {float(scale):g}")
    return Pose(R, t, scale)


@dataclass(frozen=True, eq=False)
class Placement:
    """A PoseParameter of a known object. Its coordinates are zero at the start: a rotation vector ω about the centre c, a shift
    d in sizes, and the logarithm of a scale. R = exp([ω]×) R₀, and the centre is at s₀ R₀ c + t₀ + d · size."""

    parameter: PoseParameter
    start: Pose
    center: Tensor  # (3,) of the object, before it is moved
    size: float
    dtype: torch.dtype  # of its vertices

    @property
    def coordinates(self) -> dict[str, Parameter]:
        """Return the coordinates as parameters, by the names that gradients have in histories."""
        rates = {"rotation": self.parameter.rotation, "shift": self.parameter.shift}
        found = {name: Parameter(rate, torch.zeros(3, dtype=torch.float64)) for name, rate in rates.items()}
        if self.parameter.scale is not None:
            found["scale"] = Parameter(self.parameter.scale, torch.zeros((), dtype=torch.float64))
        return found

    def pose(self, values: Mapping[str, Tensor]) -> Pose:
        """Return the pose at these coordinates, differentiable."""
        R0, t0, s0 = self.start[:3]
        R = rotation(values["rotation"]) @ R0
        scale = s0 * values["scale"].exp() if "scale" in values else s0
        middle = s0 * (R0 @ self.center) + t0 + self.size * s0 * values["shift"]
        return Pose(R, middle - scale * (R @ self.center), scale)


class Coordinates:
    """The tensors in which a fit takes its steps, and the values, some of them poses, of which a scene is made."""

    def __init__(self, parameters: Mapping[str, Parameter | Placement]) -> None:
        self.placements = {name: p for name, p in parameters.items() if isinstance(p, Placement)}
        self.parameters = {name: p for name, p in parameters.items() if isinstance(p, Parameter)}
        for name, placement in self.placements.items():
            self.parameters |= {f"{name}.{part}": p for part, p in placement.coordinates.items()}

    def values(self, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return a tensor, or a Pose for each PoseParameter, by the parameters' names; differentiable."""
        poses = self.poses(tensors).items()
        typed = {n: Pose(*(part.to(self.placements[n].dtype) for part in pose[:3])) for n, pose in poses}
        return self._others(tensors) | typed

    def result_values(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the values without gradients, poses as matrices (4, 4) float64, as results and histories hold them."""
        matrices = {name: pose.matrix for name, pose in self.poses(tensors).items()}
        return {name: value.detach() for name, value in (self._others(tensors) | matrices).items()}

    def recorded(self, record: Record) -> Record:
        """Return the record as histories hold it."""
        return record._replace(values=self.result_values(record.values)) if self.placements else record

    def poses(self, tensors: Mapping[str, Tensor]) -> dict[str, Pose]:
        """Return the poses by name, in float64."""
        return {
            name: placement.pose({part: tensors[f"{name}.{part}"] for part in placement.coordinates})
            for name, placement in self.placements.items()
        }

    def _others(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return the tensors that are no coordinates of poses."""
        return {name: tensor for name, tensor in tensors.items() if name.rpartition(".")[0] not in self.placements}
