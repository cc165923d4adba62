"""noise(): how noisy the gradient of a loss is, and which spp lowers that."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .camera.camera import Camera
from .check import all_finite, check_positive, check_positive_int
from .kernel.counts import table
from .kernel.request import check_camera
from .library import core
from .render import render
from .sampling import RenderOptions, check_options, check_sampling, derived_seed, drawn_seed
from .scene.mesh import Mesh
from .scene.scene import Scene, as_scene
from .scene.tree import named_tensors

if TYPE_CHECKING:
    from typing_extensions import Unpack

LEAST_SIGNAL = 1 / 4  # the square of a mean gradient counts as at least this share of what is measured
FIRST_STREAM = 1 << 20  # of the seeds that follow from one, apart from those that render() derives


@dataclass(frozen=True)
class NoiseEstimate:
    """Estimated noise of a gradient and of its image, relative to their size. Prints as a table.

    Attributes
    ----------
    noise : dict of str to float
        Relative noise of the gradient by each tensor: the root mean square deviation of one gradient from its mean, over
        the norm of the mean. Above 1 it is a lower bound; NaN where the gradient is zero.
    uncertainty : dict of str to float
        Relative standard error of each of these numbers, as if the parts of a gradient were independent.
    image : float
        Relative noise of the image.
    spp : int
        Samples per pixel that were taken.
    target : float
        Wanted noise.
    seconds : float
        Time of an image with its gradient.
    share : float
        Share of this time that the gradient takes.
    """

    noise: Mapping[str, float]
    uncertainty: Mapping[str, float]
    image: float
    spp: int
    target: float
    seconds: float
    share: float

    def spp_for(self, target: float | None = None, tensor: str | None = None) -> int:
        """Return an upper bound of the samples per pixel at which the gradient has no more noise than wanted.

        Parameters
        ----------
        target : float, optional
            Wanted noise; by default `self.target`.
        tensor : str, optional
            Name of one tensor; by default all count.

        Returns
        -------
        int
            `spp` itself where it is enough.

        Raises
        ------
        TypeError, ValueError, KeyError
            The target is not positive, or no tensor has this name.
        """
        wanted = self.target if target is None else check_positive("target", target, least=1e-6, most=1e6)
        if tensor is not None and tensor not in self.noise:
            raise KeyError(f"tensor: expected one of {', '.join(self.noise)}, got {tensor!r}")
        bounds = {name: noise * (1 + self.uncertainty[name]) for name, noise in self.noise.items() if noise >= 0}
        most = max(bounds.values()) if tensor is None else bounds.get(tensor, 0.0)
        if most <= wanted:
            return self.spp
        # Samples of the gradient grow from the usual number on (csrc/estimator/default_samples.h).
        return math.ceil(max(self.spp, core.USUAL_SPP) * (most / wanted) ** 2)

    def __str__(self) -> str:
        rows = [("gradient by", "noise", "±", f"spp for {_percent(self.target)}")]
        for name, noise in self.noise.items():
            if math.isnan(noise):
                rows.append((name, "no gradient", "", ""))
                continue
            more = "≥ " if noise > 1 else ""
            spp = f"{'' if noise <= self.target else '≥ ' if noise > 1 else '≤ '}{self.spp_for(tensor=name):,}"
            rows.append((name, more + _percent(noise), _percent(noise * self.uncertainty[name]), spp))
        rows.append(("image", _percent(self.image), "", ""))
        time = f"{1e3 * self.seconds:.0f} ms a step, of which the gradient takes {100 * self.share:.0f} %"
        return f"{table(rows, '<>>>')}\nat {self.spp} samples per pixel; {time}"

    __repr__ = __str__


def noise(
    scene: Scene | Mesh,
    camera: Camera,
    loss: Callable[[Tensor], Tensor],
    spp: int = 16,
    seed: int | None = None,
    *,
    target: float = 0.05,
    by: Mapping[str, Tensor] | None = None,
    seeds: int = 8,
    **options: Unpack[RenderOptions],
) -> NoiseEstimate:
    """Estimate how noisy the gradient of a loss is, and which `spp` would lower that to a wanted noise.

    Parameters
    ----------
    scene, camera, spp, seed
        As of render(). The seed makes the estimate repeatable.
    loss : callable
        Function of the image that returns a scalar, as in the user's loop.
    target : float, default 0.05
        Wanted noise, relative to the gradient.
    by : mapping of str to Tensor, optional
        Tensors, by any names, that these are computed from: a pose, say. By default all of them that require a gradient.
    seeds : int, default 8
        Gradients that are compared. Two are enough by tensors of many numbers; by few, more make the estimate surer.
    **options
        Other arguments of render(). A seed in `sampling` is ignored, as gradients would share it.

    Returns
    -------
    NoiseEstimate
        It prints as a table; `.noise` has numbers by name, and `.spp_for(target)` an upper bound of the samples per pixel.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong, nothing requires a gradient, or the loss is no differentiable scalar.

    Notes
    -----
    With n gradients of mean m, the variance is σ² = Σ ‖g − m‖² / (n − 1). The mean's own noise adds σ² / n to ‖m‖², which is
    subtracted. Noise falls as 1/√spp or faster; bounds add the standard error of σ. Rare large values, as of smooth surfaces
    that light one another, escape it. In a squared loss the noise of the image counts too; other losses add a bias.

    Examples
    --------
    >>> import edgegrad as eg
    >>> box, camera = eg.shapes.box(), eg.Camera.look_at((2, 2, 4), (0, 0, 0), size=(32, 32))
    >>> moving = box.replace(verts=box.verts.requires_grad_())
    >>> eg.noise(moving, camera, lambda image: image.square().mean(), seed=0).spp_for(0.2)
    16
    """
    check_options("noise", options)
    if not callable(loss):
        raise TypeError(f"loss: expected a function of the image, got {type(loss).__name__}")
    target, seeds = (
        check_positive("target", target, least=1e-6, most=1e6),
        check_positive_int("seeds", seeds, most=1 << 16),
    )
    if seeds < 2:
        raise ValueError(f"seeds: expected at least 2, to compare gradients, got {seeds}")
    as_scene(scene)
    check_camera(camera)
    wanted = _wanted(scene, camera) if by is None else _checked(by)
    first = int(drawn_seed(seed, options.pop("generator", None)))
    options["sampling"] = replace(check_sampling(options.get("sampling")), seed=None)
    found: list[tuple[Tensor, ...]] = []
    images: list[Tensor] = []
    seconds, own = 0.0, first
    for k in range(seeds):
        own = first if k == 0 else derived_seed(first, FIRST_STREAM + k)
        begin = time.perf_counter()
        with torch.enable_grad():
            image = render(scene, camera, spp, own, **options)
            value = _checked_loss(loss(image))
            # The user's own graph, by which tensors depend on others, is needed again.
            grads = torch.autograd.grad(value, list(wanted.values()), retain_graph=True, materialize_grads=True)
        seconds = time.perf_counter() - begin
        for name, grad in zip(wanted, grads, strict=True):
            if not all_finite(grad):
                raise ValueError(
                    f"loss: expected a finite gradient, got one by {name} that is not; look for roots of 0"
                )
        found.append(grads)
        images.append(image.detach())
    begin = time.perf_counter()
    with torch.no_grad():
        render(scene, camera, spp, own, **options)
    alone = time.perf_counter() - begin
    if not any(bool(grad.any()) for grads in found for grad in grads):
        raise ValueError(
            f"loss: expected one that changes with {', '.join(wanted)}, got gradients of zero; does the image show them?"
        )
    estimates = {name: _estimate(values) for name, values in zip(wanted, zip(*found, strict=True), strict=True)}
    return NoiseEstimate(
        noise={name: relative for name, (relative, _) in estimates.items()},
        uncertainty={name: error for name, (_, error) in estimates.items()},
        image=_estimate(images)[0],
        spp=spp,
        target=target,
        seconds=seconds,
        share=max(0.0, 1 - alone / seconds),
    )


def _wanted(scene: Scene | Mesh, camera: Camera) -> dict[str, Tensor]:
    """Return the tensors of scene and camera that require a gradient, each under its first name."""
    wanted: dict[str, Tensor] = {}
    for name, tensor in (*named_tensors(scene), *named_tensors(camera, "camera")):
        if tensor.requires_grad and not any(tensor is other for other in wanted.values()):
            wanted[name] = tensor
    if not wanted:
        raise ValueError(
            "scene: expected a tensor of the scene or of the camera that requires a gradient, got none; "
            "mesh.verts.requires_grad_(), say"
        )
    return wanted


def _checked(by: object) -> dict[str, Tensor]:
    if not isinstance(by, Mapping) or not by:
        got = "an empty one" if isinstance(by, Mapping) else type(by).__name__
        raise TypeError(f'by: expected a mapping of names to tensors, got {got}; {{"pose": pose}}, say')
    for name, tensor in by.items():
        if not isinstance(tensor, Tensor):
            raise TypeError(f"by: expected tensors, got {type(tensor).__name__} for {name!r}")
        if not tensor.requires_grad:
            raise ValueError(f"by: expected tensors that require a gradient, got {name!r}, which does not")
    return {str(name): tensor for name, tensor in by.items()}


def _checked_loss(value: object) -> Tensor:
    if not isinstance(value, Tensor):
        raise TypeError(f"loss: expected a function that returns a scalar tensor, got {type(value).__name__}")
    if value.numel() != 1:
        raise ValueError(f"loss: expected a scalar, got shape {tuple(value.shape)}; take its mean() or sum()")
    if not value.requires_grad:
        raise ValueError(
            "loss: expected a differentiable function of the image, got a value without a graph; leave out detach(), item() "
            "and no_grad()"
        )
    if not all_finite(value.detach()):
        raise ValueError(f"loss: expected a finite number, got {value.item()}")
    return value.reshape(())


def _estimate(values: Sequence[Tensor]) -> tuple[float, float]:
    """Return the noise of one of these, relative to their mean, and the relative standard error of that."""
    all_ = torch.stack([value.detach().double().reshape(-1) for value in values])
    n, mean = len(all_), all_.mean(0)
    squares = (all_ - mean).square().sum(0) / (n - 1)
    variance, size = float(squares.sum()), float(mean.square().sum())
    if variance == 0:
        return (0.0 if size > 0 else math.nan), 0.0
    relative = math.sqrt(variance / max(size - variance / n, LEAST_SIGNAL * size))
    # Of n values of a normal distribution, the mean of the squared variance is (n + 1) / (n − 1) times its square.
    independent = variance**2 / float(squares.square().sum()) * (n + 1) / (n - 1)
    return relative, 1 / math.sqrt(2 * (n - 1) * min(independent, all_.shape[1]))


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 0.995 else f"{100 * share:.0f} %"
