"""Tracking: the poses of known meshes from frame to frame, of a film or a live camera, and how sure they are."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
