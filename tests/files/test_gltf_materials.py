"""Materials from glTF files, which are made here and compared number by number with what the format says."""

import math
import warnings

import numpy as np
import pytest
import torch
from lit_gltf import CORNERS, file, loaded, shown
from mesh_files import SQUARE, TEXELS, changed, linear

import edgegrad as eg
from edgegrad.scene.appearance import OnMesh

IMAGE = np.random.default_rng(3).integers(0, 256, (16, 16, 3), dtype=np.uint8)


def test_by_default_scenes_are_not_lit(tmp_path):
    path = file(tmp_path, {"emissiveFactor": [1, 1, 1]}, lights=[{"type": "point"}],
                nodes=[{"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}],
                attributes={"NORMAL": np.array([[0, 0, 1]] * 4, "<f4")})  # fmt: skip
    for scene in (eg.load_scene(path), eg.Scene([eg.load_mesh(path)])):
        assert not scene.is_lit and scene.meshes[0].normals is None
    assert eg.load_scene(path, lit=True).is_lit
    with pytest.raises(TypeError, match="lit: expected True or False, got str"):
        eg.load_scene(path, lit="yes")


def test_factors(tmp_path):
    base = {"baseColorFactor": [0.1, 0.2, 0.3, 1.0], "metallicFactor": 0.25, "roughnessFactor": 0.75}
    given = {"pbrMetallicRoughness": base, "emissiveFactor": [0.5, 0.25, 1.0], "doubleSided": True}
    mesh = loaded(tmp_path, given)
    material = mesh.material
    np.testing.assert_allclose(material.base_color, [0.1, 0.2, 0.3], rtol=1e-6)
    assert (float(material.metallic), float(material.roughness)) == (0.25, 0.75)
    np.testing.assert_allclose(material.emission, [0.5, 0.25, 1.0])
    assert material.two_sided and material.alpha_mode == "OPAQUE" and mesh.channels == 3
    assert material.textures == {} and mesh.texture is None and mesh.face_colors is None
    strength = {"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}}
    material = loaded(tmp_path, {**given, "extensions": strength}).material
    np.testing.assert_allclose(material.emission, [4.0, 2.0, 8.0])


@pytest.mark.parametrize("material", [None, {}])
def test_defaults_are_those_of_the_format(tmp_path, material):
    found = loaded(tmp_path, material).material
    assert found.base_color.tolist() == [1, 1, 1] and (float(found.metallic), float(found.roughness)) == (1.0, 1.0)
    assert found.emission is None and found.normal_map is None and not found.two_sided
    plain = eg.load_mesh(tmp_path / "a.glb", materials=False, lit=True).material
    assert (plain.base_color, plain.metallic, plain.roughness) == (None, None, None)


def test_textures_of_colour_are_srgb_and_those_of_data_are_not(tmp_path):
    images = [TEXELS, TEXELS[::-1], TEXELS[:, ::-1], TEXELS[::-1, ::-1]]
    given = {
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": 0},
            "baseColorFactor": [1.0, 0.5, 0.25, 1.0],
            "metallicRoughnessTexture": {"index": 1},
            "metallicFactor": 0.5,
        },
        "emissiveTexture": {"index": 2},
        "emissiveFactor": [1.0, 1.0, 0.5],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 4.0}},
        "normalTexture": {"index": 3, "scale": 0.5},
    }
    mesh = loaded(tmp_path, given, images)
    material, textures = mesh.material, mesh.material.textures
    np.testing.assert_allclose(textures["base_color"].image, linear(images[0]), atol=1e-6)
    np.testing.assert_allclose(textures["base_color"].factor, [1.0, 0.5, 0.25])
    np.testing.assert_allclose(textures["roughness"].image, images[1][..., 1:2] / 255.0, atol=1e-6)
    np.testing.assert_allclose(textures["metallic"].image, images[1][..., 2:3] / 255.0, atol=1e-6)
    assert textures["roughness"].factor is None and float(textures["metallic"].factor) == 0.5
    np.testing.assert_allclose(textures["emission"].image, linear(images[2]), atol=1e-6)
    np.testing.assert_allclose(textures["emission"].factor, [4.0, 4.0, 2.0])
    np.testing.assert_allclose(textures["normal_map"].image, images[3] / 255.0, atol=1e-6)
    assert float(material.normal_scale) == 0.5
    assert mesh.uvs is not None and all(texture.uvs is None for texture in textures.values())
    # A factor of zero needs no texture, and no emission is none.
    given["pbrMetallicRoughness"]["metallicFactor"] = 0
    given["emissiveFactor"] = [0, 0, 0]
    material = loaded(tmp_path, given, images).material
    assert float(material.metallic) == 0.0 and material.emission is None


def test_samplers(tmp_path):
    material = {"emissiveTexture": {"index": 0}, "emissiveFactor": [1, 1, 1]}
    for given, expected in (
        ({}, ("repeat", "repeat", "mipmap")),
        ({"wrapS": 33071, "wrapT": 33648, "minFilter": 9729}, ("clamp", "mirror", "linear")),
        ({"minFilter": 9987}, ("repeat", "repeat", "mipmap")),
        ({"minFilter": 9728, "magFilter": 9729}, ("repeat", "repeat", "linear")),
        ({"minFilter": 9987, "magFilter": 9728}, ("repeat", "repeat", "nearest")),
    ):
        texture = loaded(tmp_path, material, [TEXELS], samplers=[given]).material.emission
        assert (*texture.wraps, texture.filter) == expected
    with pytest.raises(ValueError, match=r"a\.glb.*expected a sampler of glTF 2\.0 .* minFilter 5"):
        loaded(tmp_path, material, [TEXELS], samplers=[{"minFilter": 5}])


# The first is the example of the extension: "the lower left quadrant of the source image, rotated clockwise 90°".
TURNED = {"offset": [0, 1], "rotation": math.pi / 2, "scale": [0.5, 0.5]}


@pytest.mark.parametrize(
    ("transform", "expected"),
    [
        (TURNED, np.rot90(IMAGE[8:, :8], -1).repeat(2, 0).repeat(2, 1)),
        ({"offset": [0.25, 0.5]}, np.roll(IMAGE, (-8, -4), (0, 1))),
        ({"offset": [0, 1], "scale": [1, -1]}, IMAGE[::-1]),
        ({"scale": [0.5, 1.0], "offset": [0.5, 0.0]}, IMAGE[:, 8:].repeat(2, 1)),
        # Scaled first: half of u runs up the image, from its lower end.
        ({"scale": [0.5, 1.0], "rotation": math.pi / 2}, np.rot90(IMAGE[8:], -1).repeat(2, 1)),
    ],
    ids=["turned", "shifted", "flipped", "scaled", "scaled, then turned"],
)
def test_texture_transforms_show_what_the_extension_says(tmp_path, transform, expected):
    reference = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    base = {"emissiveFactor": [1, 1, 1], "emissiveTexture": reference}
    nearest = [{"magFilter": 9728}]
    mesh = loaded(tmp_path, base, [IMAGE], samplers=nearest, extensionsRequired=["KHR_texture_transform"])
    np.testing.assert_allclose(shown(mesh, 16), linear(expected), atol=1e-5)
    # The same for the texture of a mesh that is not lit.
    unlit = {"pbrMetallicRoughness": {"baseColorTexture": reference}}
    path = file(tmp_path, unlit, [IMAGE], samplers=nearest)
    np.testing.assert_allclose(shown(eg.load_mesh(path), 16), linear(expected), atol=1e-5)


def test_each_texture_has_its_own_set_of_coordinates(tmp_path):
    half = {"KHR_texture_transform": {"scale": [0.5, 0.5], "texCoord": 1}}
    given = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}},
        "emissiveTexture": {"index": 0},
        "emissiveFactor": [1, 1, 1],
        "normalTexture": {"index": 0, "extensions": half},
    }
    other = CORNERS[[1, 2, 3, 0]]
    mesh = loaded(tmp_path, given, [TEXELS], uvs=(CORNERS, other))
    up = [1.0, -1.0]

    def at_corners(uvs, uv_faces):
        found = {}
        for face, rows in zip(mesh.faces.tolist(), uv_faces.tolist(), strict=True):
            found |= {tuple(mesh.verts[v].tolist()): uvs[t].tolist() for v, t in zip(face, rows, strict=True)}
        return np.array([found[tuple(map(float, p))] for p in SQUARE])

    np.testing.assert_allclose(at_corners(mesh.uvs, mesh.uv_faces), other * up + [0, 1])
    textures = mesh.material.textures
    assert textures["base_color"].uvs is None
    for name, uv in (("emission", CORNERS), ("normal_map", 0.5 * other)):
        np.testing.assert_allclose(at_corners(textures[name].uvs, textures[name].uv_faces), uv * up + [0, 1], atol=1e-7)
    bytes_of = np.round(other * 255).astype(np.uint8)  # normalised integers are as good
    mesh = loaded(tmp_path, given, [TEXELS], uvs=(CORNERS, bytes_of))
    np.testing.assert_allclose(at_corners(mesh.uvs, mesh.uv_faces), other * up + [0, 1])
    del given["pbrMetallicRoughness"]
    given["normalTexture"] = {"index": 0, "texCoord": 2}
    with pytest.raises(ValueError, match=r"a\.glb.*TEXCOORD_2 for the texture of normal_map, got none"):
        loaded(tmp_path, given, [TEXELS])


def test_vertex_colours_multiply_texture_and_factor(tmp_path):
    colors = np.array([[0.5, 1.0, 0.25]] * 4, "<f4")
    base = {"baseColorTexture": {"index": 0}, "baseColorFactor": [1.0, 0.5, 1.0, 1.0]}
    grey = np.full((1, 1, 3), 255)
    mesh = loaded(tmp_path, {"pbrMetallicRoughness": base}, [grey], attributes={"COLOR_0": colors})
    at = OnMesh(mesh, torch.zeros(1, dtype=torch.int64), torch.full((1, 3), 1 / 3))
    np.testing.assert_allclose(at.base_color()[0], [0.5, 0.5, 0.25], rtol=1e-6)


def test_unlit_materials_are_radiance(tmp_path):
    given = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "extensions": {"KHR_materials_unlit": {}}}
    nodes = [{"mesh": 0}, {"extensions": {"KHR_lights_punctual": {"light": 0}}}]
    lights = [{"type": "point", "intensity": 1e6}]
    scene = eg.load_scene(file(tmp_path, given, [TEXELS], nodes=nodes, lights=lights), lit=True)
    (mesh,) = scene.meshes
    assert mesh.material is None and len(scene.lights) == 1
    np.testing.assert_allclose(mesh.texture, linear(TEXELS), atol=1e-6)


def test_masks_and_blending(tmp_path):
    texels = np.concatenate([TEXELS, np.array([[0, 255], [102, 153]])[..., None]], -1)
    base = {"baseColorTexture": {"index": 0}}
    mesh = loaded(tmp_path, {"pbrMetallicRoughness": base, "alphaMode": "MASK", "alphaCutoff": 0.3}, [texels])
    assert (mesh.material.alpha_mode, mesh.alpha_cutoff) == ("MASK", 0.3)
    np.testing.assert_allclose(mesh.alpha, texels[..., 3] / 255.0, atol=1e-6)
    assert loaded(tmp_path, {"pbrMetallicRoughness": base}, [texels]).alpha is None
    mesh = loaded(tmp_path, {"pbrMetallicRoughness": base, "alphaMode": "BLEND", "alphaCutoff": 0.3}, [texels])
    assert mesh.material.alpha_mode == "BLEND"
    np.testing.assert_allclose(mesh.alpha, texels[..., 3] / 255.0, atol=1e-6)
    for opacity in (0.4, 0.6):
        thin = {"pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, opacity]}, "alphaMode": "BLEND"}
        mesh = loaded(tmp_path, {**thin, "emissiveFactor": [1, 1, 1]}, uvs=())
        np.testing.assert_allclose(shown(mesh)[2:-2, 2:-2], opacity, atol=1e-6)
    # Alpha that rises along x cuts out what is left of the middle, and textures stay where they lie.
    rising = {"COLOR_0": np.array([[1, 1, 1, x] for x, _, _ in SQUARE], "<f4")}
    glowing = {"emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}, "alphaMode": "MASK"}
    mesh = loaded(
        tmp_path, {**glowing, "pbrMetallicRoughness": base}, [IMAGE], attributes=rising, samplers=[{"magFilter": 9728}]
    )
    image = shown(mesh, 16)
    assert (image[:, :8] == 0).all()
    np.testing.assert_allclose(image[:, 8:], linear(IMAGE)[:, 8:], atol=1e-5)
    with pytest.raises(ValueError, match=r"a\.glb.*or the alpha of COLOR_0 to cut out, got both"):
        loaded(tmp_path, {"pbrMetallicRoughness": base, "alphaMode": "MASK"}, [texels], attributes=rising)
    with pytest.raises(ValueError, match=r"a\.glb.*expected alphaMode OPAQUE, MASK or BLEND, got 'DITHER'"):
        loaded(tmp_path, {"alphaMode": "DITHER"})


def test_material_faults(tmp_path):
    for base, fault in (
        ({"roughnessFactor": math.inf}, "material 'skin': roughness: expected finite"),
        (
            {"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [1]}}}},
            "expected two numbers",
        ),
        ({"metallicRoughnessTexture": {"index": 1}}, "expected one of its 1 textures by number, got 1"),
    ):
        with pytest.raises(ValueError, match=rf"a\.glb: .*{fault}"):
            loaded(tmp_path, {"name": "skin", "pbrMetallicRoughness": base}, [TEXELS])
    path = file(tmp_path, {"normalTexture": {"index": 0}}, [TEXELS])
    path.write_bytes(changed(lambda tree: tree["images"][0].update(bufferView=0, name="bark"), path.read_bytes()))
    with pytest.raises(ValueError, match=r"a\.glb.*image in the texture 'bark', got none"):
        eg.load_scene(path, lit=True)


def test_unsupported_features_are_named_once(tmp_path):
    given = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "occlusionTexture": {"index": 0},
        "normalTexture": {"index": 0},
        "extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0}, "KHR_materials_ior": {"ior": 1.3}},
        "alphaMode": "MASK",
    }
    tangents = np.array([[1, 0, 0, 1]] * 4, "<f4")
    path = file(
        tmp_path, given, [TEXELS], attributes={"TANGENT": tangents},
        nodes=[{"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}, {"mesh": 0}],
        lights=[{"type": "point", "range": 3.0}], extensionsUsed=["KHR_lights_punctual", "KHR_materials_variants"],
        animations=[{}], skins=[{}], primitive={"targets": [{}]},
    )  # fmt: skip
    with pytest.warns(UserWarning) as said:
        eg.load_scene(path, lit=True)
    (warning,) = said
    assert warning.filename == __file__
    text = str(warning.message)
    for name in ("KHR_materials_clearcoat", "KHR_materials_ior", "KHR_materials_variants", "occlusionTexture", "TANGENT",
                 "range of lights", "animations", "skins", "morph targets"):  # fmt: skip
        assert text.count(name) == 1, (name, text)
    assert "KHR_lights_punctual" not in text and text.startswith(f"{path}: not rendered as the file asks: ")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("default")
        for _ in range(3):
            eg.load_scene(path, lit=True)
        assert len(said) == 1
        eg.load_scene(path)  # which asks for a shape alone
        assert len(said) == 2 and "animations" in str(said[1].message) and "clearcoat" not in str(said[1].message)


def test_meshes_of_one_material_become_one(tmp_path):
    normals = {"NORMAL": np.array([[0, 0, 1]] * 4, "<f4")}
    given = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "normalTexture": {"index": 0, "texCoord": 1}}
    nodes = [{"mesh": 0}, {"mesh": 0, "translation": [2, 0, 0]}]
    path = file(tmp_path, given, [TEXELS], nodes=nodes, attributes=normals, uvs=(CORNERS, CORNERS[[1, 2, 3, 0]]))
    mesh = eg.load_mesh(path, lit=True)
    assert mesh.faces.shape == (4, 3) and mesh.normals.shape == (8, 3)
    assert mesh.material.normal_map.uv_faces.shape == (4, 3)
    first, second = eg.load_scene(path, lit=True).meshes
    assert first.material.base_color.image is second.material.base_color.image

    def another_material(tree):
        tree["materials"].append({"name": "other"})
        tree["meshes"].append({"primitives": [{**tree["meshes"][0]["primitives"][0], "material": 1}]})
        tree["nodes"][1]["mesh"] = 1

    path.write_bytes(changed(another_material, path.read_bytes()))
    with pytest.raises(ValueError, match=r"got 2 parts .* with different materials or normals; use load_scene"):
        eg.load_mesh(path, lit=True)
