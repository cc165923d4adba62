"""Data of glTF files in the forms that hold it, and what a file holds that nobody reads."""

import json
import warnings

import numpy as np
import pytest
from lit_gltf import CORNERS, TURN, file
from mesh_files import SQUARE, TEXELS, TRIANGLES, changed, glb, square_glb

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

DRACO = "KHR_draco_mesh_compression"
PLAIN = {"scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}]}


def corners(mesh):
    return mesh.verts[mesh.faces].tolist()


EXPECTED = np.array(SQUARE, float)[np.array(TRIANGLES)].tolist()


def save(folder, content, name="a.glb"):
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder / name


# -- data ---------------------------------------------------------------------------------------------------------------


def draco(colors):
    pytest.importorskip("DracoPy")
    import DracoPy

    vertices = np.array(SQUARE, "<f4")
    return DracoPy.encode(
        vertices, np.array(TRIANGLES, "<u4"), colors=colors, preserve_order=True, quantization_bits=16
    )


def compressed(blob, count=4, required=True, **changes):
    """Return a GLB whose square lies in a Draco blob alone, with colours."""
    listed = {"extensionsUsed": [DRACO], **({"extensionsRequired": [DRACO]} if required else {})}
    given = {"bufferView": 0, "attributes": {"POSITION": 1, "COLOR_0": 0}} | changes
    accessors = [
        {"componentType": 5126, "count": count, "type": "VEC3"},
        {"componentType": 5121, "count": count, "type": "VEC3", "normalized": True},
        {"componentType": 5125, "count": 6, "type": "SCALAR"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "extensions": {DRACO: given}}
    return glb({**PLAIN, **listed, "meshes": [{"primitives": [primitive]}], "accessors": accessors}, blob)


@pytest.mark.parametrize("required", [True, False])
def test_draco(tmp_path, required):
    colors = np.array([[0, 51, 102], [255, 0, 0], [0, 255, 0], [153, 204, 255]], "u1")
    mesh = eg.load_mesh(save(tmp_path, compressed(draco(colors), required=required)))
    np.testing.assert_allclose(corners(mesh), EXPECTED, atol=1e-4)
    np.testing.assert_allclose(mesh.colors[mesh.faces], (colors / 255.0)[np.array(TRIANGLES)], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"count": 5}, r"expected POSITION of shape \(5, 3\) in KHR_draco_mesh_compression, got \(4, 3\)"),
        ({"attributes": {"POSITION": 7, "COLOR_0": 0}}, r"expected POSITION of shape \(4, 3\) in KHR_.*, got \(0,\)"),
        ({"bufferView": 3}, "expected one of its 1 bufferViews by number, got 3"),
    ],
)
def test_draco_faults(tmp_path, change, fault):
    with pytest.raises(ValueError, match=rf"a\.glb: part 'mesh 0': {fault}"):
        eg.load_mesh(save(tmp_path, compressed(draco(np.zeros((4, 3), "u1")), **change)))


def test_draco_that_is_damaged_is_refused(tmp_path):
    whole, random = draco(np.zeros((4, 3), "u1")), np.random.default_rng(0)
    refused = 0
    for _ in range(100):
        malformed = bytearray(whole)
        for at in random.integers(len(malformed), size=3):
            malformed[at] = random.integers(256)
        try:
            eg.load_mesh(save(tmp_path, compressed(bytes(malformed))))
        except ValueError as error:
            refused += str(error).startswith(str(tmp_path))
    assert refused > 20


def test_draco_without_its_decoder_names_the_extra(tmp_path, monkeypatch):
    path = save(tmp_path, compressed(b"DRACO"))
    monkeypatch.setitem(__import__("sys").modules, "DracoPy", None)
    with pytest.raises(ImportError, match=rf"reading glTF with {DRACO} needs edgegrad\[files\]; install it with"):
        eg.load_mesh(path)


def without_data(tree):
    del tree["accessors"][0]["bufferView"]


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda tree: (without_data(tree), tree.update(extensionsUsed=[DRACO])), rf"in the extension {DRACO} alone"),
        (
            lambda tree: (without_data(tree), tree["meshes"][0]["primitives"][0].update(extensions={"ACME_zip": {}})),
            "in the extension ACME_zip alone",
        ),
        (
            lambda tree: (without_data(tree), tree["accessors"][0].update(extensions={"ACME_zip": {}})),
            "in the extension ACME_zip alone",
        ),
        (
            lambda tree: (
                tree["buffers"].append({"byteLength": 99, "extensions": {"EXT_meshopt_compression": {"fallback": True}}}),
                tree["bufferViews"][0].update(buffer=1, extensions={"EXT_meshopt_compression": {"buffer": 0}}),
            ),
            "expected the data of buffer 1, got it in the extension EXT_meshopt_compression, which is not read",
        ),
        (lambda tree: tree["bufferViews"][0].update(buffer=1), "expected one of its 1 buffers by number, got 1"),
        (lambda tree: tree["accessors"][0].update(componentType=5122), "expected POSITION as floats, got integers"),
    ],
)  # fmt: skip
def test_data_that_is_not_there_is_named(tmp_path, change, fault):
    with pytest.raises(ValueError, match=rf"a\.glb: part 'mesh 0': .*{fault}"):
        eg.load_mesh(save(tmp_path, changed(change)))


def test_meshopt_with_a_fallback_is_read(tmp_path):
    def change(tree):
        tree["bufferViews"][0]["extensions"] = {"EXT_meshopt_compression": {"buffer": 0}}
        tree["extensionsUsed"] = ["EXT_meshopt_compression"]

    assert corners(eg.load_mesh(save(tmp_path, changed(change)))) == EXPECTED


def test_zeros_and_what_lies_sparsely_on_them(tmp_path):
    """Without a view all values are zero, as the format says. Rows are then given one by one."""
    where, values = np.array([1, 2, 3], "u1"), np.array(SQUARE[1:], "<f4")
    sparse = {"count": 3, "indices": {"bufferView": 0, "componentType": 5121}, "values": {"bufferView": 1}}
    faces = np.array(TRIANGLES, "u1").reshape(-1)
    accessors = [
        {"componentType": 5126, "count": 4, "type": "VEC3", "sparse": sparse},
        {"bufferView": 2, "componentType": 5121, "count": 6, "type": "SCALAR"},
        {"componentType": 5126, "count": 4, "type": "VEC3"},
    ]
    primitive = {"attributes": {"POSITION": 0, "COLOR_0": 2}, "indices": 1}
    tree = {**PLAIN, "meshes": [{"primitives": [primitive]}], "accessors": accessors}
    mesh = eg.load_mesh(save(tmp_path, glb(tree, where.tobytes(), values.tobytes(), faces.tobytes())))
    assert corners(mesh) == EXPECTED and mesh.colors.tolist() == [[0, 0, 0]] * 4


# -- versions -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "name", "version"),
    [
        (json.dumps({"asset": {"version": "1.0"}, "meshes": {"a": {}}}), "a.gltf", "1.0"),
        (json.dumps({"meshes": {"a": {}}}), "a.gltf", "1.0"),
        (b"glTF" + b"\1\0\0\0" + bytes(20), "a.glb", "1.0"),
        (changed(lambda tree: tree["asset"].update(version="1.1")), "a.glb", "1.1"),
    ],
)
def test_version_1_is_named(tmp_path, content, name, version):
    with pytest.raises(ValueError, match=rf"{name}: expected glTF 2\.0, got version {version}, .*gltf-pipeline"):
        eg.load_scene(save(tmp_path, content, name))


def test_later_versions(tmp_path):
    later = changed(lambda tree: tree["asset"].update(version="2.1", minVersion="2.0"))
    assert corners(eg.load_mesh(save(tmp_path, later))) == EXPECTED
    with pytest.raises(ValueError, match=r"expected glTF 2\.0, got version '2\.1'"):
        eg.load_mesh(save(tmp_path, changed(lambda tree: tree["asset"].update(version="2.1"))))


# -- nodes --------------------------------------------------------------------------------------------------------------


def test_invisible_nodes_are_not_there(tmp_path):
    """Nodes below an invisible one are not there either, but their cameras are."""
    hidden = {"KHR_node_visibility": {"visible": False}}
    light = {"KHR_lights_punctual": {"light": 0}}
    nodes = [
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}}},
        {"mesh": 0, "translation": [5, 0, 0], "extensions": hidden, "children": [2, 3]},
        {"mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}}},
        {"camera": 0, "rotation": TURN, "extensions": light},
        {"extensions": {**hidden, **light}},
        {"extensions": light, "translation": [0, 0, 9]},
    ]
    cameras = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}]
    listed = {"extensionsUsed": ["KHR_node_visibility"], "extensionsRequired": ["KHR_node_visibility"]}
    path = file(tmp_path, nodes=nodes, roots=[0, 1, 4, 5], lights=[{"type": "point"}], cameras=cameras, **listed)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = eg.load_scene(path, lit=True)
    assert [corners(mesh) for mesh in scene.meshes] == [EXPECTED]
    assert [light.position.tolist() for light in scene.lights] == [[0, 0, 9]]
    assert eg.load_camera(path, size=(8, 8)).eye[0] == 5
    malformed = changed(
        lambda tree: tree["nodes"][0]["extensions"].update(KHR_node_visibility={"visible": 0}), path.read_bytes()
    )
    with pytest.raises(ValueError, match=r"true or false for visible of KHR_node_visibility, got 0"):
        eg.load_scene(save(tmp_path, malformed))


def test_a_file_without_scenes_shows_all_its_nodes(tmp_path):
    def change(tree):
        del tree["scenes"], tree["scene"]
        tree["nodes"] = [{"mesh": 0, "translation": [0, 0, 1]}, {"children": [0]}]

    assert eg.load_mesh(save(tmp_path, changed(change))).verts[:, 2].tolist() == [1] * 4


@pytest.mark.parametrize(
    ("cone", "shown"),
    [
        ((0.5, 0.5), (np.arccos(np.cos(0.5) + 1e-3), 0.5)),
        ((0.7, 0.5), (np.arccos(np.cos(0.5) + 1e-3), 0.5)),
        ((0.1, 2.0), (0.1, np.pi / 2)),
        ((-0.1, 0.5), (0.0, 0.5)),
        ((0.02, 0.02), (0.0, 0.02)),
    ],
)
def test_cones_that_are_none_are_clamped(tmp_path, cone, shown):
    """Their cosines differ by 0.001 at least, as in the formula of KHR_lights_punctual, and angles are right ones at
    most."""
    angles = dict(zip(("innerConeAngle", "outerConeAngle"), cone, strict=True))
    node = {"mesh": 0, "extensions": {"KHR_lights_punctual": {"light": 0}}}
    path = file(tmp_path, nodes=[node], lights=[{"type": "spot", "name": "emitter", "spot": angles}])
    with pytest.warns(
        UserWarning, match=rf"spot light 'emitter' with innerConeAngle {cone[0]:g} and outerConeAngle {cone[1]:g}"
    ):
        (light,) = eg.load_scene(path, lit=True).lights
    np.testing.assert_allclose((float(light.inner_angle), float(light.outer_angle)), shown, rtol=1e-6)


# -- images -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("texture", "image", "fault"),
    [
        ({}, {}, "a source, which is an image, in the texture '1', got none"),
        ({"extensions": {"KHR_texture_basisu": {"source": 1}}}, {}, "got none but in the extension KHR_texture_basisu"),
        ({"source": 7}, {}, "one of its 2 images by number, got 7"),
        ({"source": 1}, {"uri": "gone.png"}, "names 'gone.png'"),
        ({"source": 1}, {"bufferView": 0}, "an image in the texture 'image 1', got none"),
        ({"source": 1}, {"bufferView": 0, "name": "bark"}, "an image in the texture 'bark', got none"),
        ({"source": 1}, {"uri": "data:image/png;base64,AAAA"}, "an image in the texture 'image 1', got none"),
        ({"source": 1}, {}, "an image in the texture 'image 1', got none"),
    ],
)
def test_a_lost_image_is_blamed_itself(tmp_path, texture, image, fault):
    """The first of two images is whole."""
    given = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}, "emissiveTexture": {"index": 1}}
    path = file(tmp_path, given | {"emissiveFactor": [1, 1, 1]}, [TEXELS, TEXELS])

    def change(tree):
        tree["textures"][1], tree["images"][1] = texture, image

    path.write_bytes(changed(change, path.read_bytes()))
    with pytest.raises((ValueError, FileNotFoundError), match=rf"a\.glb.*{fault}"):
        eg.load_scene(path, lit=True)
    assert eg.load_scene(path).meshes[0].texture is not None


# -- what nobody reads --------------------------------------------------------------------------------------------------


def attribute(name, array):
    return lambda tree: tree["meshes"][0]["primitives"][0]["attributes"].update({name: array})


def extended(kind):
    """Return a change that extends the first entry of a list, which is made where there is none."""

    def change(tree):
        tree[kind] = tree.get(kind) or [{}]
        tree[kind][0].setdefault("extensions", {})["ACME_new"] = {}

    return change


@pytest.mark.parametrize(
    ("change", "said", "also_unlit"),
    [
        *((extended(kind), "ACME_new", True) for kind in (
            "nodes", "materials", "textures", "images", "samplers", "meshes", "accessors", "bufferViews", "buffers", "scenes"
        )),
        (lambda tree: tree["meshes"][0]["primitives"][0].update(extensions={"ACME_new": {}}), "ACME_new", True),
        (lambda tree: tree.update(extensions={"ACME_new": {}}), "ACME_new", True),
        (lambda tree: tree.update(extensionsUsed=["ACME_new"]), "ACME_new", True),
        (
            lambda tree: tree.update(extensions={"KHR_lights_punctual": {"lights": [{"extensions": {"ACME_new": {}}}]}}),
            "ACME_new",
            True,
        ),
        (lambda tree: tree["materials"][0].update(shininess=3), "'shininess' of materials", True),
        (lambda tree: tree["materials"][0]["pbrMetallicRoughness"].update(gloss=3), "'gloss' of pbrMetallicRoughness", True),
        (lambda tree: tree.update(camera={}), "'camera' of the file", True),
        (attribute("_FEATURE", 0), "attribute _FEATURE", True),
        (attribute("COLOR_1", 0), "attribute COLOR_1", True),
        (attribute("TEXCOORD_1", 2), "attribute TEXCOORD_1", True),
        (lambda tree: tree["materials"][0]["extensions"].update(KHR_materials_sheen={}), "KHR_materials_sheen", False),
        (
            lambda tree: tree["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1}),
            "points and lines",
            True,
        ),
    ],
)  # fmt: skip
def test_one_unread_thing_is_named(tmp_path, change, said, also_unlit):
    path = file(tmp_path, {"pbrMetallicRoughness": {}, "extensions": {}}, uvs=(CORNERS,), samplers=[{}])
    path.write_bytes(changed(change, path.read_bytes()))
    for lit in (True, False):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            eg.load_scene(path, lit=lit)
        expected = [f"{path}: not rendered as the file asks: {said} (left out)"] if lit or also_unlit else []
        assert [str(warning.message) for warning in caught] == expected


def test_what_changes_no_picture_is_not_named(tmp_path):
    """The file has extras, all that the format itself has, weights, further texture coordinates, and copies in other
    formats."""
    normal = {"index": 0, "texCoord": 1, "extras": {"a": 1}}
    given = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "normalTexture": normal,
        "extras": [1],
        "name": "a",
    }
    path = file(
        tmp_path, given, [TEXELS], uvs=(CORNERS, CORNERS), extensionsUsed=["KHR_xmp_json_ld", "KHR_texture_basisu"],
        attributes={"JOINTS_0": np.zeros((4, 4), "u1"), "WEIGHTS_0": np.ones((4, 4), "<f4")}, extras={"b": {"c": 2}},
    )  # fmt: skip

    def change(tree):
        tree["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": 9}}
        tree["asset"] |= {"generator": "a", "copyright": "b", "minVersion": "2.0", "extras": {}}
        tree["accessors"][0] |= {"min": [0, 0, 0], "max": [1, 1, 0], "name": "x"}
        tree["bufferViews"][0] |= {"target": 34962, "name": "y"}

    path.write_bytes(changed(change, path.read_bytes()))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for lit in (True, False):
            eg.load_scene(path, lit=lit)


def test_unknown_extensions_that_a_file_requires(tmp_path):
    with pytest.raises(ValueError, match=r"a\.glb: expected plain glTF 2\.0, got one that needs ACME_new; export"):
        eg.load_scene(save(tmp_path, square_glb(extensionsRequired=["ACME_new", "KHR_materials_unlit"])))
