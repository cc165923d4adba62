"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes.

Names are imported on first use, as `__init__.pyi` lists them: importing the package alone imports neither torch nor the kernel.
"""

import sys as _sys

import lazy_loader as _lazy

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)

if "IPython" in _sys.modules and (_shell := _sys.modules["IPython"].get_ipython()) is not None:
    from . import notebook as _notebook

    _notebook.register(_shell.display_formatter.formatters["image/png"])
