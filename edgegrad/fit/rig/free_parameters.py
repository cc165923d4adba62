"""The free parameters of a fit of a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ...check import as_tensor, check_finite, check_shape
from ...optim.parameter import Parameter
from ...rig.control import Control
from ...rig.rig import Rig
from ...rig.skinned import SkinDeformer
from .settings import RIG

F64 = torch.float64


@dataclass(frozen=True, eq=False)
class FreeParameters:
    """The values that are sought, and all others."""

    rig: Rig
    fixed: dict[str, Tensor]  # all values at the start
    parameters: dict[str, Parameter]
    rows: dict[str, Tensor]  # sought rows of the values that are rotations of joints
    appearance: tuple[str, ...] = ()  # parameters of the appearance

    @staticmethod
    def from_arguments(
        rig: Rig, seek: Sequence[str] | None, init: Mapping[str, Any], appearance: Mapping[str, Parameter]
    ) -> FreeParameters:
        """Check what is sought. Raises TypeError or ValueError."""
        known = {name: control.rest for name, control in rig.controls.items()}
        known |= {name: torch.zeros(3, dtype=F64) for name in ("translation", "orientation")}
        known["scale"] = torch.ones((), dtype=F64)
        skinned = isinstance(rig.deformer, SkinDeformer)
        if seek is None:
            seek = [name for name in rig.controls if not skinned or name not in ("joint_translations", "joint_scales")]
            seek += ["translation"] if skinned else [] if "angles" in rig.controls else ["translation", "orientation"]
        of_joint = {
            joint: name
            for name, control in rig.controls.items()
            if _turns(name, control)
            for joint in control.names or ()
        }
        for kind, names, allowed in (("seek", seek, {**known, **of_joint}), ("init", init, known)):
            for name in names:
                if name not in allowed:
                    raise ValueError(f"{kind}: expected names among {', '.join(allowed)}, got {name!r}")
        fixed = {}
        for name, rest in known.items():
            given = init.get(name)
            if given is None:
                value = rig.controls.get(name, Control(rest)).within(rest.clone())
            elif name in rig.controls:
                value = rig.clamped(**{name: given})[name].detach()
            else:
                value = as_tensor(f"init[{name!r}]", given, like=rest).detach().double()
            check_shape(f"init[{name!r}]", value, tuple(rest.shape), fix="one pose")
            check_finite(f"init[{name!r}]", value)
            fixed[name] = value
        parameters, rows = {}, {}
        for name in dict.fromkeys(name if name in known else of_joint[name] for name in seek):
            control = rig.controls.get(name, Control(known[name]))
            sought = Parameter(_rate(rig, name, control), fixed[name].clone(), control.low, control.high).checked(name)
            if _turns(name, control):
                joints = None if name in seek else [joint for joint in seek if of_joint.get(joint) == name]
                rows[name] = torch.tensor(_free(rig, name, control, joints))
                sought = rows_of(sought, rows[name])
            parameters[name] = sought
        for name, parameter in appearance.items():
            if name in known:
                raise ValueError(
                    f"parameters: expected names that the rig does not have, got {name!r}; seek=[{name!r}]"
                )
            if not isinstance(parameter, Parameter):
                raise TypeError(f"parameters[{name!r}]: expected a Parameter, got {type(parameter).__name__}")
            parameters[name] = parameter.checked(name)
        if not parameters:
            raise ValueError("seek: expected a name or more of what is sought, got none")
        return FreeParameters(rig, fixed, parameters, rows, tuple(appearance))

    @property
    def start(self) -> dict[str, Tensor]:
        return {name: p.value for name, p in self.parameters.items() if p.value is not None}

    def starting_at(self, values: Mapping[str, Tensor]) -> dict[str, Parameter]:
        """Return the parameters with other initial values, clamped to their bounds."""
        return {name: replace(p, value=p.within(values[name])) for name, p in self.parameters.items()}

    @property
    def joints(self) -> dict[str, tuple[str, ...]]:
        """The names of joints, by the sought values that are their rotations."""
        names = {name: self.rig.controls[name].names for name in self.rows}
        return {name: tuple(own[k] for k in self.rows[name].tolist()) for name, own in names.items() if own}

    def values(self, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Return all sought values of the rig, of one pose or a batch, with the rows that are fixed; differentiable."""
        return {
            name: with_rows(self.fixed[name], self.rows[name], tensor) if name in self.rows else tensor
            for name, tensor in tensors.items()
            if name not in self.appearance
        }

    def appearance_of(self, tensors: Mapping[str, Tensor], index: int | None = None) -> dict[str, Tensor]:
        """Return the parameters of the appearance, of one pose or of that place in a batch."""
        found = {}
        for name in self.appearance:
            value, own = tensors[name], self.parameters[name].value
            assert own is not None
            found[name] = value[index] if index is not None and value.dim() > own.dim() else value
        return found

    def all(self, tensors: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return all values, as posed() takes them."""
        return {**self.fixed, **self.values(tensors)}


def with_rows(value: Tensor, rows: Tensor, part: Tensor) -> Tensor:
    """Return a value with other rows, or a batch of them; differentiable."""
    at = part.dim() - value.dim()
    return value.expand(*part.shape[:at], *value.shape).index_copy(at, rows, part)


def rows_of(parameter: Parameter, rows: Tensor) -> Parameter:
    """Return the parameter of some rows alone."""
    assert parameter.value is not None
    whole = parameter.value.shape
    low, high = (None if b is None else torch.as_tensor(b).expand(whole)[rows] for b in (parameter.low, parameter.high))
    return replace(parameter, value=parameter.value[rows], low=low, high=high)


def _turns(name: str, control: Control) -> bool:
    return control.rotates or name == "angles"


def _free(rig: Rig, name: str, control: Control, joints: Sequence[str] | None) -> list[int]:
    """Return the rows of some joints, by default of those that vertices hang on."""
    if joints is not None:
        return sorted(control.row(name, joint) for joint in joints)
    if isinstance(rig.deformer, SkinDeformer):
        return sorted({int(j) for skin in rig.deformer.skins for j in skin.joints})
    return list(range(len(control.rest)))


def _rate(rig: Rig, name: str, control: Control) -> float:
    """Return the size of a step, in the value's own units."""
    if control.rotates or name in ("orientation", "angles"):
        return RIG.rotation_rate
    if name in ("translation", "joint_translations"):
        return RIG.translation_rate * rig.size
    if control.low is not None and control.high is not None:
        span = float((control.high - control.low).max())
        return RIG.other_rate * span if 0.0 < span < float("inf") else RIG.other_rate
    return RIG.other_rate
