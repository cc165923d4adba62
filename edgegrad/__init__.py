"""edgegrad: a PyTorch layer that renders triangle meshes on the CPU and returns correct gradients, also at silhouettes."""

import torch

from . import fit
from . import image as image
from . import io as io
from . import lights as lights
from .aovs import render_aovs
from .bake import SurfacePoints, bake, bake_pictures
from .camera.camera import Camera
from .files.save import from_trimesh, to_trimesh
from .io import (
    View,
    load_camera,
    load_cameras,
    load_mesh,
    load_scene,
    read_depth,
    read_image,
    read_mask,
    save_camera,
    save_mesh,
    save_scene,
    write_image,
)
from .light.by_material import points_by_material
from .live import viewer
from .plan import Plan, plan
from .points.hits import Hits
from .points.rays import trace
from .points.samples import (
    EdgeSamples,
    PrimaryHits,
    SurfaceSamples,
    attach_boundary,
    edge_samples,
    primary_hits,
    surface_samples,
)
from .preview import thumbnail
from .profile import profile
from .render import jvp, render, render_batch, screen_gradient
from .rig.animation import Animation, Channel
from .rig.control import Control
from .rig.joints import Joints
from .rig.load import load_rig
from .rig.rig import Rig
from .rig.robot import load_robot
from .rig.skin import Skin
from .scene import provided
from .scene.environment import Environment
from .scene.find_symmetries import find_symmetries
from .scene.lights import AreaLight, DirectionalLight, LightPoints, PointLight, SphericalHarmonics, SpotLight
from .scene.material import Material, Texture, vertex_normals
from .scene.mesh import Mesh
from .scene.mesh_light import MeshLight
from .scene.scene import Scene
from .scene.symmetries import Symmetries, SymmetryAxis
from .scene.unwrapping import unwrap

# What the classes of scenes can do with the help of packages above them.
provided.from_trimesh, provided.to_trimesh, provided.thumbnail = from_trimesh, to_trimesh, thumbnail
provided.points_by_material = points_by_material
del from_trimesh, to_trimesh, thumbnail, points_by_material, provided  # names of the package are those below

# What torch.load(weights_only=True) may make: dataclasses of tensors, which run nothing when they are loaded.
torch.serialization.add_safe_globals(
    [
        AreaLight, Camera, DirectionalLight, Environment, Material, Mesh, MeshLight, PointLight, Scene, SphericalHarmonics,
        SpotLight, Symmetries, SymmetryAxis, Texture,
    ]
)  # fmt: skip

__version__ = "0.1.0"

__all__ = [
    "Animation",
    "AreaLight",
    "Camera",
    "Channel",
    "Control",
    "DirectionalLight",
    "EdgeSamples",
    "Environment",
    "Hits",
    "Joints",
    "LightPoints",
    "Material",
    "Mesh",
    "Plan",
    "PointLight",
    "PrimaryHits",
    "Rig",
    "Scene",
    "Skin",
    "SphericalHarmonics",
    "SpotLight",
    "SurfacePoints",
    "SurfaceSamples",
    "Symmetries",
    "SymmetryAxis",
    "Texture",
    "View",
    "attach_boundary",
    "bake",
    "bake_pictures",
    "edge_samples",
    "find_symmetries",
    "fit",
    "jvp",
    "load_camera",
    "load_cameras",
    "load_mesh",
    "load_rig",
    "load_robot",
    "load_scene",
    "plan",
    "primary_hits",
    "profile",
    "read_depth",
    "read_image",
    "read_mask",
    "render",
    "render_aovs",
    "render_batch",
    "save_camera",
    "save_mesh",
    "save_scene",
    "screen_gradient",
    "surface_samples",
    "trace",
    "unwrap",
    "vertex_normals",
    "viewer",
    "write_image",
]
