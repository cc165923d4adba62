"""Checks of user input. Every message names the argument, what was expected, what came, and how to fix it."""

from __future__ import annotations

import dataclasses
import operator
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from torch import Tensor

from .library import core

# Numbers beyond the range of float32, in float64: the kernel multiplies up to seven of them (a triple product of positions
# by two focal lengths, by colour and adjoint), which must stay below 1e308.
LARGEST = torch.finfo(torch.float32).max
UNSIGNED = (torch.uint16, torch.uint32, torch.uint64)  # for which torch has few operations
MOST_ROWS = 2**31 - 1  # of any array that is referred to by index: inside, indices have 32 bits


def as_tensor(name: str, value: object, *, like: Tensor | None = None, floating: bool = False) -> Tensor:
    """Return `value` as a tensor: tensors pass unchanged, numbers, sequences and NumPy arrays are converted. They go to the
    device of `like` and, if `like` is floating-point, to a floating-point dtype; with `floating` always to one. UNSIGNED become
    int64. Raises TypeError when `value` is none of these, a sparse tensor, or a sequence of tensors whose gradients would be
    lost."""
    if isinstance(value, Tensor):
        if value.layout is not torch.strided or value.is_nested:
            kind = "a nested one" if value.is_nested else f"one of layout {value.layout}"
            raise TypeError(f"{name}: expected a dense tensor, got {kind}; use .to_dense() or pad it")
        _check_real(name, value)
        if value.dtype in UNSIGNED:
            return value.to(torch.int64)
        return value.resolve_neg()  # itself, unless it is a view that says only that its numbers are negated
    if _needs_gradient(value):
        raise TypeError(
            f"{name}: expected a tensor where gradients are required, got a sequence of them; use torch.stack"
        )
    if any(stride < 0 for stride in getattr(value, "strides", ())):  # image[::-1] of NumPy, which torch refuses
        value = value.copy()  # pyright: ignore[reportAttributeAccessIssue]
    try:
        tensor = torch.as_tensor(value, device=None if like is None else like.device)
        if like is not None and like.is_floating_point() and tensor.dtype != like.dtype and not hasattr(value, "dtype"):
            tensor = torch.as_tensor(value, dtype=like.dtype, device=like.device)  # numbers of Python are double
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise TypeError(
            f"{name}: expected a tensor, array or nested sequence of numbers, got {type(value).__name__}; "
            f"convert it with torch.as_tensor ({error})"
        ) from None
    _check_real(name, tensor)
    if tensor.dtype in UNSIGNED:
        tensor = tensor.to(torch.int64)
    if not tensor.is_floating_point() and like is not None and like.is_floating_point():
        tensor = tensor.to(like.dtype)
    elif floating and not tensor.is_floating_point():
        tensor = tensor.to(torch.get_default_dtype())
    return tensor


def _check_real(name: str, tensor: Tensor) -> None:
    """Refuse complex numbers, of which a conversion would drop the imaginary part. Raises TypeError."""
    if tensor.is_complex():
        raise TypeError(f"{name}: expected real numbers, got {tensor.dtype}; take their .real")


def _needs_gradient(value: object) -> bool:
    if isinstance(value, Tensor):
        return value.requires_grad
    return isinstance(value, (list, tuple)) and any(map(_needs_gradient, value))


def shape_text(shape: Sequence[int | str]) -> str:
    return "(" + ", ".join(str(n) for n in shape) + ("," if len(shape) == 1 else "") + ")"


def check_shape(name: str, tensor: Tensor, *expected: Sequence[int | str], fix: str = "") -> None:
    """Check that `tensor.shape` matches one of `expected`, in which a string stands for any size ≥ 1. Raises ValueError."""

    def matches(shape: Sequence[int | str]) -> bool:
        return len(shape) == tensor.dim() and all(
            n >= 1 if isinstance(want, str) else n == want for n, want in zip(tensor.shape, shape, strict=True)
        )

    if not any(matches(shape) for shape in expected):
        want = " or ".join(shape_text(shape) for shape in expected)
        if 0 in tensor.shape and any(len(shape) == tensor.dim() for shape in expected):
            want += ", none of them 0"
        raise ValueError(f"{name}: expected shape {want}, got {shape_text(tensor.shape)}{fix and '; ' + fix}")


def as_real(
    name: str, value: object, *shapes: Sequence[int | str], like: Tensor | None = None, largest: float = LARGEST
) -> Tensor:
    """Return `value` as a finite tensor of float32 or float64, of one of the shapes. Raises TypeError or ValueError."""
    tensor = as_tensor(name, value, like=like, floating=True)
    check_float(name, tensor)
    check_shape(name, tensor, *shapes)
    check_finite(name, tensor, largest=largest)
    return tensor


def as_double(name: str, value: object, *shapes: Sequence[int | str]) -> Tensor:
    """Return `value` detached, finite and in float64, of one of the shapes. Raises TypeError or ValueError."""
    tensor = as_tensor(name, value, floating=True).detach().double()
    check_shape(name, tensor, *shapes)
    check_finite(name, tensor)
    return tensor


def as_index(name: str, value: object, shape: Sequence[int | str], count: int, of: str) -> Tensor:
    """Return `value` as a tensor of indices into `count` rows of `of`. Raises TypeError or ValueError."""
    tensor = as_tensor(name, value)
    check_integer(name, tensor)
    check_shape(name, tensor, shape)
    check_indices(name, tensor, count, of)
    return tensor


def check_float(name: str, tensor: Tensor) -> None:
    """Check for float32 or float64. Raises TypeError."""
    if tensor.dtype not in (torch.float32, torch.float64):
        fix = (
            "of 8-bit sRGB values take srgb_to_linear(x / 255)"
            if tensor.dtype == torch.uint8
            else "convert it with .float()"
        )
        raise TypeError(f"{name}: expected float32 or float64, got {tensor.dtype}; {fix}")


def check_integer(name: str, tensor: Tensor) -> None:
    """Check for an integer dtype that holds indices. Raises TypeError."""
    if tensor.dtype not in (torch.int32, torch.int64, torch.int16, torch.uint8):
        raise TypeError(f"{name}: expected an integer dtype (int32 or int64), got {tensor.dtype}; use .long()")


def values_visible(*tensors: Tensor) -> bool:
    """Return whether values may be read: not while torch.compile traces or torch.vmap runs, where the kernel's own checks take
    over, and not those of meta tensors, which have none."""
    return not torch.compiler.is_compiling() and not any(tensor.is_meta or _batched(tensor) for tensor in tensors)


def _batched(tensor: Tensor) -> bool:
    """Return whether torch.vmap shows one element of a batch in its place, perhaps within other transforms of torch.func."""
    functorch = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    while functorch.is_functorch_wrapped_tensor(tensor):
        if functorch.is_batchedtensor(tensor):
            return True
        tensor = functorch.get_unwrapped(tensor)
    return False


def check_not_meta(name: str, tensor: Tensor) -> None:
    """Check that a tensor has values, on whatever device. Raises ValueError."""
    if tensor.is_meta:
        raise ValueError(f"{name}: expected numbers, got a meta tensor, which has none; make it on another device")


def check_fields(thing: Any, given: Iterable[str]) -> None:
    """Check that the arguments of `replace` are fields of the dataclass. Raises TypeError."""
    known = sorted(field.name for field in dataclasses.fields(thing))
    for name in given:
        if name not in known:
            raise TypeError(f"replace: expected one of {', '.join(known)}, got {name!r}")


def _ask_kernel(question: Callable[..., bool], tensor: Tensor, *more: Any) -> bool:
    """Return whether the kernel says yes of the numbers of a tensor. It is no where these are no array in memory: on another
    device, strided, seen through a transform of torch.func, or without storage. Torch would wake all threads for what one does
    faster; the kernel takes more for long arrays."""
    try:
        return tensor.data_ptr() != 0 and question(tensor.numpy(), *more, torch.get_num_threads())
    except (RuntimeError, TypeError):
        return False


def all_below(index: Tensor, count: int) -> bool:
    """Return whether all indices are in [0, count)."""
    if _ask_kernel(core.all_below, index, count):
        return True
    low, high = (int(v) for v in torch.aminmax(index))
    return low >= 0 and high < count


def all_finite(tensor: Tensor) -> bool:
    """Return whether no number is NaN or infinite."""
    return _ask_kernel(core.all_finite, tensor) or bool(torch.isfinite(tensor).all())


def check_storage(name: str, tensor: Tensor) -> None:
    """Refuse a tensor whose memory was given back: torch would read it, and end the process. Raises ValueError."""
    try:
        gone = tensor.numel() > 0 and tensor.untyped_storage().nbytes() == 0
    except (RuntimeError, NotImplementedError):  # seen through a transform, which holds the numbers
        return
    if gone:
        raise ValueError(f"{name}: expected numbers, got a tensor whose storage was resized to zero; keep its memory")


def check_finite(name: str, tensor: Tensor, *, largest: float = LARGEST, smallest: float = 0.0) -> None:
    """Check for NaN, infinity, and numbers larger than `largest`; the message names the first bad index. Unless all are zero,
    some must reach `smallest`. Raises ValueError."""
    if not values_visible(tensor):
        return
    check_storage(name, tensor)
    values = tensor.detach()
    # A fast pass says yes to nearly everything, before the exact answer. A sum is finite unless a term is not (or the
    # sum overflows); what a sum of squares reaches, no term exceeds.
    if largest == LARGEST and not smallest and _ask_kernel(core.all_finite, values):
        return
    if largest >= torch.finfo(values.dtype).max and not smallest:
        if bool(torch.isfinite(values.sum())):
            return
    else:
        flat = values.reshape(-1)
        if smallest**2 * flat.numel() <= float(torch.dot(flat, flat)) <= largest**2:
            return
    size = values.abs()
    if bool((bad := ~torch.isfinite(values)).any()):
        expected, fix = "finite numbers", "look for a division by zero or a diverged optimisation step before this call"
    elif bool((bad := size > largest).any()):
        expected, fix = f"numbers up to {largest:.3g}", "choose other units, or look for a diverged optimisation step"
    elif smallest and bool((bad := (size > 0) & (size.max() < smallest)).any()):
        expected, fix = f"numbers of which some are above {smallest:.3g}, or all zero", "choose other units"
    else:
        return
    index = tuple(bad.nonzero()[0].tolist())
    where = ", ".join(str(i) for i in index)
    raise ValueError(
        f"{name}: expected {expected}, got {values[index].item()} at [{where}] ({int(bad.sum())} such values in all); {fix}"
    )


def check_countable(name: str, tensor: Tensor, count: int, of: str) -> None:
    """Check for indices into `count` rows that 32 bits can count. Raises ValueError."""
    if tensor.shape[0] > MOST_ROWS // 3 or count > MOST_ROWS:
        raise ValueError(
            f"{name}: expected at most {MOST_ROWS // 3} faces and {MOST_ROWS} rows of {of} (indices have 32 bits inside), "
            f"got {tensor.shape[0]} and {count}; render the scene in parts"
        )


def check_indices(name: str, tensor: Tensor, count: int, of: str) -> None:
    """Check that all indices are in [0, count). Raises ValueError."""
    if not values_visible(tensor) or tensor.numel() == 0:
        return
    check_storage(name, tensor)
    if not all_below(tensor, count):
        low, high = (int(v) for v in torch.aminmax(tensor))
        value = low if low < 0 else high
        index = tuple((tensor == value).nonzero()[0].tolist())
        where = ", ".join(str(i) for i in index)
        raise ValueError(
            f"{name}: expected indices from 0 to {count - 1} ({of} has {count} rows), got {value} at [{where}]; "
            "indices count from zero"
        )


def as_int(name: str, value: object) -> int:
    """Return `value` as an int: ints of Python and NumPy, and tensors of one integer. Raises TypeError."""
    try:
        if isinstance(value, bool):
            raise TypeError
        # torch.compile keeps an int symbolic here; operator.index would compile once for each value.
        return value if isinstance(value, int) else operator.index(value)  # type: ignore[arg-type]
    except TypeError:
        raise TypeError(f"{name}: expected an int, got {type(value).__name__} ({value!r})") from None


def as_scalar(name: str, value: object, *, like: Tensor) -> Tensor:
    """Return a number, or a tensor of one, as a 0-d tensor of the dtype of `like`. Raises TypeError or ValueError."""
    tensor = as_tensor(name, value, like=like)
    if tensor.numel() != 1:
        raise ValueError(f"{name}: expected one number, got shape {shape_text(tensor.shape)}")
    return tensor.to(like).reshape(())


def check_int(name: str, value: object, least: int, most: int) -> int:
    """Return an int in [least, most]. Raises TypeError or ValueError."""
    number = as_int(name, value)
    if not least <= number <= most:
        raise ValueError(f"{name}: expected an int from {least} to {most}, got {number}")
    return number


def check_positive(name: str, value: object, *, least: float, most: float) -> float:
    """Return a number from `least` to `most`. Raises TypeError or ValueError."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError(f"{name}: expected a number, got {type(value).__name__} ({value!r})")
    if not least <= value <= most:  # nor where it is none
        raise ValueError(f"{name}: expected a number from {least:g} to {most:g}, got {value!r}")
    return float(value)


def check_positive_int(name: str, value: object, *, most: int = 2**31 - 1) -> int:
    """Return an int ≥ 1. Raises TypeError or ValueError."""
    return check_int(name, value, 1, most)


def check_dtype(dtype: torch.dtype | None) -> torch.dtype | None:
    """Return float32, float64 or None itself. Raises TypeError."""
    if dtype not in (None, torch.float32, torch.float64):
        raise TypeError(f"dtype: expected torch.float32, torch.float64 or None, got {dtype!r}")
    return dtype


def check_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """Return one of some words as a plain str. Raises ValueError."""
    if value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")
    return choices[choices.index(value)]


def check_flag(name: str, flag: object) -> bool:
    """Return True or False itself. Raises TypeError."""
    if not isinstance(flag, bool):
        raise TypeError(f"{name}: expected True or False, got {type(flag).__name__} ({flag!r})")
    return flag
