"""glTF files with one wrong value load, or are refused by name."""

import math

import numpy as np
import pytest
from lit_gltf import CORNERS, TURN, file, places
from mesh_files import TEXELS
from test_bad_files import changed

import edgegrad as eg

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
    """Something of everything."""
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

        def spoil(tree):
            found = list(places(tree))
            holder, key = found[random.integers(len(found))]
            holder[key] = JUNK[random.integers(len(JUNK))]

        path.write_bytes(changed(spoil, whole))
        try:
            eg.load_scene(path, lit=True)
        except (ValueError, FileNotFoundError) as error:
            assert str(error).startswith(str(path)), error
            refused += 1
    assert 0.1 * count < refused < 0.9 * count
