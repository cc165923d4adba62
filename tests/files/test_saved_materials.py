"""save_mesh() writes a GLB from which load_scene(lit=True) reads the same numbers and pictures; the rest is named."""

import warnings

import pytest
import torch
from boxes import APPEARANCES, FACES, OWN, UV_FACES, UVS, VERTS, box, color, data, random, schema
from lit_gltf import file

import edgegrad as eg
from edgegrad.files.formats import gltf


def seen(mesh, **options):
    lights = [eg.lights.PointLight((2.0, 3.0, 4.0), 20.0), eg.lights.Environment(torch.tensor([0.3, 0.4, 0.5]))]
    camera = eg.Camera.look_at((3, 2, 4), (0, 0, 0), size=(48, 48))
    return eg.render(eg.Scene([mesh], torch.tensor([0.1, 0.2, 0.3]), lights=lights), camera, spp=8, seed=1, **options)


def saved(folder, mesh):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.save_mesh(folder / "a.glb", mesh)
        (found,) = eg.load_scene(folder / "a.glb", lit=True).meshes
    return found


def close(found, given):
    """Check that numbers, or textures with their coordinates, are close."""
    if not isinstance(given, eg.Texture):
        torch.testing.assert_close(torch.as_tensor(found).double(), torch.as_tensor(given).double())
        return
    torch.testing.assert_close(found.image, given.image, rtol=0, atol=1e-6)
    close(1.0 if found.factor is None else found.factor, 1.0 if given.factor is None else given.factor)
    assert found.wraps == given.wraps and found.filter == given.filter
    if given.uvs is not None:
        torch.testing.assert_close(found.uvs[found.uv_faces], given.uvs[given.uv_faces])


FACTOR = torch.tensor([0.5, 0.75, 1.0])
MATERIALS = {
    "matt": eg.Material(FACTOR),
    "plain": eg.Material(0.7, metallic=0.25, roughness=0.4),
    "one side": eg.Material(FACTOR, roughness=0.3, two_sided=False),
    "emission": eg.Material(0.5, emission=torch.tensor([4.0, 2.0, 0.0])),
    "base texture": eg.Material(
        eg.Texture(color(), wrap=("clamp", "mirror"), filter="mipmap", factor=FACTOR), metallic=1.0, roughness=0.5
    ),
    "metallic and roughness": eg.Material(
        FACTOR, eg.Texture(data(1), factor=0.5, wrap="mirror"), eg.Texture(data(1), wrap="mirror")
    ),
    "nearest roughness": eg.Material(
        eg.Texture(color()), 0.0, eg.Texture(data(1, least=50), filter="nearest", factor=0.5, **OWN)
    ),
    "emission texture": eg.Material(0.5, emission=eg.Texture(color(), factor=8.0 * FACTOR, **OWN)),
    "bright emission texture": eg.Material(0.5, emission=eg.Texture(color(h=3, w=5))),
    "normal map": eg.Material(
        0.5, 1.0, 0.3, normal_map=eg.Texture(data(least=128), wrap="clamp", **OWN), normal_scale=0.5
    ),
}


@pytest.mark.parametrize("name", MATERIALS)
def test_materials_come_back(name, tmp_path):
    mesh = box(MATERIALS[name], normals=eg.Mesh(VERTS, FACES).vertex_normals())
    found = saved(tmp_path, mesh)
    assert found.material.two_sided == mesh.material.two_sided
    for field in ("base_color", "metallic", "roughness", "emission", "normal_map", "normal_scale"):
        given, read = getattr(mesh.material, field), getattr(found.material, field)
        if given is None:
            assert read is None or (field == "metallic" and read == 0)  # a glTF has both, or neither
        elif isinstance(given, eg.Texture):
            close(read, given)
        elif isinstance(read, eg.Texture):
            close(read.factor * read.image, given.expand(read.image.shape))  # another channel of the same image
        else:
            close(read, given.expand(read.shape))
    torch.testing.assert_close(found.uvs[found.uv_faces], UVS[UV_FACES])
    torch.testing.assert_close(seen(found), seen(mesh), rtol=1e-4, atol=1e-5)
    other = seen(mesh.replace(material=eg.Material(0.2, 0.5, 0.9)))
    assert float((seen(mesh) - other).abs().max()) > 0.05  # the pictures show


BASES = {
    "none": None,
    "factor": FACTOR,
    "vertices": torch.rand(8, 3, generator=random),
    "texture": eg.Texture(color(h=5), **OWN),
}
PAIRS = [
    (name, base)
    for name in APPEARANCES
    for base in BASES
    if (name, base) not in (("grey", "none"), ("texture", "texture"))  # lights have colours; a glTF has one texture
    and not (base == "vertices" and name in ("colours", "grey", "colours of faces", "colours of corners"))
]


@pytest.mark.parametrize(("name", "base"), PAIRS)
def test_appearances_come_back(name, base, tmp_path):
    mesh = box(eg.Material(BASES[base], roughness=0.6), **APPEARANCES[name])
    found = saved(tmp_path, mesh)
    torch.testing.assert_close(seen(found), seen(mesh), rtol=1e-4, atol=1e-5)
    assert found.name == ("crate" if name == "name" else "geometry_0")


ALPHAS = {
    "cut out": ({"alpha": data(1)[..., 0], "alpha_cutoff": 0.7}, {}),
    "cut out of a texture": ({"alpha": data(1)[..., 0], "texture": color(), "filter": "nearest"}, {}),
    "cut out of a material": ({"alpha": data(1)[..., 0]}, {"base_color": eg.Texture(color(), filter="mipmap")}),
    "seen through": ({"alpha": data(1)[..., 0]}, {"alpha_mode": "BLEND"}),
    "seen through, with colours": ({"alpha": data(1)[..., 0], **APPEARANCES["colours"]}, {"alpha_mode": "BLEND"}),
    "evenly seen through": ({"alpha": torch.full((1, 1), 0.3)}, {"alpha_mode": "BLEND"}),
}


@pytest.mark.parametrize("name", ALPHAS)
def test_alpha_comes_back(name, tmp_path):
    look, more = ALPHAS[name]
    mesh = box(eg.Material(**more), **look)
    found = saved(tmp_path, mesh)
    torch.testing.assert_close(found.alpha, mesh.alpha, rtol=0, atol=1e-6)
    assert found.material.alpha_mode == mesh.material.alpha_mode
    if mesh.material.alpha_mode == "MASK":
        assert found.alpha_cutoff == mesh.alpha_cutoff
    torch.testing.assert_close(seen(found), seen(mesh), rtol=1e-4, atol=1e-5)
    assert float((seen(mesh) - seen(mesh.replace(alpha=None))).abs().mean()) > 0.005


def test_an_alpha_mask_that_is_not_lit(tmp_path):
    mesh = box(alpha=data(1)[..., 0], texture=color(), wrap="clamp")
    eg.save_mesh(tmp_path / "a.glb", mesh)
    camera = eg.Camera.look_at((3, 2, 4), (0, 0, 0), size=(48, 48))
    found = eg.render(eg.load_mesh(tmp_path / "a.glb"), camera, spp=8, seed=0)
    torch.testing.assert_close(found, eg.render(mesh, camera, spp=8, seed=0), rtol=1e-4, atol=1e-5)


TEXTURE = eg.Texture(color())


@pytest.mark.parametrize(
    ("material", "look", "message"),
    [
        ({"metallic": torch.rand(8, 1)}, {}, r"no material\.metallic of vertices"),
        ({"roughness": torch.rand(8, 1)}, {}, r"no material\.roughness of vertices"),
        ({"emission": torch.rand(8, 3)}, {}, r"no material\.emission of vertices"),
        ({"emission": -FACTOR}, {}, r"no material\.emission below 0"),
        ({"base_color": 2.0 * FACTOR}, {}, r"no material\.base_color beyond 0 … 1"),
        ({"base_color": TEXTURE.replace(factor=3.0)}, {}, r"no material\.base_color beyond 0 … 1"),
        ({"base_color": TEXTURE}, {"texture": color()}, r"no material\.base_color beside a texture"),
        ({"base_color": torch.rand(8, 3)}, APPEARANCES["colours"], r"no material\.base_color of vertices beside colors"),
        ({"metallic": 1.5}, {}, r"no material\.metallic beyond 0 … 1"),
        ({"roughness": eg.Texture(3.0 * data(1))}, {}, r"no material\.roughness beyond 0 … 1"),
        ({"metallic": eg.Texture(data(1)), "roughness": eg.Texture(data(1), wrap="clamp")}, {},
         r"no material\.metallic that lies otherwise than material\.roughness"),
        ({"metallic": eg.Texture(data(1)), "roughness": eg.Texture(data(1), **OWN)}, {},
         r"no material\.metallic that lies otherwise than material\.roughness"),
        ({"normal_map": eg.Texture(2.0 * data())}, {}, r"no material\.normal_map beyond 0 … 1"),
        ({}, {"normals": torch.rand(8, 3)}, r"no normals of other lengths than 1"),
        ({}, {"colors": torch.full((8, 3), 2.0)}, r"no colors beyond 0 … 1"),
        ({}, {"texture": color() - 0.5}, r"no texture beyond 0 … 1"),
        ({}, {"alpha": 2.0 * data(1)[..., 0]}, r"no alpha beyond 0 … 1"),
        ({}, {"alpha": data(1)[..., 0], "texture": color(h=5)}, r"no alpha that lies otherwise than the base colour's"),
        (None, {"alpha": data(1)[..., 0], **APPEARANCES["colours"]}, r"no alpha beside colours of vertices"),
    ],
)  # fmt: skip
def test_what_gltf_does_not_hold_is_named(material, look, message, tmp_path):
    mesh = box(None if material is None else eg.Material(**material), **look)
    with pytest.warns(UserWarning, match=rf"save_mesh: a\.glb holds {message}.*; torch\.save") as said:
        eg.save_mesh(tmp_path / "a.glb", mesh)
    assert len(said) == 1
    assert eg.load_scene(tmp_path / "a.glb", lit=True).meshes[0].material is not None  # the rest is there


def test_mipmaps_of_a_lit_texture_come_back(tmp_path):
    mesh = box(eg.Material(), texture=color(), filter="mipmap")
    assert saved(tmp_path, mesh).material.base_color.filter == "mipmap"
    for name, save in (("save_mesh", eg.save_mesh), ("save_scene", eg.save_scene)):
        with pytest.warns(UserWarning, match=rf"{name}: a\.glb holds no filter 'mipmap' without a material"):
            save(tmp_path / "a.glb", mesh.replace(material=None))


def test_means_stand_for_numbers_of_vertices(tmp_path):
    rough = torch.tensor([0.2, 0.4] * 4)[:, None]
    with pytest.warns(UserWarning, match="of vertices"):
        eg.save_mesh(tmp_path / "a.glb", box(eg.Material(metallic=eg.Texture(data(1)), roughness=rough)))
    material = eg.load_scene(tmp_path / "a.glb", lit=True).meshes[0].material
    assert float(material.roughness.factor) == pytest.approx(0.3) and isinstance(material.metallic, eg.Texture)


def test_what_is_matt(tmp_path):
    """KHR_materials_specular is read where it says that there is no highlight at all."""
    for change, kept in (({}, True), ({"specularFactor": 0.5}, False), ({"metallicFactor": 0.5}, False)):
        specular = {"specularFactor": 0.0} | {k: v for k, v in change.items() if k == "specularFactor"}
        base = {"baseColorFactor": [0.5, 0.75, 1.0, 1.0], "metallicFactor": change.get("metallicFactor", 0.0)}
        path = file(tmp_path, {"pbrMetallicRoughness": base, "extensions": {"KHR_materials_specular": specular}},
                    extensionsUsed=["KHR_materials_specular"])  # fmt: skip
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            material = eg.load_scene(path, lit=True).meshes[0].material
        assert (material.metallic is None and material.roughness is None) == kept
        assert [str(w.message).endswith("KHR_materials_specular (left out)") for w in said] == ([] if kept else [True])


def test_the_file_is_a_gltf(tmp_path):
    names = (*MATERIALS, *ALPHAS)
    for name in names:
        look, more = ALPHAS.get(name, ({}, {}))
        eg.save_mesh(tmp_path / "a.glb", box(MATERIALS.get(name) or eg.Material(**more), **look))
        tree = gltf.read((tmp_path / "a.glb").read_bytes(), "glb").tree
        schema().validate(tree)
        used = {extension for material in tree["materials"] for extension in material.get("extensions", {})}
        assert set(tree.get("extensionsUsed", [])) == used
