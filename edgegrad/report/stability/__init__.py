"""Extreme cases, unbiasedness, steps within faces and ill-conditioned fits."""

from .run import failures, stability

__all__ = ["failures", "stability"]
