"""Joints that move one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..check import as_double, as_tensor, check_finite
from .rotations import as_matrices


@dataclass(frozen=True, eq=False)
class Joints:
    """A hierarchy of joints at rest.

    A joint takes points of its own to its parent's by x → R S x + t. Kept in float64. Raises TypeError or ValueError.

    Parameters
    ----------
    names : sequence of str, each once
    parents : sequence of int
        Place of each one's parent among them, −1 of none.
    translations : (J, 3)
        Within the parent, world units.
    rotations : (J, 3), (J, 4) or (J, 3, 3)
        Within the parent, as posed() takes them.
    stretches : (J, 3, 3), or (J, 3) scales along the axes, default the identity
        Applied before the rotation.
    """

    names: Sequence[str]
    parents: Sequence[int]
    translations: Tensor
    rotations: Tensor
    stretches: Tensor | None = None
    _order: list[Tensor] = field(init=False, repr=False)  # joints of one depth, by depth
    _above: list[Tensor] = field(init=False, repr=False)  # the place of each one's parent among those of its depth
    _back: Tensor = field(init=False, repr=False)  # places in the concatenation of these

    def __post_init__(self) -> None:
        names, parents = tuple(self.names), tuple(int(parent) for parent in self.parents)
        J = len(names)
        if J == 0 or len(set(names)) < J:
            raise ValueError(f"names: expected each joint once, got {list(names)}; give them different names")
        if len(parents) != J or any(not -1 <= parent < J for parent in parents):
            raise ValueError(f"parents: expected {J} numbers from −1 to {J - 1}, got {list(parents)}")
        translations = as_double("translations", self.translations, (J, 3))
        rotations = as_matrices("rotations", as_tensor("rotations", self.rotations, floating=True).detach().double(), J)
        given = torch.ones(J, 3) if self.stretches is None else self.stretches
        stretches = as_double("stretches", given, (J, 3), (J, 3, 3))
        stretches = torch.diag_embed(stretches) if stretches.dim() == 2 else stretches
        check_finite("rotations", rotations)
        order = _by_depth(names, parents)
        values = {
            "names": names, "parents": parents, "translations": translations, "rotations": rotations, "stretches": stretches,
            "_order": order, "_above": _above(order, parents), "_back": torch.argsort(torch.cat(order)),
        }  # fmt: skip
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.names)

    def world(
        self, rotations: Tensor | None = None, translations: Tensor | None = None, scales: Tensor | None = None
    ) -> Tensor:
        """Return the matrices (…, J, 4, 4) from each joint's own coordinates to the world, differentiable.

        Parameters
        ----------
        rotations : (…, J, 3, 3)
            Of each about its own axes, from rest.
        translations, scales : (…, J, 3)
            Within the parents, and along the axes, in place of those at rest.
        """
        assert isinstance(self.stretches, Tensor)
        stretches = self.stretches
        if scales is not None:
            stretches = stretches + torch.diag_embed(scales - stretches.diagonal(dim1=-2, dim2=-1))
        R = self.rotations if rotations is None else self.rotations @ rotations
        t = self.translations if translations is None else translations
        linear = R @ stretches
        batch = torch.broadcast_shapes(linear.shape[:-3], t.shape[:-2])
        top = torch.cat([linear.expand(*batch, -1, 3, 3), t[..., None].expand(*batch, -1, 3, 1)], -1)
        last = top.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*top.shape[:-2], 1, 4)
        local = torch.cat([top, last], -2)
        found, above = [], None
        for level, places in zip(self._order, self._above, strict=True):
            own = local.index_select(-3, level)
            if above is not None:
                own = above.index_select(-3, places) @ own
            found.append(own)
            above = own
        return torch.cat(found, -3).index_select(-3, self._back)


def _by_depth(names: tuple[str, ...], parents: tuple[int, ...]) -> list[Tensor]:
    """Return the joints of each depth. Raises ValueError where they form a cycle."""
    depth = [-1] * len(parents)
    for k in range(len(parents)):
        way, at = [], k
        while at >= 0 and depth[at] < 0:
            if at in way:
                circle = " → ".join(names[j] for j in [*way[way.index(at) :], at])
                raise ValueError(
                    f"parents: expected a hierarchy, got a cycle: {circle}; give one of them another parent"
                )
            way.append(at)
            at = parents[at]
        first = -1 if at < 0 else depth[at]
        for steps, j in enumerate(reversed(way)):
            depth[j] = first + 1 + steps
    return [torch.tensor([j for j, own in enumerate(depth) if own == d]) for d in range(max(depth) + 1)]


def _above(order: list[Tensor], parents: tuple[int, ...]) -> list[Tensor]:
    places = torch.zeros(len(parents), dtype=torch.long)
    for level in order:
        places[level] = torch.arange(len(level))
    return [places[torch.tensor(parents)[level]] for level in order]
