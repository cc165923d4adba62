"""The loss between renders and pictures at a step of a descent."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...optim.tensors import Objective as TensorObjective
from ...scene.scene import Scene
from ...scene.tree import tensors_in
from ..losses import REGION, loss_of
from ..measured import measured_loss
from ..options import Settings
from ..views import Observation, batch_groups
from .region_loss import RegionLoss
from .scene_builder import Built, build_detached
from .settings import DESCENT

Tensors = Mapping[str, Tensor]


class Objective(TensorObjective):
    """The loss of some of the views at a step, with samples of its own, as a function of tensors."""

    def __init__(
        self, build: Callable[[Tensors], Built], views: list[Observation], options: Settings,
        regularizer: Callable[[Scene], Tensor] | None = None, prior: Callable[[Tensors], Tensor] | None = None,
        build_batch: Callable[[Tensors], Sequence[Built]] | None = None, builder: str = "scene",
    ) -> None:  # fmt: skip
        """`regularizer` of the scene and `prior` of the tensors are added to the loss. `build_batch` is `build` for a batch of
        values, where that is faster. `builder` is the user's argument that makes the scene."""
        self.build, self.views, self.options, self.regularizer, self.prior = build, views, options, regularizer, prior
        self.build_batch, self.builder = build_batch, builder
        self.losses = {"alpha": loss_of("options.mask_loss", options.mask_loss)}
        self.regions = RegionLoss(views, options.seed) if options.loss == REGION else None
        self.renewal_steps = None if self.regions is None else self.regions.settings.renewal_steps
        # Some views say less of a step than all.
        self.sample_sets = 2 if options.views_per_step is None else DESCENT.sets_of_views
        if options.loss != REGION:
            self.losses["image"] = loss_of("options.loss", options.loss)

    def __call__(self, tensors: Tensors, step: int) -> Tensor:
        scene, cameras = self.build(tensors)
        self._check_graph(tensors, (scene, cameras))
        picks = self.picks(step)
        total = torch.zeros((), dtype=torch.float64)
        for group, renders in self.renders(scene, cameras, picks, self.options.spp, self.seed(step)):
            total = total + self.views_loss(group, renders) / len(picks)
        total = total if self.regularizer is None else total + self.regularizer(scene)
        return total if self.prior is None else total + self.prior(tensors)

    def views_loss(self, group: Sequence[int], renders: Tensors) -> Tensor:
        """Return the sum of these views' losses in all channels, rendered as (B, H, W, c)."""
        first, total = self.views[group[0]], torch.zeros((), dtype=torch.float64)
        if self.regions is not None:
            total = total + self.regions.loss(group, renders["alpha"])
        for name in first.wanted:
            total = total + self.group_loss(name, group, renders[name])
        for name in first.measured:
            given = [self.views[i].measured[name] for i in group]
            loss = measured_loss(renders[name], renders["alpha"], given, first.mask is None)
            total = total + len(group) * loss.double()
        return total

    def _check_graph(self, tensors: Tensors, built: Built) -> None:
        """Check that the scene or its cameras have a gradient where the tensors have one. Raises ValueError."""
        sought = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors.values())
        if sought and not any(tensor.requires_grad for tensor in tensors_in(built)):
            raise ValueError(
                f"{self.builder}: expected a function whose scene depends on the parameters {', '.join(tensors)}, got one that "
                "depends on none; compute it with torch from what it is given, without detach(), item(), NumPy or no_grad()"
            )

    def residual(self, tensors: Tensors) -> float:
        """Return the loss of pictures and masks over the part of it that the noise of the render's samples makes."""
        (scene, cameras), every = self.build(tensors), list(range(len(self.views)))
        loss = noise = 0.0
        pairs = zip(*(self.renders(scene, cameras, every, self.options.spp, self.seed(k)) for k in (0, 1)), strict=True)
        for (group, first), (_, second) in pairs:
            for name in self.views[group[0]].wanted:
                weight = self._weight(name, group)
                noise += 0.5 * len(group) * float(self.losses[name](first[name], second[name], weight))
                loss += 0.5 * sum(float(self.group_loss(name, group, one[name])) for one in (first, second))
        return loss / max(noise, 1e-30)

    def with_options(self, options: Settings) -> Objective:
        """Return the same loss with other options of its descents."""
        found = copy.copy(self)
        found.options = options
        return found

    def reparametrized(self, whole: Callable[[Tensors], Tensors]) -> Objective:
        """Return the same loss as a function of fewer tensors, from which `whole` makes all."""
        build, prior, build_batch = self.build, self.prior, self.build_batch
        found = copy.copy(self)
        found.build = lambda tensors: build(whole(tensors))
        found.prior = None if prior is None else lambda tensors: prior(whole(tensors))
        found.build_batch = None if build_batch is None else lambda tensors: build_batch(whole(tensors))
        return found

    def renew(self, tensors: Tensors, step: int) -> None:
        """Compute what the loss holds fixed between steps at these values."""
        if self.regions is None:
            return
        for i, shown in enumerate(self.images(tensors, self.options.spp, step)):
            self.regions.renew(i, shown["alpha"], step)
        self.provisional = self.regions.narrows

    def check(self, tensors: Tensors) -> None:
        """Check the start, and that the loss depends on all tensors. Raises ValueError."""
        if self.regions is None:
            return
        self.regions.check([shown["alpha"] for shown in self.images(tensors, self.options.spp, 0)])
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

    def group_loss(self, name: str, group: Sequence[int], render: Tensor) -> Tensor:
        """Return the sum of these views' losses in the channel `name`, rendered as (B, H, W, c)."""
        target = torch.stack([self.views[i].wanted[name] for i in group])
        if render.shape[-1] != target.shape[-1]:
            raise ValueError(
                f"images: expected {render.shape[-1]} channels like the scene's colours, got {target.shape[-1]}; read them with "
                f"read_image(path, channels={render.shape[-1]}), and give their alpha as masks"
            )
        return len(group) * self.losses[name](render, target, self._weight(name, group)).double()

    def _weight(self, name: str, group: Sequence[int]) -> Tensor | None:
        weights = [weight for i in group if (weight := self.views[i].weights[name]) is not None]
        return torch.stack(weights) if weights else None

    def seed(self, step: int) -> int:
        return (self.options.seed + 7919 * step) % 2**32

    def picks(self, step: int) -> list[int]:
        """Return the indices of a step's views: all, or the next few in an order that is drawn anew for each round."""
        n, count = self.options.views_per_step, len(self.views)
        if n is None or n >= count:
            return list(range(count))
        picks = []
        for k in range(step * n, (step + 1) * n):
            order = torch.randperm(count, generator=torch.Generator().manual_seed(self.options.seed + k // count))
            picks.append(int(order[k % count]))
        return sorted(set(picks))

    def groups(self, picks: list[int]) -> list[list[int]]:
        """Return indices of views that can be rendered as one batch."""
        return [[picks[k] for k in group] for group in batch_groups([self.views[i] for i in picks])]

    def renders(
        self, scene: Scene, cameras: list[Camera], picks: list[int], spp: int, seed: int
    ) -> Iterator[tuple[list[int], dict[str, Tensor]]]:
        """Yield the indices of each batch of views and its channels (B, H, W, c)."""
        for group in self.groups(picks):
            batch, aovs = Camera.stack([cameras[i] for i in group]), self.views[group[0]].aovs
            yield group, render_aovs(scene, batch, aovs, spp=spp, seed=seed, **self.options.render)

    def images(self, tensors: Tensors, spp: int, step: int) -> list[dict[str, Tensor]]:
        """Return the channels (H, W, c) of each view by name, without gradients."""
        scene, cameras = build_detached(self.build, dict(tensors))
        found: list[dict[str, Tensor]] = [{} for _ in self.views]
        with torch.no_grad():
            for group, renders in self.renders(scene, cameras, [*range(len(self.views))], spp, self.seed(step)):
                for name, images in renders.items():
                    for i, image in zip(group, images, strict=True):
                        found[i][name] = image
        return found
