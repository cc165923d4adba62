from . import errors, files
from .dataset import Dataset
from .evaluate import evaluate
from .refine import refine

__all__ = ["Dataset", "errors", "evaluate", "files", "refine"]
