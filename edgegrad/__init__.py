"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

from .aovs import render_aovs
from .camera import Camera
from .hits import Hits
from .io import load_camera, load_mesh, load_scene, read_image, save_camera, write_image
from .mesh import Mesh
from .plan import Plan, plan, profile
from .render import jvp, render, screen_gradient
from .scene import Scene

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Hits",
    "Mesh",
    "Plan",
    "Scene",
    "jvp",
    "load_camera",
    "load_mesh",
    "load_scene",
    "plan",
    "profile",
    "read_image",
    "render",
    "render_aovs",
    "save_camera",
    "screen_gradient",
    "write_image",
]
