"""Files cut off, with changed bytes, or with a wrong value in their JSON load as they should, or are refused by name."""

import math

import numpy as np
import pytest
import torch
from lit_gltf import CORNERS, TURN, file, places
from mesh_3mf import triangle_3mf
from mesh_files import GOOD, OFF, SQUARE, STL, TEXELS, TEXTURED, TRIANGLES, changed, load, ply, saved, square_glb, write

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

PIXELS = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(1))
SKIN = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG")]}
WHOLE = {
    "a.glb": square_glb(TEXTURED, uv=True, **SKIN),
    "a.ply": ply(SQUARE, TRIANGLES, [[1, 2, 3]] * 4, binary=True),
    "b.ply": ply(SQUARE, TRIANGLES),
    "a.obj": GOOD.encode() * 2,
    "a.stl": STL.replace("endsolid a", STL[8:]).encode(),
    "a.off": OFF.encode(),
    "a.3mf": triangle_3mf(),
    "a.png": saved("PNG"),
    "a.jpg": saved("JPEG"),
    "a.tif": saved("TIFF"),
    "a.bmp": saved("BMP"),
    "a.exr": PIXELS,
}  # fmt: skip
# Every beginning of these is refused, or loads as the whole does. JPEG and TIFF may end early; an OBJ ends anywhere.
COUNTED = [name for name in WHOLE if name not in ("a.obj", "a.jpg", "a.tif")]


@pytest.fixture
def whole(tmp_path, name):
    """Return the bytes of a good file."""
    if name == "a.exr":
        eg.write_image(tmp_path / name, WHOLE[name])
        return (tmp_path / name).read_bytes()
    return WHOLE[name]


@pytest.mark.parametrize("name", COUNTED)
def test_a_beginning_of_a_file_is_refused_by_name_or_loads_as_the_whole(tmp_path, name, whole):
    expected = load(write(tmp_path, name, whole))
    for end in range(1, len(whole), max(1, len(whole) // 70)):
        try:
            found = load(write(tmp_path, name, whole[:end]))
        except ValueError as error:
            assert str(error).startswith(str(tmp_path / name))
            continue
        if isinstance(expected, torch.Tensor):
            assert torch.equal(found, expected), end
        else:
            assert repr(found) == repr(expected), end
            for mesh, other in zip(found.meshes, expected.meshes, strict=True):
                assert torch.equal(mesh.verts, other.verts) or (name, end) == ("a.off", len(whole) - 1), end


@pytest.mark.parametrize("name", WHOLE)
def test_changed_bytes_are_refused_by_name_or_load(tmp_path, name, whole):
    """The types of the errors are all that a caller must know."""
    random, refused = np.random.default_rng(list(WHOLE).index(name)), 0
    for _ in range(75):
        content = bytearray(whole)
        for at in random.integers(0, len(content), random.integers(1, 6)):
            content[at] = random.integers(0, 256)
        path = write(tmp_path, name, bytes(content))
        try:
            load(path)
        except (ValueError, FileNotFoundError) as error:
            assert str(path) in str(error)
            refused += 1
    assert refused > 0 or name in ("a.bmp", "a.jpg")  # most of whose bytes are pixels


JUNK = (
    None,
    -1,
    0,
    3,
    10**9,
    1.5,
    math.nan,
    math.inf,
    1e300,
    "",
    "KHR",
    [],
    [1],
    [1, 2, 3, 4, 5],
    {},
    {"index": 0},
    True,
)


def whole_file(folder):
    """Write a GLB with something of everything."""
    transform = {"KHR_texture_transform": {"offset": [0, 1], "rotation": 1.0, "scale": [1, 2], "texCoord": 1}}
    given = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0}, "baseColorFactor": [1, 1, 1, 1], "metallicRoughnessTexture": {"index": 0},
            "metallicFactor": 0.5, "roughnessFactor": 0.5,
        },
        "emissiveTexture": {"index": 0, "extensions": transform}, "emissiveFactor": [1, 1, 1],
        "normalTexture": {"index": 0, "scale": 1.0}, "occlusionTexture": {"index": 0}, "alphaMode": "BLEND", "doubleSided": True,
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 2.0}, "KHR_materials_sheen": {}},
    }  # fmt: skip
    light = {"extensions": {"KHR_lights_punctual": {"light": 0}}, "rotation": TURN, "scale": [1, 1, 1]}
    return file(
        folder, given, [TEXELS], nodes=[{"mesh": 0, "children": [1]}, light], roots=[0], uvs=(CORNERS, CORNERS),
        attributes={"NORMAL": np.array([[0, 0, 1]] * 4, "<f4"), "COLOR_0": np.ones((4, 4), "<f4")},
        lights=[{"type": "spot", "color": [1, 1, 1], "range": 1.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.5}}],
        samplers=[{"wrapS": 33071, "minFilter": 9987}], extensionsUsed=["KHR_lights_punctual"],
    )  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*not rendered as the file asks")
@pytest.mark.parametrize("count", [120, pytest.param(4000, marks=pytest.mark.slow)])
def test_files_with_one_wrong_value_load_or_are_refused_by_name(tmp_path, count):
    path = whole_file(tmp_path)
    whole, random = path.read_bytes(), np.random.default_rng(1)
    eg.load_scene(path, lit=True)
    refused = 0
    for _ in range(count):

        def replace_one_value(tree):
            found = list(places(tree))
            holder, key = found[random.integers(len(found))]
            holder[key] = JUNK[random.integers(len(JUNK))]

        path.write_bytes(changed(replace_one_value, whole))
        try:
            eg.load_scene(path, lit=True)
        except (ValueError, FileNotFoundError) as error:
            assert str(error).startswith(str(path)), error
            refused += 1
    assert 0.1 * count < refused < 0.9 * count
