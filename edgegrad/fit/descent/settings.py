"""The numbers of fits by descent: what each means, and its unit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class DescentSettings:
    """Numbers of descents of images, and of the fits on them."""

    batch: int = 32  # directions of differentiation at a time, where scenes are made in batches; time and memory alone
    max_derivatives: int = 2**23  # elements of a channel's derivatives in one call; time and memory alone
    # Smaller differences count as this in weights, in ranges of the pictures. Losses with a finite weight at 0, all but l1,
    # hardly depend on it. A pose by l1 takes 167 steps with half, 88, and 65 with twice.
    min_residual: float = 1e-3
    # Sets of samples by which losses of some views are compared: of three fits of colours by two of six views, half ends two
    # too early, this one of them, and twice none.
    sets_of_views: int = 4
    # The first λ by regions, whose start may be far (Nielsen's τ): colours are those of a wrong place. Half and twice change
    # three of four brackets by less than 0.15°; the fourth is lost with all.
    region_damping: float = 1.0
    # Pixels on the shorter side of pictures of the coarse levels of fit_shape(). Errors of an egg are the same with half and
    # twice, which take 0.9 and 1.4 times as long.
    coarsest_pixels: int = 64
    # On the shorter side of the coarsest level of fit_texture(): half gains 0.6 dB in 80 steps, twice loses 0.5 dB.
    coarsest_texels: int = 4


DESCENT = DescentSettings()
