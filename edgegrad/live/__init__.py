"""The live view of a fit: a page in a browser, or a figure in a notebook. Other parts of the library do without it."""

from .view import Viewer, viewer

__all__ = ["Viewer", "viewer"]
