"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

from .aovs import render_aovs
from .camera import Camera
from .hits import Hits
from .io import load_camera, load_mesh, load_scene, read_image, save_camera, write_image
from .mesh import Mesh
from .plan import Plan, plan, profile
from .render import jvp, render, screen_gradient
from .samples import (
    EdgeSamples,
    PrimaryHits,
    SurfaceSamples,
    attach_boundary,
    edge_samples,
    primary_hits,
    surface_samples,
    trace,
)
from .scene import Scene

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "EdgeSamples",
    "Hits",
    "Mesh",
    "Plan",
    "PrimaryHits",
    "Scene",
    "SurfaceSamples",
    "attach_boundary",
    "edge_samples",
    "jvp",
    "load_camera",
    "load_mesh",
    "load_scene",
    "plan",
    "primary_hits",
    "profile",
    "read_image",
    "render",
    "render_aovs",
    "save_camera",
    "screen_gradient",
    "surface_samples",
    "trace",
    "write_image",
]
