from . import fit, image, io, lights
from .aovs import render_aovs
from .bake import SurfacePoints, bake, bake_pictures
from .camera.camera import Camera
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
from .live import viewer
from .noise import noise
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
from .profile import profile
from .render import jvp, render, render_batch, screen_gradient
from .rig.animation import Animation, Channel
from .rig.control import Control
from .rig.joints import Joints
from .rig.load import load_rig
from .rig.rig import Rig
from .rig.robot import load_robot
from .rig.skin import Skin
from .sampling import Sampling
from .scene.environment import Environment
from .scene.find_symmetries import find_symmetries
from .scene.lights import AreaLight, DirectionalLight, LightPoints, PointLight, SphericalHarmonics, SpotLight
from .scene.material import Material, Texture, vertex_normals
from .scene.mesh import Mesh
from .scene.scene import Scene
from .scene.symmetries import Symmetries, SymmetryAxis
from .scene.unwrapping import unwrap

__version__: str

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
    "Sampling",
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
    "image",
    "io",
    "jvp",
    "lights",
    "load_camera",
    "load_cameras",
    "load_mesh",
    "load_rig",
    "load_robot",
    "load_scene",
    "noise",
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
