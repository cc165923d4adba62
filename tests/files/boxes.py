"""A box with materials and appearances that 8 bits hold, and the schema of glTF."""

from functools import cache

import pytest
import torch
from scenes import cube
from trimesh.exchange.gltf import get_schema

import edgegrad as eg
from edgegrad.files.image import srgb_to_linear

VERTS, FACES = cube().verts.float(), cube().faces
random = torch.Generator().manual_seed(0)
UVS, UV_FACES = 2.0 * torch.rand(20, 2, generator=random), torch.arange(36).reshape(12, 3) % 20
OWN = {"uvs": torch.rand(36, 2, generator=random), "uv_faces": torch.arange(36).reshape(12, 3).flip(0)}


def data(channels=3, h=4, w=8, least=0):
    """Return an image that 8 bits hold."""
    return torch.randint(least, 256, (h, w, channels), generator=random) / 255.0


def color(channels=3, **size):
    """Return an image whose sRGB values 8 bits hold."""
    image = srgb_to_linear(data(channels, **size).double()).float()
    image[0, 0] = 1.0
    return image


def box(material=None, **look):
    return eg.Mesh(VERTS, FACES, uvs=UVS, uv_faces=UV_FACES, material=material, **look)


APPEARANCES = {
    "colours": {"colors": torch.rand(8, 3, generator=random)},
    "grey": {"colors": torch.rand(8, 1, generator=random)},
    "colours of faces": {"face_colors": torch.rand(12, 3, generator=random)},
    "colours of corners": {"corner_colors": torch.rand(12, 3, 3, generator=random)},
    "texture": {"texture": color(), "wrap": ("mirror", "clamp"), "filter": "nearest"},
    "nothing": {},
    "normals of corners": {"normals": eg.Mesh(VERTS, FACES).vertex_normals()[FACES].flatten(0, 1).roll(1, 0),
                           "normal_faces": torch.arange(36).reshape(12, 3)},
    "name": {"name": "crate"},
}  # fmt: skip


@cache
def schema():
    """Return a validator of the schema of glTF, which trimesh has."""
    jsonschema = pytest.importorskip("jsonschema")
    return jsonschema.validators.validator_for(get_schema())(get_schema())
