"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

from .camera import Camera
from .mesh import Mesh
from .render import render
from .scene import Scene

__version__ = "0.1.0"

__all__ = ["Camera", "Mesh", "Scene", "render"]
