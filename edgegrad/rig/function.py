"""Meshes that a function bends, such as a body model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..check import check_finite
from ..scene.mesh import Mesh
from ..scene.rows import vertex_normals
from .control import Control
from .rotations import roma

# Arguments of posed() for the whole, which would never reach a function.
PLACING = "translation", "scale", "orientation", "skinning"


@dataclass(frozen=True, eq=False)
class FunctionDeformer:
    """A function from controls to vertices."""

    function: Callable[..., Any]
    controls: Mapping[str, Control]
    batched: bool
    names: tuple[str, ...]
    parents: tuple[int, ...]

    @staticmethod
    def from_arguments(
        function: Callable[..., Any],
        controls: Mapping[str, Tensor | Control],
        batched: bool,
        joints: Sequence[tuple[str, int]],
    ) -> FunctionDeformer:
        """Return the deformer of checked arguments. Raises TypeError or ValueError."""
        for name in controls:
            if name in PLACING:
                raise ValueError(
                    f"controls: expected names other than {', '.join(PLACING)}, which posed() takes for the whole, got {name!r}; "
                    "give the function's argument another name"
                )
        made = {
            str(name): (given if isinstance(given, Control) else Control(given)).checked(str(name))
            for name, given in controls.items()
        }
        names, parents = tuple(name for name, _ in joints), tuple(parent for _, parent in joints)
        return FunctionDeformer(function, made, batched, names, parents)

    def with_controls(self, controls: Mapping[str, Control]) -> FunctionDeformer:
        return replace(self, controls=controls)

    def at_rest(self) -> list[Tensor]:
        """Return the vertices (V, 3) of each mesh."""
        return self._parts({})[0]

    def __call__(
        self, values: Mapping[str, Tensor], meshes: Sequence[Mesh]
    ) -> tuple[list[Tensor], list[Tensor | None], Tensor | None]:
        verts, joints = self._parts(values)
        if len(verts) != len(meshes):
            raise ValueError(f"function: expected vertices of {len(meshes)} meshes, got {len(verts)}")
        found = []
        for k, (own, mesh) in enumerate(zip(verts, meshes, strict=True)):
            if own.shape[-2:] != mesh.verts.shape:
                raise ValueError(
                    f"function: expected vertices {tuple(mesh.verts.shape)} of mesh {k}, got {tuple(own.shape)}; give its faces"
                )
            check_finite("vertices of the function", own)
            found.append(own.to(mesh.verts.dtype))
        return found, [self._normals(own, mesh) for own, mesh in zip(found, meshes, strict=True)], joints

    def _normals(self, verts: Tensor, mesh: Mesh) -> Tensor | None:
        """Return normals of the bent surface, where the mesh at rest has one for each vertex."""
        if mesh.normals is None or mesh.normal_faces is not None:
            return None
        if verts.dim() == 2:
            return vertex_normals(verts, mesh.faces)
        return torch.stack([vertex_normals(v, mesh.faces) for v in verts])

    def _parts(self, values: Mapping[str, Tensor]) -> tuple[list[Tensor], Tensor | None]:
        """Return vertices of each mesh and joints, with a batch where a value has one."""
        full, counts = {}, []
        for name, control in self.controls.items():
            value = values.get(name, control.rest)
            if control.rotates and name in values:  # matrices inside; the function takes rotation vectors
                value = roma().rotmat_to_rotvec(value)
            if value.dim() > control.rest.dim():
                counts.append(len(value))
            full[name] = value
        if self.batched:
            B = counts[0] if counts else 1
            whole = {n: v if v.dim() > self.controls[n].rest.dim() else v.expand(B, *v.shape) for n, v in full.items()}
            verts, joints = _split(self.function(**whole))
            if not counts:
                return [v.squeeze(0) for v in verts], None if joints is None else joints.squeeze(0)
            return verts, joints
        if not counts:
            return _split(self.function(**full))
        several = [
            _split(self.function(**{n: v[k] if v.dim() > self.controls[n].rest.dim() else v for n, v in full.items()}))
            for k in range(counts[0])
        ]
        joints = [own for _, own in several if own is not None]
        parts = [torch.stack(column) for column in zip(*(verts for verts, _ in several), strict=True)]
        return parts, torch.stack(joints) if joints else None


def _split(returned: Any) -> tuple[list[Tensor], Tensor | None]:
    verts, joints = (
        (returned.get("verts"), returned.get("joints")) if isinstance(returned, Mapping) else (returned, None)
    )
    parts = [verts] if isinstance(verts, Tensor) else verts
    if not isinstance(parts, (list, tuple)) or not parts or not all(isinstance(part, Tensor) for part in parts):
        got = type(returned).__name__
        raise TypeError(f'function: expected vertices (V, 3), a list of these, or a dict with "verts", got {got}')
    return list(parts), None if joints is None else joints.double()
