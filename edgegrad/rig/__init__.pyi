from .control import Control
from .files import load
from .joints import Joints
from .rig import Rig
from .skin import Skin

__all__ = ["Control", "Joints", "Rig", "Skin", "load"]
