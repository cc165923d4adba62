"""The error of the gradient against the time it takes."""

from .run import error_time

__all__ = ["error_time"]
