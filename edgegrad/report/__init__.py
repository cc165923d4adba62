"""Reports: the error of the gradient against the time it takes, for edgegrad, finite differences and other renderers."""

from .error_time import error_time
from .scenes import SCENES, ReportScene, build

__all__ = ["SCENES", "ReportScene", "build", "error_time"]
