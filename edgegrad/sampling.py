"""How an image and its gradient are sampled: what only experts set, and seeds as torch draws them."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .check import as_int, check_positive, check_positive_int

LEAST_SPACING = 1 / 64  # px, of Sampling.discontinuity_spacing
MOST_SPACING = 64  # px


@dataclass(frozen=True)
class Sampling:
    """Sample counts of the gradient and of lights, for those who know better than the defaults.

    Parameters
    ----------
    surface : int, optional
        Samples of the gradient inside faces, in all, for each camera. By default they grow with `spp` and with the area of
        the faces in view; `plan()` says how many they are.
    edges : int, optional
        Samples of the gradient on silhouettes, borders, creases and intersections, in all, for each camera, and as many on
        the shadow boundaries of each light. By default they grow with `spp` and with the length of the curves in view.
    lights : int, default 1
        Points drawn of each light that has an extent, for each point that is shaded.
    discontinuity_spacing : float, default 1.0
        Pixels between the lines along which discontinuities within faces are looked for: those that a shader declares, alpha
        edges, and borders of nearest texels. Closer lines cost more and err less.
    creases : "auto" or bool, default "auto"
        At which edges between two visible faces a shader may jump: "auto", where an attribute jumps that it asked for; True,
        at all; False, at none.
    seed : int, optional
        Seed of the gradient's samples. By default it is derived from the seed of the image.

    Raises
    ------
    TypeError, ValueError
        An argument has another type, or lies out of range.
    """

    surface: int | None = None
    edges: int | None = None
    lights: int = 1
    discontinuity_spacing: float = 1.0
    creases: bool | str = "auto"
    seed: int | None = None

    def __post_init__(self) -> None:
        for name in ("surface", "edges"):
            if getattr(self, name) is not None:
                check_positive_int(f"sampling.{name}", getattr(self, name), most=1 << 40)
        check_positive_int("sampling.lights", self.lights, most=1 << 16)
        check_positive(
            "sampling.discontinuity_spacing", self.discontinuity_spacing, least=LEAST_SPACING, most=MOST_SPACING
        )
        if self.creases not in (True, False, "auto"):
            raise ValueError(f'sampling.creases: expected "auto", True or False, got {self.creases!r}')
        if self.seed is not None:
            check_seed("sampling.seed", self.seed)


def check_seed(name: str, seed: object) -> int:
    """Return the seed as an int. Raises TypeError or ValueError."""
    number = as_int(name, seed)
    if not 0 <= number < 2**63:
        raise ValueError(f"{name}: expected an int from 0 to 2⁶³ − 1, got {number}")
    return number


def drawn_seed(
    seed: int | Tensor | None = None, generator: torch.Generator | None = None, below: int = 2**63 - 1
) -> int:
    """Return `seed`, or one that torch's generator draws where it is None, as torch.randint would.

    Raises TypeError or ValueError for a seed that is none, or for one together with a generator.
    """
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(f"generator: expected a torch.Generator, got {type(generator).__name__}")
    if seed is None:
        return int(torch.randint(below, (), generator=generator))
    if generator is not None:
        raise ValueError("seed: expected None together with a generator, which draws the seed; give one of both")
    return check_seed("seed", seed)
