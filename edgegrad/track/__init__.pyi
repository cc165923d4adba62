from .film import track
from .result import TrackedPose
from .tracker import Tracker

__all__ = ["TrackedPose", "Tracker", "track"]
