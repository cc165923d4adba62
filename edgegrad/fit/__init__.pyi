from . import losses, priors, regularizers
from .checkpoints import Checkpoint
from .descent.fit_scene import fit_scene
from .descent.fit_shape import Refinement, fit_shape
from .descent.fit_texture import fit_texture
from .measured import Measured
from .options import FitOptions
from .placement import Parameter, PoseParameter
from .pose.fit_camera import calibrate, fit_camera
from .pose.fit_pose import fit_pose
from .pose.fit_poses import fit_poses
from .rig.fit_rig import fit_rig
from .rig.track_rig import track_rig

__all__ = [
    "Checkpoint", "FitOptions", "Measured", "Parameter", "PoseParameter", "Refinement", "calibrate", "fit_camera", "fit_pose",
    "fit_poses", "fit_rig", "fit_scene", "fit_shape", "fit_texture", "losses", "priors", "regularizers", "track_rig",
]  # fmt: skip
