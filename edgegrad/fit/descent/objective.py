"""The loss between renders and pictures, at a step and at the end."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...scene.scene import Scene
from ..losses import REGION, loss_of
from ..measured import comparable, measured_loss
from ..options import Options
from ..placement import Coordinates
from ..verdict import explained
from ..views import View, grouped
from .building import Built, built
from .loop import Descent
from .regions import EVERY, LAST, Regions
from .result import Fit

FINAL_SPP = 64  # samples a pixel of the renders that are judged


class Objective:
    """The loss of some of the views at a step, with samples of its own, as a function of tensors."""

    def __init__(
        self, build: Callable[[Mapping[str, Tensor]], Built], views: list[View], options: Options,
        regularizer: Callable[[Scene], Tensor] | None = None, prior: Callable[[Mapping[str, Tensor]], Tensor] | None = None,
        many: Callable[[Mapping[str, Tensor]], Sequence[Built]] | None = None,
    ) -> None:  # fmt: skip
        """`regularizer` of the scene and `prior` of the tensors are added to the loss. `many` is `build` for a batch of values,
        where that is faster."""
        self.many = many
        self.build, self.views, self.options, self.regularizer, self.prior = build, views, options, regularizer, prior
        self.losses = {"alpha": loss_of("mask_loss", options.mask_loss)}
        self.regions = Regions(views, options.seed) if options.loss == REGION else None
        if options.loss != REGION:
            self.losses["image"] = loss_of("loss", options.loss)

    def __call__(self, tensors: Mapping[str, Tensor], step: int) -> Tensor:
        scene, cameras = self.build(tensors)
        total = self.of_pictures(scene, cameras, step)
        total = total if self.regularizer is None else total + self.regularizer(scene)
        return total if self.prior is None else total + self.prior(tensors)

    def of_pictures(self, scene: Scene, cameras: list[Camera], step: int) -> Tensor:
        """The loss without what is added."""
        picks = self.picks(step)
        total = torch.zeros((), dtype=torch.float64)
        for group, renders in self.renders(scene, cameras, picks, self.options.spp, self.seed(step)):
            first = self.views[group[0]]
            if self.regions is not None:
                total = total + self.regions.loss(group, renders["alpha"]) / len(picks)
            for name in first.wanted:
                total = total + self.of_group(name, group, renders[name]) / len(picks)
            for name in first.measured:
                total = total + self.of_measured(name, group, renders) / len(picks)
        return total

    def left(self, tensors: Mapping[str, Tensor]) -> float:
        """The loss of pictures and masks, in units of what it is by the noise of the render's samples alone."""
        (scene, cameras), every = self.build(tensors), list(range(len(self.views)))
        loss = noise = 0.0
        pairs = zip(*(self.renders(scene, cameras, every, self.options.spp, self.seed(k)) for k in (0, 1)), strict=True)
        for (group, first), (_, second) in pairs:
            for name in self.views[group[0]].wanted:
                weights = [self.views[i].weights[name] for i in group]
                weight = None if weights[0] is None else _stacked(weights)
                noise += 0.5 * len(group) * float(self.losses[name](first[name], second[name], weight))
                loss += 0.5 * sum(float(self.of_group(name, group, one[name])) for one in (first, second))
        return loss / max(noise, 1e-30)

    def of(self, whole: Callable[[Mapping[str, Tensor]], Mapping[str, Tensor]]) -> Objective:
        """As a function of fewer tensors, of which `whole` makes all."""
        build, prior, many = self.build, self.prior, self.many
        found = copy.copy(self)
        found.build = lambda tensors: build(whole(tensors))
        found.prior = None if prior is None else lambda tensors: prior(whole(tensors))
        found.many = None if many is None else lambda tensors: many(whole(tensors))
        return found

    def renews(self, step: int) -> bool:
        """Whether a step begins with renew()."""
        return self.regions is not None and step % EVERY == 0

    def narrows(self) -> bool:
        """Whether the loss is one of a blur that later steps do not have."""
        return self.regions is not None and self.regions.narrows

    def renew(self, tensors: Mapping[str, Tensor], step: int) -> None:
        """What the loss holds fixed between steps is what it is at these values."""
        if self.regions is None:
            return
        for i, alpha in enumerate(self._alphas(tensors, self.options.spp, self.seed(step))):
            self.regions.renew(i, alpha, step)

    def check(self, tensors: Mapping[str, Tensor]) -> None:
        """The start, and that the loss depends on all that is sought. Raises ValueError."""
        if self.regions is None:
            return
        self.regions.check(self._alphas(tensors, self.options.spp, self.seed(0)))
        self.renew(tensors, 0)
        leaves = {name: value.detach().clone().requires_grad_() for name, value in tensors.items()}
        loss = self(leaves, 0)
        inputs = list(leaves.values())
        found = torch.autograd.grad(loss, inputs, allow_unused=True) if loss.requires_grad else [None] * len(inputs)
        for name, gradient in zip(leaves, found, strict=True):
            if gradient is None:
                raise ValueError(
                    f'parameters: expected what moves the outline of the scene, as loss="region" needs, got {name!r}, on which '
                    "alpha does not depend; fit it afterwards, with another loss"
                )

    def _alphas(self, tensors: Mapping[str, Tensor], spp: int, seed: int) -> list[Tensor]:
        """(H, W, 1) of each view."""
        scene, cameras = built(self.build, dict(tensors))
        found: dict[int, Tensor] = {}
        with torch.no_grad():
            for group, renders in self.renders(scene, cameras, [*range(len(self.views))], spp, seed):
                found |= dict(zip(group, renders["alpha"], strict=True))
        return [found[i] for i in range(len(self.views))]

    def of_group(self, name: str, group: Sequence[int], render: Tensor) -> Tensor:
        """Σ of the loss of these views, whose channel `name` is `render` (B, H, W, c)."""
        target = _stacked([self.views[i].wanted[name] for i in group])
        weights = [self.views[i].weights[name] for i in group]
        weight = None if weights[0] is None else _stacked(weights)
        return len(group) * self.losses[name](render, target, weight).double()

    def of_measured(self, name: str, group: Sequence[int], renders: Mapping[str, Tensor]) -> Tensor:
        """Σ of the loss of what was measured of these views, whose channels are `renders` (B, H, W, c)."""
        given = [self.views[i].measured[name] for i in group]
        covers = self.views[group[0]].mask is None
        return len(group) * measured_loss(renders[name], renders["alpha"], given, covers).double()

    def seed(self, step: int) -> int:
        return (self.options.seed + 7919 * step) % 2**32

    def picks(self, step: int) -> list[int]:
        """The views of a step: all, or so many by turns in an order that is drawn anew for each round."""
        n, count = self.options.views_per_step, len(self.views)
        if n is None or n >= count:
            return list(range(count))
        picks = []
        for k in range(step * n, (step + 1) * n):
            order = torch.randperm(count, generator=torch.Generator().manual_seed(self.options.seed + k // count))
            picks.append(int(order[k % count]))
        return sorted(set(picks))

    def groups(self, picks: list[int]) -> list[list[int]]:
        """Places of views that can be rendered as one batch."""
        return [[picks[k] for k in group] for group in grouped([self.views[i] for i in picks])]

    def renders(
        self, scene: Scene, cameras: list[Camera], picks: list[int], spp: int, seed: int
    ) -> Iterator[tuple[list[int], dict[str, Tensor]]]:
        """Places of views of one kind, and their channels (B, H, W, c)."""
        for group in self.groups(picks):
            batch, aovs = Camera.stack([cameras[i] for i in group]), self.views[group[0]].aovs
            yield group, render_aovs(scene, batch, aovs, spp=spp, seed=seed, **self.options.render)


def _stacked(tensors: Sequence[Tensor | None]) -> Tensor:
    return torch.stack([tensor for tensor in tensors if tensor is not None])


def judged(objective: Objective, descent: Descent, start: Scene, coordinates: Coordinates) -> Fit:
    """The result: the loss of the best values over all views with many samples, and how much of the pictures they explain."""
    views, options = objective.views, objective.options
    scene, cameras = built(objective.build, descent.values)
    loss, pairs = 0.0, []
    spp = max(options.spp, FINAL_SPP)
    objective.renew(descent.values, LAST)
    alphas: list[Tensor] = []
    with torch.no_grad():
        for i, view in enumerate(views):
            renders = [next(objective.renders(scene, cameras, [i], spp, (options.seed + k) % 2**32))[1] for k in (1, 2)]
            if objective.regions is not None:
                alphas.append(0.5 * (renders[0]["alpha"][0] + renders[1]["alpha"][0]))
                loss += float(objective.regions.loss([i], alphas[-1][None])) / len(views)
            for name, target in view.wanted.items():
                first, second = (found[name][0] for found in renders)
                loss += float(objective.of_group(name, [i], 0.5 * (first + second)[None])) / len(views)
                pairs.append((first, second, target, view.weight))
            for name, given in view.measured.items():
                means = {key: 0.5 * (renders[0][key] + renders[1][key]) for key in (name, "alpha")}
                loss += float(objective.of_measured(name, [i], means)) / len(views)
                target, weight = comparable(means[name][0], means["alpha"][0], given)
                pairs.append((renders[0][name][0], renders[1][name][0], target, weight))
    share = explained(pairs) if objective.regions is None else objective.regions.explained(alphas)
    history = [coordinates.recorded(record) for record in descent.history]
    return Fit(
        values=coordinates.plain(descent.values), poses=coordinates.poses(descent.values), scene=scene, cameras=cameras,
        views=views, loss=loss, explained=share, ending=descent.ending, history=history, seconds=descent.seconds,
        start=start,
    )  # fmt: skip
