"""Fitting: what pictures say about a scene, found by following the gradients of `render`."""

from . import losses, regularizers
from .camera import CameraFit, fit_camera
from .fitted import Fit
from .frame import Options, Parameter, Record
from .pose import fit_pose
from .result import Pose, PoseFit, Step
from .scene import Progress, fit_scene
from .shape import fit_shape
from .texture import fit_texture

__all__ = [
    "CameraFit", "Fit", "Options", "Parameter", "Pose", "PoseFit", "Progress", "Record", "Step",
    "fit_camera", "fit_pose", "fit_scene", "fit_shape", "fit_texture", "losses", "regularizers",
]  # fmt: skip
