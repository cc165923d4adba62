"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

import os as _os

# Threads of OpenMP that spin while they wait take the cores from the ones that work as soon as anything else runs on the
# machine: a backward pass of 2 ms was seen to take 123 ms. A tenth of a millisecond, in GNU's runtime, is long enough to be
# there for the next loop of the same pass. Without effect where torch was imported before, or the user chose.
if "OMP_WAIT_POLICY" not in _os.environ:
    _os.environ["OMP_WAIT_POLICY"] = "passive"
    _os.environ.setdefault("GOMP_SPINCOUNT", "3000")

from .camera import Camera
from .io import load_camera, load_mesh, load_scene, read_image, save_camera, write_image
from .mesh import Mesh
from .plan import Plan, plan, profile
from .render import render
from .scene import Scene

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Mesh",
    "Plan",
    "Scene",
    "load_camera",
    "load_mesh",
    "load_scene",
    "plan",
    "profile",
    "read_image",
    "render",
    "save_camera",
    "write_image",
]
