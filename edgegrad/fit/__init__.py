"""Fits: find scenes, cameras, poses, shapes and textures from pictures by the gradients of `render`."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
