"""The curvature JᵀWJ of a loss of images by some hundred numbers, in forward mode.

J is the derivative of the images by the numbers, one direction each. W is what the loss makes of differences r: the gradient of
a loss ρ(r) is that of ½ w r² with w = ρ′(r)/r held fixed (iteratively reweighted least squares, Holland and Welsch 1977). For a
squared loss it is exact (Gauss-Newton).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad

from ...camera.camera import Camera
from ...optim.tensors import flat, named
from ...render import jvp
from ...scene.tree import map_tensors, tensors_in
from .objective import Objective
from .scene_builder import Built
from .settings import DESCENT

MAX_NUMBERS = 400  # each is a direction of differentiation


def curvature(objective: Objective, tensors: Mapping[str, Tensor], step: int) -> Tensor:
    """Return JᵀWJ (n, n) float64 by all numbers of the tensors, one after the other. Raises TypeError where something has no
    forward mode."""
    total = torch.zeros(2 * (len(flat(tensors)),), dtype=torch.float64)
    for rows, weight, _ in _weighted(objective, tensors, step):
        rows = rows * weight.sqrt()
        total += (rows @ rows.T).double()
    if (regularizer := objective.regularizer) is not None:
        total += _of_term(lambda tensors: regularizer(objective.build(tensors)[0]), tensors)
    if objective.prior is not None:
        total += _of_term(objective.prior, tensors)
    return total


def scores(objective: Objective, tensors: Mapping[str, Tensor], step: int) -> tuple[Tensor, Tensor]:
    """Return the curvature (n, n) of the pictures alone, and Σ s sᵀ (n, n) over the scores s = w r J of all pixels."""
    H, S = (torch.zeros(2 * (len(flat(tensors)),), dtype=torch.float64) for _ in range(2))
    for rows, weight, score in _weighted(objective, tensors, step):
        H += ((rows * weight) @ rows.T).double()
        S += ((rows * score) @ (rows * score).T).double()
    return H, S


def _weighted(
    objective: Objective, tensors: Mapping[str, Tensor], step: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:  # fmt: skip
    """Yield for each view and channel the derivatives J (n, P), the weights w (P,), and the factors w r (P,) of the scores."""
    count = len(objective.picks(step))
    for name, group, render, slopes in derivatives(objective, tensors, step):
        regions = objective.regions
        if regions is None:
            weight = weights_of(objective, name, group, render)
            score = (render - torch.stack([objective.views[i].wanted[name] for i in group])) * weight
        else:
            weight = regions.curvature(group, render)
            slopes = tuple(regions.blurred(J) for J in slopes)
            # The mean of a log likelihood's squared score is its curvature.
            score = (weight * regions.shares(group)).sqrt()
        for w, s, J in zip(weight / count, score / count, slopes, strict=True):
            yield J.flatten(1), w.flatten(), s.flatten()


def misfit(objective: Objective, tensors: Mapping[str, Tensor], step: int) -> dict[str, Tensor]:
    """Return Σ |J| |r| / Σ |J| for each number, in the tensors' shapes: how far pixels are from their pictures where it moves
    them. It is large for what lies in a wrong place, also where the slope of the loss is zero."""
    off, moved = (torch.full_like(flat(tensors), 1e-30) for _ in range(2))
    for name, group, render, slopes in derivatives(objective, tensors, step):
        for i, image, J in zip(group, render, slopes, strict=True):
            if (wanted := objective.views[i].wanted.get(name)) is not None:
                rows = J.abs().flatten(1)
                off += (rows @ (image - wanted).abs().flatten()).double()
                moved += rows.sum(1).double()
    return named(off / moved, tensors, torch.float64)


def derivatives(
    objective: Objective, tensors: Mapping[str, Tensor], step: int
) -> Iterator[tuple[str, list[int], Tensor, tuple[Tensor, ...]]]:
    """Yield for each batch of views and channel its name, the views' indices, the channel (B, H, W, c), and its derivatives (n,
    H, W, c) by all numbers, one tensor a view. Raises TypeError where something has no forward mode."""
    options = objective.options
    try:
        (scene, cameras), tangents = _tangents(objective, {name: value.detach() for name, value in tensors.items()})
        groups = objective.groups(objective.picks(step))
        for some in (some for group in groups for some in _together(cameras, group, tangents)):
            whole = cameras[some[0]] if len(some) == 1 else Camera.stack([cameras[i] for i in some])
            held = {id(tensor) for tensor in (*tensors_in(scene), *tensors_in(whole))}
            own = {tensor: tangent for tensor, tangent in tangents if id(tensor) in held}
            if not own:
                continue
            seed, aovs = (objective.seed(step) + some[0]) % 2**32, objective.views[some[0]].aovs
            images, slopes = jvp(scene, whole, own, options.spp, seed, aovs=aovs, **options.render)
            for name in aovs:
                image, J = (x if len(some) > 1 else x.unsqueeze(-4) for x in (images[name], slopes[name]))
                yield name, some, image, J.unbind(1)
    except (NotImplementedError, RuntimeError) as error:
        if "forward" not in str(error):
            raise
        raise TypeError(
            "method: expected a scene and cameras that PyTorch differentiates in forward mode by what is sought, as "
            f'"gauss-newton" needs, got {error}; give method="adam"'
        ) from error


def _together(
    cameras: Sequence[Camera], group: Sequence[int], tangents: Sequence[tuple[Tensor, Tensor]]
) -> list[list[int]]:
    """Return the indices of views whose derivatives are taken in one call, which is cheaper where pictures are small. A camera
    that moves is alone."""
    moved = {id(tensor) for tensor, _ in tangents}
    if any(id(tensor) in moved for i in group for tensor in tensors_in(cameras[i])):
        return [[i] for i in group]
    height, width = cameras[group[0]].size
    count = max(1, DESCENT.max_derivatives // (len(tangents[0][1]) * height * width)) if tangents else len(group)
    return [list(group[k : k + count]) for k in range(0, len(group), count)]


def _tangents(objective: Objective, tensors: Mapping[str, Tensor]) -> tuple[Built, list[tuple[Tensor, Tensor]]]:
    """Return scene and cameras, and each of their tensors that depends on the numbers with its derivatives (n, *shape)."""
    rows: list[list[Tensor | None]] = []
    for moved in _moved(tensors, DESCENT.batch if objective.build_batch is not None else 1):
        with forward_ad.dual_level():
            duals = {name: forward_ad.make_dual(value, unit) for name, (value, unit) in moved.items()}
            if objective.build_batch is None:
                found = [objective.build({name: dual[0] for name, dual in duals.items()})]
            else:
                found = objective.build_batch(duals)
            rows += [[forward_ad.unpack_dual(tensor).tangent for tensor in _floating(one)] for one in found]
    with torch.no_grad():
        scene, cameras = objective.build(tensors)
        scene, cameras = map_tensors(scene, torch.Tensor.detach), [map_tensors(c, torch.Tensor.detach) for c in cameras]
    columns = []
    for tensor, column in zip(_floating((scene, cameras)), zip(*rows, strict=True), strict=True):
        if any(tangent is not None for tangent in column):
            zero = torch.zeros_like(tensor)
            columns.append((tensor, torch.stack([zero if tangent is None else tangent.detach() for tangent in column])))
    return (scene, cameras), columns


def _moved(tensors: Mapping[str, Tensor], count: int) -> Iterator[dict[str, tuple[Tensor, Tensor]]]:
    """Yield copies of the values (count, *shape) and their derivatives by the next `count` numbers. A dual number is made in
    place of what it is made of."""
    units = torch.eye(sum(value.numel() for value in tensors.values()), dtype=torch.float64)
    for chunk in units.split(count):
        parts = chunk.split([value.numel() for value in tensors.values()], 1)
        yield {
            name: (value.expand(len(chunk), *value.shape).clone(), part.reshape(-1, *value.shape).to(value))
            for (name, value), part in zip(tensors.items(), parts, strict=True)
        }


def _floating(thing: Any) -> list[Tensor]:
    return [tensor for tensor in tensors_in(thing) if tensor.is_floating_point()]


def weights_of(objective: Objective, name: str, group: list[int], render: Tensor) -> Tensor:
    """Return the weights w (B, H, W, c) that the sum of these views' losses gives a channel's pixels."""
    target = torch.stack([objective.views[i].wanted[name] for i in group])
    return _weights(lambda image: objective.group_loss(name, group, image), render.detach(), target)


def _weights(loss: Callable[[Tensor], Tensor], render: Tensor, target: Tensor) -> Tensor:
    least = DESCENT.min_residual * float((target.amax() - target.amin()).clamp(min=1e-12))
    r = render - target
    r = torch.where(r.abs() < least, torch.where(r < 0, -least, least), r)
    with torch.enable_grad():
        image = (target + r).requires_grad_()
        (slope,) = torch.autograd.grad(loss(image), image)
    return (slope / r).clamp(min=0.0)


def check_pointwise(objective: Objective) -> None:
    """Check that no pixel's weight changes with differences at other pixels. Raises ValueError."""
    if objective.regions is not None:
        return
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(1, 16, 16, 3, generator=generator, dtype=torch.float32)
    r = 0.2 * (0.1 + torch.rand(target.shape, generator=generator, dtype=torch.float32))
    some = (torch.rand(16, 16, generator=generator) < 0.5)[..., None].expand_as(target)
    for option, name in (("loss", "image"), ("mask_loss", "alpha")):
        if not any(name in view.aovs for view in objective.views):
            continue
        by = objective.losses[name]
        whole, part = (
            _weights(lambda image, by=by: by(image, target, None), target + x, target)
            for x in (r, torch.where(some, r, 0.5 * r))
        )
        if bool(((whole - part).abs() > 1e-3 * whole.abs().max())[some].any()):
            raise ValueError(
                f'{option}: expected a loss of each pixel by itself for method="gauss-newton", as l1, l2, huber and robust are, '
                'got one that mixes pixels; choose one of these, or method="adam"'
            )


def _of_term(term: Callable[[dict[str, Tensor]], Tensor], tensors: Mapping[str, Tensor]) -> Tensor:
    """Return the second derivative of a number by the tensors, with negative eigenvalues set to zero."""
    with torch.enable_grad():
        H = torch.autograd.functional.hessian(lambda numbers: term(named(numbers, tensors)).double(), flat(tensors))
    size, axes = torch.linalg.eigh(0.5 * (H + H.T))
    return axes @ torch.diag(size.clamp(min=0.0)) @ axes.T
