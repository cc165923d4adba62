from . import fit, image, lights, points, rig, shapes, textures, track
from .aovs import render_aovs
from .camera.camera import Camera
from .files.cameras import load_camera, load_cameras, save_camera
from .files.depth import read_depth
from .files.image import read_image, write_image
from .files.load import load_mesh, load_scene
from .files.mask import read_mask
from .files.save import save_mesh, save_scene
from .live.view import viewer
from .noise import noise
from .plan import plan
from .profile import profile
from .render import jvp, render, render_batch, screen_gradient
from .sampling import Sampling
from .scene.material import Material, Texture
from .scene.mesh import Mesh
from .scene.scene import Scene
from .scene.symmetries import Symmetries

__version__: str

__all__ = [
    "Camera",
    "Material",
    "Mesh",
    "Sampling",
    "Scene",
    "Symmetries",
    "Texture",
    "fit",
    "image",
    "jvp",
    "lights",
    "load_camera",
    "load_cameras",
    "load_mesh",
    "load_scene",
    "noise",
    "plan",
    "points",
    "profile",
    "read_depth",
    "read_image",
    "read_mask",
    "render",
    "render_aovs",
    "render_batch",
    "rig",
    "save_camera",
    "save_mesh",
    "save_scene",
    "screen_gradient",
    "shapes",
    "textures",
    "track",
    "viewer",
    "write_image",
]
