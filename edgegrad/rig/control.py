"""The numbers that move a rig."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from ..check import as_tensor, check_finite, check_shape
from .rotations import as_matrices, one_as_matrix

Values = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Control:
    """Some numbers that move a rig, under one name.

    Parameters
    ----------
    rest : tensor of any shape, for rotations (J, 3) rotation vectors in radians
        Their values at rest.
    low, high : of the same shape, default none
        Limits.
    names : tuple of str
        Names of the rows: joints, morph targets.
    rotates : bool, default False
        Whether they are rotations, which posed() also takes as quaternions or matrices.
    """

    rest: Tensor
    low: Tensor | None = None
    high: Tensor | None = None
    names: tuple[str, ...] = ()
    rotates: bool = False

    def checked(self, name: str) -> Control:
        """Return the control in float64. Raises TypeError or ValueError."""
        rest = as_tensor(name, self.rest, floating=True).detach().double()
        check_finite(name, rest)
        if self.names and (rest.dim() == 0 or len(self.names) != len(rest)):
            raise ValueError(f"{name}: names: expected one for each row of {tuple(rest.shape)}, got {len(self.names)}")
        return replace(self, rest=rest).limited(name, self.low, self.high)

    def limited(self, name: str, low: object, high: object) -> Control:
        """Return the control with these limits, which broadcast. Raises ValueError."""
        bounds = []
        for side, bound in (("low", low), ("high", high)):
            tensor = None if bound is None else as_tensor(f"{name}: {side}", bound, like=self.rest).detach().double()
            if tensor is not None and bool(tensor.isnan().any()):
                raise ValueError(f"{name}: {side}: expected numbers, or infinity for no limit, got nan")
            try:
                bounds.append(None if tensor is None else tensor.expand(self.rest.shape))
            except RuntimeError as error:
                raise ValueError(
                    f"{name}: {side}: expected limits of shape {tuple(self.rest.shape)}, got {tuple(tensor.shape)}"  # type: ignore[union-attr]
                ) from error
        if bounds[0] is not None and bounds[1] is not None and bool((bounds[0] > bounds[1]).any()):
            raise ValueError(f"{name}: expected limits with low ≤ high, got {low} and {high}")
        return replace(self, low=bounds[0], high=bounds[1])

    def row(self, name: str, which: object) -> int:
        """Return the place of a row by its name. Raises ValueError."""
        if which not in self.names:
            raise ValueError(f"{name}: expected names among {', '.join(self.names)}, got {which!r}")
        return self.names.index(str(which))

    def value(self, name: str, given: object) -> Tensor:
        """Return a value in float64, with or without a batch in front; of rotations matrices (…, J, 3, 3).

        Raises TypeError or ValueError.
        """
        if given is None:
            value = self.rest
        elif isinstance(given, Mapping):
            return self._of_rows(name, given)
        else:
            value = as_tensor(name, given, like=self.rest).double()
        check_finite(name, value)
        if self.rotates:
            return as_matrices(name, value, len(self.rest))
        check_shape(name, value, tuple(self.rest.shape), ("B", *self.rest.shape))
        return value

    def _of_rows(self, name: str, given: Mapping[str, Any]) -> Tensor:
        """Return the value where some rows are given by their names, each with or without a batch in front."""
        rows, several = list(as_matrices(name, self.rest, len(self.rest)) if self.rotates else self.rest), []
        dims = rows[0].dim()
        for key, row in given.items():
            which = f"{name}[{key!r}]"
            one, k = as_tensor(which, row, like=self.rest).double(), self.row(name, key)
            if self.rotates:
                one = one_as_matrix(which, one)
            else:
                check_shape(which, one, tuple(rows[k].shape), ("B", *rows[k].shape))
                check_finite(which, one)
            several.append((which, one, dims))
            rows[k] = one
        batch = batch_of(several)
        if batch is not None:
            rows = [row.expand(batch, *row.shape[row.dim() - dims :]) for row in rows]
        return torch.stack(rows, -1 - dims)

    def within(self, value: Tensor) -> Tensor:
        """Clamp to the limits."""
        if self.low is not None:
            value = torch.maximum(value, self.low.to(value))
        return value if self.high is None else torch.minimum(value, self.high.to(value))


def batch_of(values: Sequence[tuple[str, Tensor, int]]) -> int | None:
    """Return the number of poses that values are given for, by their names and dimensions without a batch; None for a single
    one. Raises ValueError where they differ."""
    counts = {name: len(value) for name, value, dims in values if value.dim() > dims}
    if len(set(counts.values())) > 1:
        said = ", ".join(f"{count} of {name}" for name, count in counts.items())
        raise ValueError(f"expected as many poses of each value, or one without that dimension for all, got {said}")
    return next(iter(counts.values()), None)
