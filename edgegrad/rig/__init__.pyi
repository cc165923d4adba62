from .control import Control
from .files import load
from .joints import Joints
from .rig import Rig

__all__ = ["Control", "Joints", "Rig", "load"]
