"""Losses between a render and a picture.

Each takes an image and a target (..., H, W, C) and optionally a weight (..., H, W, 1), and returns the weighted mean over
pixels and channels. A fit takes any function of this form.

A render has noise that is independent of the noise of its gradient. The gradient of `l2` is therefore unbiased with any number
of samples; gradients of other losses are unbiased in the limit of many. Losses that discount outliers (`l1`, `huber`, `robust`)
are for faults of the picture. With a noisy render they also drop rare bright samples, which carry a part of its light.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

__all__ = ["huber", "iou", "l1", "l2", "multiscale", "robust"]

Loss = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def _mean(values: Tensor, weight: Tensor | None) -> Tensor:
    if weight is None:
        return values.mean()
    return (values * weight).sum() / (weight.sum() * values.shape[-1]).clamp(min=1e-30)


def l1(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean of |r|, r = image − target: outliers count less than with l2.

    Parameters
    ----------
    image, target : (..., H, W, C)
    weight : (..., H, W, 1), default ones
        Weight of each pixel in the mean.

    Examples
    --------
    >>> import torch, edgegrad as eg
    >>> eg.fit.losses.l1(torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.5))
    tensor(0.5000)
    """
    return _mean((image - target).abs(), weight)


def l2(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return the mean of r², r = image − target: the best loss where the differences are noise alone.

    Parameters
    ----------
    image, target, weight : as of l1()
    """
    return _mean((image - target).square(), weight)


def huber(image: Tensor, target: Tensor, weight: Tensor | None = None, scale: float = 0.1) -> Tensor:
    """Return the mean of ½ r² up to |r| = scale, and scale (|r| − ½ scale) beyond (Huber 1964).

    Parameters
    ----------
    image, target, weight : as of l1()
    scale : float, default 0.1
    """
    return _mean(F.huber_loss(image, target, reduction="none", delta=scale), weight)


def robust(
    image: Tensor, target: Tensor, weight: Tensor | None = None, scale: float = 0.1, alpha: float = -2.0
) -> Tensor:
    """Return the mean of ρ(r) = |α−2|/α (((r/scale)² / |α−2| + 1)^(α/2) − 1), a general robust loss (Barron 2019).

    The noise of the render must be well below `scale`: rare bright samples, as of glossy surfaces under small lights, would be
    dropped too and bias the fit. Raise spp and Sampling.lights first.

    Parameters
    ----------
    image, target, weight : as of l1()
    scale : float, default 0.1
        Residuals far beyond hardly count with alpha ≤ 0, whatever hides the object there.
    alpha : float, default −2
        With x = r/scale, 2 is l2, 1 a smooth l1, 0 Cauchy's log(½ x² + 1), −2 Geman and McClure's 2x² / (x² + 4), and −∞
        Welsch's 1 − exp(−½ x²).
    """
    square = ((image - target) / scale).square()
    if alpha == 2.0:
        rho = 0.5 * square
    elif alpha == 0.0:
        rho = torch.log1p(0.5 * square)
    elif alpha == -torch.inf:
        rho = -torch.expm1(-0.5 * square)
    else:
        b = abs(alpha - 2.0)
        rho = b / alpha * ((square / b + 1.0) ** (0.5 * alpha) - 1.0)
    return _mean(rho, weight)


def iou(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
    """Return 1 − Σ min(a, b) / Σ max(a, b) of soft masks: one minus intersection over union, over each whole image.

    Parameters
    ----------
    image, target, weight : as of l1()
    """
    w = torch.ones_like(image[..., :1]) if weight is None else weight
    both, either = ((w * f(image, target)).sum((-3, -2, -1)) for f in (torch.minimum, torch.maximum))
    return (1.0 - both / either.clamp(min=1e-30)).mean()


def multiscale(loss: Loss = l2, levels: int = 4) -> Loss:
    """Return a loss that is the mean of `loss` over an image pyramid of halved levels; it sees farther than a pixel.

    Parameters
    ----------
    loss, levels : function of image, target and weight, default l2, and int, default 4
    """

    def over_levels(image: Tensor, target: Tensor, weight: Tensor | None = None) -> Tensor:
        total = torch.zeros((), dtype=image.dtype)
        w = torch.ones_like(target[..., :1]) if weight is None else weight
        image, target = image * w, target * w
        used = 0
        for _ in range(levels):
            # Dividing by the weight keeps hidden pixels from darkening their neighbours.
            share = w.clamp(min=1e-6)
            total, used = total + loss(image / share, target / share, w), used + 1
            if min(image.shape[-3:-1]) < 2:
                break
            image, target, w = (_halved(x) for x in (image, target, w))
        return total / used

    return over_levels


def _halved(x: Tensor) -> Tensor:
    flat = x.reshape(-1, *x.shape[-3:]).movedim(-1, 1)
    return F.avg_pool2d(flat, 2).movedim(1, -1).reshape(*x.shape[:-3], x.shape[-3] // 2, x.shape[-2] // 2, x.shape[-1])


REGION = "region"  # compares pictures with silhouettes: see descent/region_loss.py
LOSSES: dict[str, Loss] = {"l1": l1, "l2": l2, "huber": huber, "robust": robust, "iou": iou}


def loss_of(name: str, loss: str | Loss) -> Loss:
    """Return the loss of that name, or a function that checks what the given one returns. Raises TypeError or ValueError."""
    if callable(loss):
        return _checked(name, loss)
    if not isinstance(loss, str):
        raise TypeError(f"{name}: expected a name or a function of image, target and weight, got {type(loss).__name__}")
    if loss not in LOSSES:
        known = ", ".join([*LOSSES, REGION] if name == "options.loss" else LOSSES)
        raise ValueError(f"{name}: expected one of {known}, or a function, got {loss!r}")
    return LOSSES[loss]


def _checked(name: str, loss: Loss) -> Loss:
    def checked(image: Tensor, target: Tensor, weight: Tensor | None) -> Tensor:
        found = loss(image, target, weight)
        if not isinstance(found, Tensor) or found.numel() != 1:
            got = f"shape {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
            raise ValueError(f"{name}: expected a function that gives a tensor of one number, got {got}; take its mean")
        if image.requires_grad and torch.is_grad_enabled() and not found.requires_grad:
            raise ValueError(
                f"{name}: expected a number with a gradient by the image, got one that does not depend on it; compute it with "
                "torch from `image`, without detach(), item(), NumPy or no_grad()"
            )
        return found.reshape(())

    return checked
