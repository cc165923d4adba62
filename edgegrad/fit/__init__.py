"""Fitting: what a picture says about a scene, found by following the gradients of `render`."""

from .pose import fit_pose
from .result import Pose, PoseFit, Step

__all__ = ["Pose", "PoseFit", "Step", "fit_pose"]
