"""Pictures of the bracket and of other meshes as a photograph shows them: lit, before clutter, blurred, noisy and compressed."""

import io

import numpy as np
import torch
from brackets import bracket
from PIL import Image

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.region import smoothed


def clutter(size, seed=0):
    """Return an image (size, size, 3) of boards of many colours that lie on one another."""
    rng = np.random.default_rng(seed)
    image = np.full((size, size, 3), 0.3)
    for _ in range(50):
        (top, left), (h, w) = rng.uniform(-0.1, 1.0, 2) * size, rng.uniform(0.05, 0.4, 2) * size
        image[max(0, int(top)) : int(top + h) + 1, max(0, int(left)) : int(left + w) + 1] = rng.uniform(0.02, 0.8, 3)
    return torch.from_numpy(image).float()


def photograph(view, *meshes, seed=0, gain=(1.3, 1.0, 0.8), sampling=None):
    """Return meshes, by default the bracket, in the light of a sun and a sky, blurred as a lens does, noisy and compressed."""
    lit = [mesh.replace(material=eg.Material()) for mesh in meshes or [bracket()]]
    lights = [
        eg.lights.DirectionalLight(torch.tensor([-0.5, -1.0, -0.8]).double(), 2.0),
        eg.lights.Environment(torch.full((3,), 0.35), visible=False),
    ]
    scene = eg.Scene(lit, clutter(view.size[0], seed), lights)
    with torch.no_grad():
        image = eg.render(scene, view, 32, 1 << 40, sampling=sampling)
    seen = smoothed((image * torch.tensor(gain)).clamp(0, 1).movedim(-1, 0), 0.7).movedim(0, -1)
    values = linear_to_srgb(seen)
    values = values + 0.015 * torch.randn(values.shape, generator=torch.Generator().manual_seed(seed))
    return compressed(values.clamp(0, 1), 85)


def compressed(display, quality):
    """Return the radiance of sRGB values from 0 to 1 after a JPEG file of them."""
    file = io.BytesIO()
    Image.fromarray((255.0 * display).round().byte().numpy()).save(file, "JPEG", quality=quality)
    return srgb_to_linear(torch.from_numpy(np.array(Image.open(file))).float() / 255.0)


def coverage(view):
    """Return the share (H, W, 1) of each pixel that the bracket covers."""
    return eg.render_aovs(bracket(), view, ["alpha"], spp=64, seed=0)["alpha"]


def depth_of(view, *meshes):
    """Return depths (H, W, 1) of meshes, by default the bracket; 0 where they do not cover a pixel."""
    seen = eg.render_aovs(eg.Scene(list(meshes) or [bracket()]), view, ["alpha", "depth"], spp=16, seed=0)
    return torch.where(seen["alpha"] > 0.99, seen["depth"] / seen["alpha"].clamp(min=0.01), 0.0)
