"""Whether derivatives may be asked for, in any of torch's ways."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def transformed() -> bool:
    """Return whether a transform of torch.func is under way."""
    functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    return functorch.peek_interpreter_stack() is not None


def _compiles_wrongly() -> bool:
    """Return, as torch.compile traces, whether it would take derivatives for zero: it does not trace those of an operator but
    for one torch.func.grad, or torch.vmap, alone."""
    functorch: Any = torch._C._functorch  # pyright: ignore[reportAttributeAccessIssue]
    kinds = [level.key() for level in functorch.get_interpreter_stack() or ()]
    kind = functorch.TransformType
    return kind.Jvp in kinds or (kind.Grad in kinds and len(kinds) > 1)


# torch.compiler.assume_constant_result() does the same, and imports the compiler.
setattr(_compiles_wrongly, "_dynamo_marked_constant", True)  # noqa: B010  no attribute that type checkers know


def check_compiled() -> None:
    """Raise RuntimeError where torch.compile would give wrong derivatives without a word. Without fullgraph=True it then runs
    the function as it is."""
    if torch.compiler.is_compiling() and _compiles_wrongly():
        raise RuntimeError(
            "torch.compile: expected no forward mode and no nested transforms of torch.func around a render within the compiled "
            "function, for their derivatives would be zero; compile what is inside, as in torch.func.jvp(torch.compile(f), …)"
        )


def is_eager() -> bool:
    """Return whether tensors have values of their own: neither a transform of torch.func, nor forward mode, nor torch.compile
    is under way."""
    return not (transformed() or torch.autograd.forward_ad._current_level >= 0 or torch.compiler.is_compiling())


def differentiates() -> bool:
    return torch.is_grad_enabled() or transformed() or torch.autograd.forward_ad._current_level >= 0


def moves(*tensors: Tensor) -> bool:
    """Return whether a derivative by one of them may be asked for."""
    if transformed():
        return True
    if torch.is_grad_enabled() and any(t.requires_grad for t in tensors):
        return True
    dual = torch.autograd.forward_ad
    return dual._current_level >= 0 and any(dual.unpack_dual(t).tangent is not None for t in tensors)
