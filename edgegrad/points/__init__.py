"""Points of surfaces and of the curves at which the image jumps, for what is written in PyTorch."""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
