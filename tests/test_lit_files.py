"""Materials, normals and lights from files, which are made here and compared number by number with what the formats say."""

import io
import math
import warnings

import numpy as np
import pytest
import torch
from PIL import Image
from test_bad_files import changed
from test_io import SQUARE, TEXELS, TRIANGLES, glb, linear, ply, write_obj

import edgegrad as eg
from edgegrad.scene.appearance import OnMesh

IMAGE = np.random.default_rng(3).integers(0, 256, (16, 16, 3), dtype=np.uint8)
CORNERS = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], "<f4")  # texture coordinates of SQUARE, v running down
TILTED = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0]], "<f4")


def png(texels, kind="PNG"):
    stream = io.BytesIO()
    Image.fromarray(np.asarray(texels, np.uint8)).save(stream, kind)
    return stream.getvalue()


def file(folder, material=None, images=(), positions=SQUARE, nodes=None, uvs=(CORNERS,), **more):
    """A GLB file of one square: images are texels, one texture each; `attributes`, `samplers` and `lights` are the format's."""
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
    """What the square looks like from the front, row 0 on top; where it emits, and nothing else lights it, its emission."""
    camera = eg.Camera.look_at([0.5, 0.5, 100.0], [0.5, 0.5, 0.0], size=(size, size), fov_y=math.degrees(0.01))
    return eg.render(eg.Scene([mesh]), camera, spp=16).detach().numpy()


# -- glTF: materials --------------------------------------------------------------------------------------------------


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
    with pytest.raises(ValueError, match=r"a\.glb.*incorrect alphaMode.*'DITHER'"):
        loaded(tmp_path, {"alphaMode": "DITHER"})


# -- glTF: normals and lights -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [[2, 1, 1], [-1, 1, 0.5], [3, 0.2, -2]])
def test_normals_follow_their_nodes(tmp_path, scale):
    """A plane's normals stay those of the plane, also where it is stretched and mirrored."""
    normals = {"NORMAL": np.array([[-(2**-0.5), 0, 2**-0.5]] * 4, "<f4")}
    node = {"mesh": 0, "scale": scale, "rotation": [0.5, 0.5, 0.5, 0.5], "translation": [1, 2, 3]}
    mesh = loaded(tmp_path, {}, positions=TILTED, nodes=[node], attributes=normals)
    assert mesh.normal_faces is None
    np.testing.assert_allclose(mesh.normals, eg.vertex_normals(mesh.verts, mesh.faces), atol=1e-6)


def test_normals_that_differ_at_a_vertex(tmp_path):
    """Two triangles that share an edge, with vertices and normals of their own: positions are welded, normals are not."""
    corners = np.array(SQUARE, "<f4")[np.array(TRIANGLES).reshape(-1)]
    normals = np.array([[0, 0, 1]] * 3 + [[0, 0.6, 0.8]] * 3, "<f4")
    tree = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "NORMAL": 1}}]}]}  # fmt: skip
    (tmp_path / "n.glb").write_bytes(glb(tree, corners, normals))
    mesh = eg.load_mesh(tmp_path / "n.glb", lit=True)
    assert mesh.verts.shape == (4, 3) and mesh.normals.shape == (2, 3)
    np.testing.assert_allclose(mesh.normals[mesh.normal_faces].reshape(-1, 3), normals)
    (tmp_path / "n.glb").write_bytes(glb(tree, corners, normals[:5]))
    with pytest.raises(
        ValueError, match=r"n\.glb.*expected a finite normal for each of 6 vertices, got shape \(5, 3\)"
    ):
        eg.load_mesh(tmp_path / "n.glb", lit=True)
    assert eg.load_mesh(tmp_path / "n.glb").normals is None


TURN = [0.0, 2**-0.5, 0.0, 2**-0.5]  # a quarter turn about y, as (x, y, z, w): −z points to −x


def test_lights_stand_where_their_nodes_do(tmp_path):
    def at(light, **node):
        return {"extensions": {"KHR_lights_punctual": {"light": light}}, **node}

    nodes = [
        {"mesh": 0, "translation": [10, 0, 0], "rotation": TURN, "children": [1, 2]},
        at(0, translation=[0, 0, -1], scale=[3, 3, 3]),
        at(1, rotation=TURN),
        at(2, matrix=[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 2, 0, 5, 6, 7, 1]),
        at(0),
    ]
    lights = [
        {"type": "point", "intensity": 5.0, "color": [1.0, 0.5, 0.25]},
        {"type": "directional"},
        {"type": "spot", "intensity": 2.0, "spot": {"innerConeAngle": 0.1, "outerConeAngle": 0.6}},
    ]
    scene = eg.load_scene(file(tmp_path, nodes=nodes, roots=[0, 3, 4], lights=lights), lit=True)
    point, sun, spot, second = scene.lights
    assert isinstance(point, eg.PointLight) and isinstance(sun, eg.DirectionalLight) and isinstance(spot, eg.SpotLight)
    np.testing.assert_allclose(point.position, [9, 0, 0], atol=1e-6)
    assert float(point.intensity) == 5.0 and point.color.tolist() == [1.0, 0.5, 0.25]
    np.testing.assert_allclose(sun.direction, [0, 0, 1], atol=1e-6)
    assert float(sun.intensity) == 1.0 and sun.color.tolist() == [1, 1, 1]
    np.testing.assert_allclose(spot.position, [5, 6, 7])
    np.testing.assert_allclose(spot.direction / spot.direction.norm(), [0, 0, -1], atol=1e-6)
    assert (float(spot.inner_angle), float(spot.outer_angle), float(spot.intensity)) == (0.1, 0.6, 2.0)
    assert second.position.tolist() == [0, 0, 0]
    lights[2].pop("spot")
    spot = eg.load_scene(file(tmp_path, nodes=nodes, roots=[0, 3, 4], lights=lights), lit=True).lights[2]
    assert (float(spot.inner_angle), float(spot.outer_angle)) == (0.0, pytest.approx(math.pi / 4))


@pytest.mark.parametrize(
    ("light", "fault"),
    [
        ({"type": "area", "name": "panel"}, "expected a light of type directional, point or spot, got 'area'"),
        ({"type": "spot", "name": "lamp", "spot": {"outerConeAngle": 2.0}}, "light 'lamp': inner_angle: expected 0 ≤"),
        ({"type": "point", "intensity": math.nan}, "light '0': intensity"),
        ({"type": "point", "color": "red"}, "light '0': "),
    ],
)
def test_light_faults(tmp_path, light, fault):
    path = file(tmp_path, nodes=[{"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}], lights=[light])
    with pytest.raises(ValueError, match=rf"a\.glb: .*{fault}"):
        eg.load_scene(path, lit=True)
    eg.load_scene(path)  # which reads none


def test_material_faults(tmp_path):
    for base, fault in (
        ({"roughnessFactor": math.inf}, "material 'skin': roughness: expected finite"),
        (
            {"baseColorTexture": {"index": 0, "extensions": {"KHR_texture_transform": {"scale": [1]}}}},
            "expected two numbers",
        ),
        ({"metallicRoughnessTexture": {"index": 1}}, "expected a whole GLB file"),
    ):
        with pytest.raises(ValueError, match=rf"a\.glb: .*{fault}"):
            loaded(tmp_path, {"name": "skin", "pbrMetallicRoughness": base}, [TEXELS])
    path = file(tmp_path, {"normalTexture": {"index": 0}}, [TEXELS])
    path.write_bytes(changed(lambda tree: tree["images"][0].update(bufferView=0, name="bark"), path.read_bytes()))
    with pytest.raises(ValueError, match=r"a\.glb.*image in the texture 'bark', got none"):
        eg.load_scene(path, lit=True)


def test_what_is_not_supported_is_said_once_by_name(tmp_path):
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


def test_the_transformation_of_a_skinned_node_does_not_count(tmp_path):
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [5, 0, 0], "children": [1]},
        {"mesh": 0, "translation": [0, 0, 1]},
        {"mesh": 0, "skin": 0, "translation": [0, 7, 0]},  # not in the scene
    ]
    joints = [{"joints": [1]}]
    path = file(tmp_path, nodes=nodes, roots=[0], skins=joints, extensionsUsed=["EXT_mesh_gpu_instancing"])
    with pytest.warns(UserWarning, match=r"EXT_mesh_gpu_instancing \(shown once\); skins \(shown in the pose"):
        scene = eg.load_scene(path)
    places = sorted(mesh.verts.mean(0).round().tolist() for mesh in scene.meshes)
    center = torch.as_tensor(SQUARE).float().mean(0)
    expected = sorted((center + torch.tensor(shift)).round().tolist() for shift in ([0.0, 0, 0], [5.0, 0, 1]))
    assert places == expected


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


def test_what_lies_below_a_camera_is_read(tmp_path):
    """trimesh leaves out what a node with a camera holds."""
    cameras = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1, "aspectRatio": 1.0}}]
    nodes = [{"camera": 0, "translation": [0, 0, 5], "children": [1]}, {"mesh": 0}]
    scene = eg.load_scene(file(tmp_path, nodes=nodes, roots=[0], cameras=cameras))
    np.testing.assert_allclose(scene.meshes[0].verts[:, 2], 5.0)


CAMERAS = [
    {"type": "perspective", "perspective": {"yfov": 0.8, "aspectRatio": 3.0, "znear": 0.1}},
    {"type": "orthographic", "orthographic": {"xmag": 1.0, "ymag": 2.0, "znear": 0.1, "zfar": 10.0}},
]


def test_cameras(tmp_path):
    nodes = [
        {"mesh": 0, "scale": [2, 2, 2], "children": [1]},
        {"camera": 0, "translation": [1, 2, 3], "rotation": TURN},
        {"camera": 1, "translation": [0, 0, 5]},
    ]
    path = file(tmp_path, nodes=nodes, roots=[0, 2], cameras=CAMERAS)
    camera = eg.load_camera(path, size=(20, 30))
    expected = eg.Camera.look_at([2.0, 4.0, 6.0], [0.0, 4.0, 6.0], fov_y=math.degrees(0.8), size=(20, 30))
    np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-5)
    np.testing.assert_allclose(camera.K, expected.K, rtol=1e-6)
    flat = eg.load_camera(path, torch.float64, (20, 30), 1)
    expected = eg.Camera.orthographic([0.0, 0.0, 5.0], [0.0, 0.0, 0.0], height=4.0, size=(20, 30))
    assert flat.projection == "orthographic" and flat.K.dtype == torch.float64
    np.testing.assert_allclose(flat.world_to_camera, expected.world_to_camera, atol=1e-6)
    np.testing.assert_allclose(flat.K, expected.K)
    for options, fault in (
        ({}, "size: expected (height, width)"),
        ({"size": (20, 30), "index": 2}, "index: expected that of one of 2 cameras"),
        ({"size": (0, 30)}, "size: expected"),
    ):
        with pytest.raises(ValueError, match=fault.replace("(", "[(]").replace(")", "[)]")) as caught:
            eg.load_camera(path, **options)
        assert str(path) in str(caught.value) or "0, 30" in str(options)
    path.write_bytes(changed(lambda tree: tree["cameras"][0].update(type="pinhole"), path.read_bytes()))
    with pytest.raises(
        ValueError, match=r"a\.glb: expected a camera of type perspective or orthographic, got 'pinhole'"
    ):
        eg.load_camera(path, size=(8, 8))
    eg.save_camera(tmp_path / "c.json", expected)
    with pytest.raises(ValueError, match=r"c\.json: expected neither size nor index"):
        eg.load_camera(tmp_path / "c.json", size=(8, 8))


# -- other formats ----------------------------------------------------------------------------------------------------


def obj_material(folder, text):
    body = f"mtllib quad.mtl\n{''.join(f'v {x} {y} {z}' + chr(10) for x, y, z in SQUARE)}vt 0 0\nvt 1 1\nusemtl skin\n"
    path = write_obj(folder, mtl="newmtl skin\n" + text, body=body + "f 1/1 2/1 3/2\nf 1/1 3/2 4/2\n")
    (mesh,) = eg.load_scene(path, lit=True).meshes
    return mesh


def test_obj_materials(tmp_path):
    mesh = obj_material(tmp_path, "Kd 0.2 0.4 0.6\nKe 1 2 3\nKs 0 0 0\nNs 10\n")
    material = mesh.material
    assert (material.metallic, material.roughness, material.base_color) == (None, None, None) and material.two_sided
    np.testing.assert_allclose(mesh.face_colors, [[0.2, 0.4, 0.6]] * 2, rtol=1e-6)
    assert material.emission.tolist() == [1, 2, 3]
    with pytest.warns(UserWarning, match=r"quad\.obj.*Ks \(a dielectric"):
        material = obj_material(tmp_path, "Kd 1 1 1\nKs 0.5 0.5 0.5\nNs 126\n").material
    assert float(material.roughness) == pytest.approx((2 / 128) ** 0.25) and material.metallic is None
    assert obj_material(tmp_path, "Kd 1 1 1\nKs 1 1 1\nillum 1\n").material.roughness is None
    material = obj_material(tmp_path, "Kd 1 1 1\nKs 1 1 1\nPr 0.3\nPm 1\n").material
    assert (float(material.roughness), float(material.metallic)) == (pytest.approx(0.3), 1.0)
    mesh = obj_material(tmp_path, "map_Kd skin.png\n")
    np.testing.assert_allclose(mesh.texture, linear(TEXELS), atol=1e-6)
    assert mesh.material.emission is None
    with pytest.raises(ValueError, match=r"quad\.obj.*expected numbers for pr in the material"):
        obj_material(tmp_path, "Kd 1 1 1\nPr rough\n")


def test_obj_alpha(tmp_path):
    mask = np.array([[0, 255], [255, 51]], np.uint8)
    Image.fromarray(mask).save(tmp_path / "mask.png")
    np.testing.assert_allclose(obj_material(tmp_path, "Kd 1 1 1\nmap_d mask.png\n").alpha, mask / 255.0, atol=1e-6)
    Image.fromarray(np.stack([mask[::-1]] * 3 + [mask], -1)).save(tmp_path / "mask.png")
    np.testing.assert_allclose(obj_material(tmp_path, "Kd 1 1 1\nmap_d mask.png\n").alpha, mask / 255.0, atol=1e-6)
    for d, gone in ((0.4, True), (0.6, False)):
        with pytest.warns(UserWarning, match=r"quad\.obj: .*: d \(shown where"):
            mesh = obj_material(tmp_path, f"Kd 1 1 1\nKe 1 1 1\nd {d}\n")
        assert (shown(mesh).mean() < 0.01) == gone
    with pytest.raises(FileNotFoundError, match=r"quad\.obj: names 'gone\.png'"):
        obj_material(tmp_path, "Kd 1 1 1\nmap_d gone.png\n")
    with pytest.warns(UserWarning, match=r"Tr \(.*; map_bump \(left out\)|map_bump \(left out\); Tr \("):
        obj_material(tmp_path, "Kd 1 1 1\nTr 1\nmap_Bump bump.png\n")


def test_obj_normals(tmp_path):
    body = (
        "".join(f"v {x} {y} {z}\n" for x, y, z in SQUARE)
        + "vn 0 0 2\nvn 0 0.6 0.8\nf 1//1 2//1 3//1\nf 1//2 3//2 4//2\n"
    )
    (tmp_path / "n.obj").write_text(body)
    mesh = eg.load_mesh(tmp_path / "n.obj", lit=True)
    expected = [[[0, 0, 1]] * 3, [[0, 0.6, 0.8]] * 3]
    np.testing.assert_allclose(mesh.normals[mesh.normal_faces], expected, atol=1e-6)
    assert mesh.material.roughness is None and eg.load_mesh(tmp_path / "n.obj").normals is None


def test_other_formats_are_lambertian(tmp_path):
    (tmp_path / "c.ply").write_bytes(ply(SQUARE, TRIANGLES, vertex_colors=[[255, 0, 0]] * 4))
    mesh = eg.load_mesh(tmp_path / "c.ply", lit=True)
    assert mesh.material.roughness is None and mesh.material.emission is None
    np.testing.assert_allclose(mesh.colors, [[1, 0, 0]] * 4)
    image = torch.rand(2, 2, 3)
    mesh = eg.load_mesh(write_obj(tmp_path), texture=image, lit=True)
    assert mesh.texture is image or torch.equal(mesh.texture, image)
    assert mesh.material is not None and mesh.material.base_color is None


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


def places(tree):
    """Every value of a JSON tree by what holds it and the key."""
    keys = list(tree) if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        yield tree, key
        yield from places(tree[key])


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
