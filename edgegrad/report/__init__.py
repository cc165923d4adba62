"""Reports: the error of the gradient against the time it takes, beside other renderers, and in extreme cases."""

from .error_time.run import error_time
from .scenes import SCENES, ReportScene, build
from .stability.run import stability

__all__ = ["SCENES", "ReportScene", "build", "error_time", "stability"]
