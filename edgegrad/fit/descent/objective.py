"""The loss between renders and pictures, at a step and at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...scene.scene import Scene
from ..losses import loss_of
from ..measured import comparable, measured_loss
from ..options import Options
from ..placement import Coordinates
from ..verdict import explained
from ..views import View, grouped
from .building import Built, built
from .loop import Descent
from .result import Fit

FINAL_SPP = 64  # samples a pixel of the renders that are judged


class Objective:
    """The loss of some of the views at a step, with samples of its own, as a function of tensors."""

    def __init__(
        self, build: Callable[[Mapping[str, Tensor]], Built], views: list[View], options: Options,
        regularizer: Callable[[Scene], Tensor] | None = None,
    ) -> None:  # fmt: skip
        self.build, self.views, self.options, self.regularizer = build, views, options, regularizer
        self.losses = {"image": loss_of("loss", options.loss), "alpha": loss_of("mask_loss", options.mask_loss)}

    def __call__(self, tensors: Mapping[str, Tensor], step: int) -> Tensor:
        scene, cameras = self.build(tensors)
        picks = self.picks(step)
        total = torch.zeros((), dtype=torch.float64)
        for group, renders in self.renders(scene, cameras, picks, self.options.spp, self.seed(step)):
            first = self.views[group[0]]
            for name in first.wanted:
                total = total + self.of_group(name, group, renders[name]) / len(picks)
            for name in first.measured:
                total = total + self.of_measured(name, group, renders) / len(picks)
        return total if self.regularizer is None else total + self.regularizer(scene)

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
    with torch.no_grad():
        for i, view in enumerate(views):
            renders = [next(objective.renders(scene, cameras, [i], spp, (options.seed + k) % 2**32))[1] for k in (1, 2)]
            for name, target in view.wanted.items():
                first, second = (found[name][0] for found in renders)
                loss += float(objective.of_group(name, [i], 0.5 * (first + second)[None])) / len(views)
                pairs.append((first, second, target, view.weight))
            for name, given in view.measured.items():
                means = {key: 0.5 * (renders[0][key] + renders[1][key]) for key in (name, "alpha")}
                loss += float(objective.of_measured(name, [i], means)) / len(views)
                target, weight = comparable(means[name][0], means["alpha"][0], given)
                pairs.append((renders[0][name][0], renders[1][name][0], target, weight))
    history = [coordinates.recorded(record) for record in descent.history]
    return Fit(
        values=coordinates.plain(descent.values), poses=coordinates.poses(descent.values), scene=scene, cameras=cameras,
        views=views, loss=loss, explained=explained(pairs), ending=descent.ending, history=history, seconds=descent.seconds,
        start=start,
    )  # fmt: skip
