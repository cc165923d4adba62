"""How an image and its gradient are sampled: what only experts set, and seeds as torch draws them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypedDict, TypeVar

import torch
from torch import Tensor

from .check import as_int, check_positive, check_positive_int, values_visible

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
        edges, and borders of nearest texels, at `spp=16`; more samples bring them closer. Closer lines cost more and err less.
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
        if not isinstance(self.creases, (bool, str)) or self.creases not in (True, False, "auto"):
            raise ValueError(f'sampling.creases: expected "auto", True or False, got {self.creases!r}')
        if self.seed is not None:
            check_seed("sampling.seed", self.seed)


class RenderOptions(TypedDict, total=False):
    """Arguments of render() by keyword, which functions around it hand on."""

    shader: Any
    filter: str
    visibility: bool
    shadows: bool
    bounces: int
    sampling: Sampling | None
    generator: torch.Generator | None


SHADING = ("shader", "shadows", "bounces")  # those that say how points are shaded


def without_shading(options: RenderOptions) -> dict[str, Any]:
    """Return the options that all images have."""
    return {name: value for name, value in options.items() if name not in SHADING}


def check_options(function: str, options: Mapping[str, Any], without: Sequence[str] = ()) -> None:
    """Raise TypeError if a `function` that takes the options of render(), but for those `without`, was given others."""
    known = [name for name in RenderOptions.__annotations__ if name not in without]
    if unknown := [name for name in options if name not in known]:
        raise TypeError(f"{function}: expected only the options {', '.join(known)}, got {unknown[0]!r}")


def check_seed(name: str, seed: object) -> int:
    """Return the seed as an int. Raises TypeError or ValueError."""
    number = as_int(name, seed)
    if not 0 <= number < 2**63:
        raise ValueError(f"{name}: expected an int from 0 to 2⁶³ − 1, got {number}")
    return number


def check_sampling(sampling: object) -> Sampling:
    """Return the Sampling that was given, or the default for None. Raises TypeError."""
    if sampling is not None and not isinstance(sampling, Sampling):
        raise TypeError(f"sampling: expected an edgegrad.Sampling, got {type(sampling).__name__}")
    return sampling or Sampling()


def drawn_seed(seed: object = None, generator: torch.Generator | None = None) -> Tensor:
    """Return a seed () int64: the one given, or one that torch's generator draws, as torch.randint would, for None.

    Under torch.compile it is part of the graph. Under torch.vmap it is drawn as its `randomness` says. Raises TypeError or
    ValueError for what is no seed, and for a seed together with a generator.
    """
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(f"generator: expected a torch.Generator, got {type(generator).__name__}")
    if seed is None:
        device = "cpu" if generator is None else generator.device
        return torch.randint(2**63 - 1, (), generator=generator, device=device).cpu()
    if generator is not None:
        raise ValueError("seed: expected None together with a generator, which draws the seed; give one of them")
    if isinstance(seed, Tensor) and not values_visible(seed):
        return seed  # one that was drawn in torch.compile or torch.vmap
    return torch.tensor(check_seed("seed", seed), device="cpu")


_Seed = TypeVar("_Seed", int, Tensor)


def derived_seed(seed: _Seed, stream: int = 1) -> _Seed:
    """Return a seed of its own for each stream: multiplication by an odd number is a bijection, so no two seeds meet."""
    return (seed * 0x5851F42D4C957F2D + stream * 0x14057B7EF767814F) & (2**63 - 1)


def camera_seed(seed: int, camera: int) -> int:
    """Return the seed of a camera of a batch: each has samples of its own."""
    return seed if camera == 0 else derived_seed(seed, camera + 1)
