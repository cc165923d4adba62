"""How a fit ended, and what this means for its result, in words."""

from __future__ import annotations

from ..optim.history import Ending
from .edge_support import MIN_EDGE_SUPPORT


def reason_of(
    ending: Ending, explained: float, suspects: str = "scene, cameras or pictures", enough: float = MIN_EDGE_SUPPORT
) -> str:
    """Return "converged", or what kept the fit from it and, after a colon, how to mend it."""
    if ending is Ending.INTERRUPTED:
        return "interrupted"
    if ending is Ending.FALLING:
        return "loss still falling: give it more steps, or larger learning rates"
    if explained < enough:
        return (
            f"edges not explained: the pictures show {explained:.0%} of the render's edges; start nearer, or look for what is "
            f"wrong in {suspects}"
        )
    if ending is Ending.STEPS:
        return "steps ran out: what is sought has not come to rest; give it more steps"
    return "converged"
