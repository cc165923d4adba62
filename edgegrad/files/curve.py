"""Response curves of cameras: from the numbers of an image file, 0 … 1, to linear radiance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ..check import as_tensor, check_finite

Curve = str | float | Tensor | Sequence[Any] | Callable[[Tensor], Tensor]
STEEPEST = 10.0  # exponent


def decoder(curve: Curve, srgb: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    """Return the function from file values (N, C) to linear radiance (N, C), both float64. Raises TypeError or ValueError."""
    if isinstance(curve, str):
        if curve != "srgb":
            raise ValueError(f'curve: expected "srgb", an exponent, a table or a function, got {curve!r}')
        return srgb
    if isinstance(curve, (int, float)) and not isinstance(curve, bool):
        if not 0.0 < curve <= STEEPEST:  # also not NaN
            raise ValueError(
                f"curve: expected an exponent above 0 and up to {STEEPEST:g}, such as 2.2, got {curve:g}; 1 leaves values as "
                "they are"
            )
        return lambda values: values.pow(float(curve))
    if callable(curve) and not isinstance(curve, Tensor):
        return lambda values: _called(curve, values)
    if isinstance(curve, bool) or curve is None:
        raise TypeError(f'curve: expected "srgb", an exponent, a table or a function, got {curve!r}')
    table = as_tensor("curve", curve).detach().cpu().double()
    table = table[:, None] if table.dim() == 1 else table
    if table.dim() != 2 or len(table) < 2 or table.shape[1] not in (1, 3):
        raise ValueError(
            f"curve: expected a table (N,), or (N, 3) with a column for each colour, of N ≥ 2 radiances, got shape "
            f"{tuple(torch.as_tensor(curve).shape)}"
        )
    check_finite("curve", table)
    if bool((table < 0.0).any()):
        raise ValueError(f"curve: expected radiances from 0 up, got {float(table.min()):g}; take exp() of logarithms")
    falls = (table.diff(dim=0) < 0.0).any(1)
    if bool(falls.any()):
        k = int(falls.nonzero()[0, 0])
        before, after = ([float(f"{number:.4g}") for number in row] for row in table[k : k + 2].tolist())
        raise ValueError(
            f"curve: expected radiances that rise with the value, got {before} and then {after} at "
            f"entries {k} and {k + 1}; sort the table by the value, or smooth what was measured"
        )
    if bool((table[0] == table[-1]).any()):
        raise ValueError(f"curve: expected radiances that rise with the value, got {float(table[0, 0]):g} everywhere")
    return lambda values: _looked_up(table, values)


def _looked_up(table: Tensor, values: Tensor) -> Tensor:
    """Interpolate linearly between entries, which stand for values evenly spaced from 0 to 1."""
    if table.shape[1] not in (1, values.shape[1]):
        raise ValueError(
            f"curve: expected a table (N,) for an image of {values.shape[1]} channel(s), got {table.shape[1]} columns"
        )
    table = table.expand(-1, values.shape[1])
    place = values.clamp(0.0, 1.0) * (len(table) - 1)
    low = place.floor().long().clamp(max=len(table) - 2)
    return torch.lerp(table.gather(0, low), table.gather(0, low + 1), place - low)


def _called(curve: Callable[[Tensor], Any], values: Tensor) -> Tensor:
    found = curve(values.clone())
    try:
        made = torch.as_tensor(found)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"curve: expected a function that gives numbers, got {type(found).__name__} from it") from None
    if made.is_complex():
        raise TypeError("curve: expected a function that gives real numbers, got complex ones from it")
    if made.shape != values.shape:
        raise ValueError(
            f"curve: expected a function that gives radiances in the shape of the values, {tuple(values.shape)}, got "
            f"{tuple(made.shape)}"
        )
    made = made.detach().cpu().double()
    check_finite("curve: radiances", made)
    return made
