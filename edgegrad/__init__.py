"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

import torch

from . import fit
from ._mesh_light import MeshLight
from .aovs import render_aovs
from .camera import Camera
from .environment import Environment
from .exchange import save_mesh
from .hits import Hits
from .io import View, load_camera, load_cameras, load_mesh, load_scene, read_image, save_camera, write_image
from .lights import (
    AreaLight,
    DirectionalLight,
    LightPoints,
    PointLight,
    SphericalHarmonics,
    SpotLight,
)
from .live import viewer
from .material import Material, Texture, vertex_normals
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

# What torch.load(weights_only=True) may make: dataclasses of tensors, which run nothing when they are loaded.
torch.serialization.add_safe_globals(
    [
        AreaLight, Camera, DirectionalLight, Environment, Material, Mesh, MeshLight, PointLight, Scene, SphericalHarmonics,
        SpotLight, Texture,
    ]
)  # fmt: skip

__version__ = "0.1.0"

__all__ = [
    "AreaLight",
    "Camera",
    "DirectionalLight",
    "EdgeSamples",
    "Environment",
    "Hits",
    "LightPoints",
    "Material",
    "Mesh",
    "Plan",
    "PointLight",
    "PrimaryHits",
    "Scene",
    "SphericalHarmonics",
    "SpotLight",
    "SurfaceSamples",
    "Texture",
    "View",
    "attach_boundary",
    "edge_samples",
    "fit",
    "jvp",
    "load_camera",
    "load_cameras",
    "load_mesh",
    "load_scene",
    "plan",
    "primary_hits",
    "profile",
    "read_image",
    "render",
    "render_aovs",
    "save_camera",
    "save_mesh",
    "screen_gradient",
    "surface_samples",
    "trace",
    "vertex_normals",
    "viewer",
    "write_image",
]
