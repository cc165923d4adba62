"""A GLB file of one square, for tests of materials and lights."""

import io
import math

import numpy as np
from mesh_files import SQUARE, TRIANGLES, glb
from PIL import Image

import edgegrad as eg

CORNERS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")  # texture coordinates of SQUARE, v running down


def png(texels, kind="PNG"):
    stream = io.BytesIO()
    Image.fromarray(np.asarray(texels, np.uint8)).save(stream, kind)
    return stream.getvalue()


def file(folder, material=None, images=(), positions=SQUARE, nodes=None, uvs=(CORNERS,), **more):
    """Write a GLB file of one square: images are texels, one texture each; `attributes`, `samplers` and `lights` are
    the format's."""
    arrays = [np.array(positions, "<f4"), np.array(TRIANGLES, "<u2").reshape(-1)]
    given = {f"TEXCOORD_{k}": uv for k, uv in enumerate(uvs)} | more.pop("attributes", {})
    attributes = {"POSITION": 0} | {name: 2 + k for k, name in enumerate(given)}
    arrays += [np.asarray(array) for array in given.values()]
    views = range(len(arrays), len(arrays) + len(images))
    tree = {
        "scene": 0,
        "scenes": [{"nodes": more.pop("roots", list(range(len(nodes or [0]))))}],
        "nodes": nodes or [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": 1, **more.pop("primitive", {})}]}],
        "images": [{"bufferView": k} for k in views],
        "textures": [{"source": k, **({"sampler": k} if "samplers" in more else {})} for k in range(len(images))],
    }
    if material is not None:
        tree["materials"] = [material]
        tree["meshes"][0]["primitives"][0]["material"] = 0
    if "lights" in more:
        tree["extensions"] = {"KHR_lights_punctual": {"lights": more.pop("lights")}}
    path = folder / "a.glb"
    path.write_bytes(glb(tree | more, *arrays, *map(png, images)))
    return path


def loaded(*arguments, **options):
    (mesh,) = eg.load_scene(file(*arguments, **options), lit=True).meshes
    return mesh


def shown(mesh, size=8):
    """Return the square from the front, row 0 on top; where it emits, and nothing else lights it, this is its
    emission."""
    camera = eg.Camera.look_at([0.5, 0.5, 100.0], [0.5, 0.5, 0.0], size=(size, size), fov_y=math.degrees(0.01))
    return eg.render(eg.Scene([mesh]), camera, spp=16, seed=0).detach().numpy()


TURN = [0.0, 2**-0.5, 0.0, 2**-0.5]  # a quarter turn about y, as (x, y, z, w): −z points to −x


def places(tree):
    """Yield every value of a JSON tree by its holder and key."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        yield tree, key
        yield from places(tree[key])


CAMERAS = [
    {"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 3.0, "znear": 0.1}},
    {"type": "orthographic", "orthographic": {"xmag": 1.0, "ymag": 2.0, "znear": 0.1, "zfar": 10.0}},
]
