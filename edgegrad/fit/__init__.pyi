from . import losses, priors, regularizers
from .checkpoints import Checkpoint
from .descent.fit_scene import Progress, fit_scene
from .descent.fit_shape import Refinement, fit_shape
from .descent.fit_texture import fit_texture
from .descent.result import Fit
from .ending import Ending
from .history import Record
from .hull import visual_hull
from .measured import Measured
from .options import FitOptions
from .parameter import Parameter
from .placement import Pose, PoseParameter
from .pose.calibrate import Calibration, calibrate
from .pose.camera_uncertainty import CameraUncertainty
from .pose.fit_camera import CameraFit, fit_camera
from .pose.fit_pose import fit_pose
from .pose.fit_poses import fit_poses
from .pose.result import PoseFit, Step
from .pose.track import TrackedPose, track
from .pose.uncertainty import Uncertainty
from .rig.fit_rig import fit_rig
from .rig.result import RigFit
from .rig.track_rig import track_rig
from .rig.uncertainty import JointUncertainty

__all__ = [
    "Calibration", "CameraFit", "CameraUncertainty", "Checkpoint", "Ending", "Fit", "FitOptions", "JointUncertainty", "Measured",
    "Parameter", "Pose", "PoseFit", "PoseParameter", "Progress", "Record", "Refinement", "RigFit", "Step", "TrackedPose",
    "Uncertainty", "calibrate", "fit_camera", "fit_pose", "fit_poses", "fit_rig", "fit_scene", "fit_shape", "fit_texture",
    "losses", "priors", "regularizers", "track", "track_rig", "visual_hull",
]  # fmt: skip
