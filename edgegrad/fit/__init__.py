"""Fitting: what pictures say about a scene, found by following the gradients of `render`."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
