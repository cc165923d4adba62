"""Fitting: what pictures say about a scene, found by following the gradients of `render`."""

from . import losses, regularizers
from .descent.fit_scene import Progress, fit_scene
from .descent.fit_shape import fit_shape
from .descent.fit_texture import fit_texture
from .descent.result import Fit
from .history import Record
from .options import Options, Parameter
from .pose.fit_camera import CameraFit, fit_camera
from .pose.fit_pose import fit_pose
from .pose.pose import Pose
from .pose.result import PoseFit, Step
from .pose.track import TrackedPose, track

__all__ = [
    "CameraFit", "Fit", "Options", "Parameter", "Pose", "PoseFit", "Progress", "Record", "Step", "TrackedPose",
    "fit_camera", "fit_pose", "fit_scene", "fit_shape", "fit_texture", "losses", "regularizers", "track",
]  # fmt: skip
