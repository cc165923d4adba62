"""Meshes to and from trimesh, files and notebooks."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from IPython.core.formatters import PNGFormatter
from PIL import Image
from scenes import cube

import edgegrad as eg
from edgegrad import notebook
from edgegrad.preview import framing, under_headlight
from edgegrad.scene.tree import named_tensors

VERTS, FACES = cube().verts.float(), cube().faces
COLORS = torch.rand(8, 3, generator=torch.Generator().manual_seed(0))
APPEARANCES = {
    "plain": {},
    "colors": {"colors": COLORS},
    "grey": {"colors": COLORS[:, :1]},
    "face_colors": {"face_colors": torch.rand(12, 3, generator=torch.Generator().manual_seed(1))},
    "corner_colors": {"corner_colors": torch.rand(12, 3, 3, generator=torch.Generator().manual_seed(2))},
    "texture": {
        "texture": torch.rand(4, 8, 3, generator=torch.Generator().manual_seed(3)),
        "uvs": torch.rand(20, 2, generator=torch.Generator().manual_seed(4)),
        "uv_faces": torch.arange(36).reshape(12, 3) % 20,
    },
}


def close(a: eg.Mesh, b: eg.Mesh, linear: bool = False) -> None:
    """Assert the same faces and appearance, up to the rounding to 8 bit."""
    torch.testing.assert_close(a.verts[a.faces.long()], b.verts[b.faces.long()])

    def shown(mesh: eg.Mesh) -> torch.Tensor | None:
        if mesh.texture is not None:
            return mesh.texture
        for colors, index in ((mesh.colors, mesh.faces.long()), (mesh.corner_colors, slice(None))):
            if colors is not None:
                return colors[index].expand(-1, -1, 3)
        return None if mesh.face_colors is None else mesh.face_colors[:, None].expand(-1, 3, 3)

    x, y = shown(a), shown(b)
    assert (x is None) == (y is None)
    if x is not None and y is not None:
        # Half a step of 1/255, or of sRGB, whose slope is at most 2.4 times as steep.
        torch.testing.assert_close(x.expand_as(y), y, rtol=0, atol=(0.51 if linear else 1.25) / 255)
    if a.texture is not None and b.texture is not None:
        torch.testing.assert_close(a.uvs[a.uv_faces.long()], b.uvs[b.uv_faces.long()])


@pytest.mark.parametrize("appearance", APPEARANCES)
def test_to_trimesh_and_back(appearance: str) -> None:
    mesh = eg.Mesh(VERTS, FACES, **APPEARANCES[appearance])
    close(eg.shapes.from_trimesh(eg.shapes.to_trimesh(mesh)), mesh)


def test_trimesh_itself() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=2)
    mesh = eg.shapes.from_trimesh(sphere)
    assert mesh.verts.shape == sphere.vertices.shape and mesh.channels is None
    assert eg.shapes.to_trimesh(mesh).volume == pytest.approx(sphere.volume, rel=1e-5)
    sphere.visual.face_colors = [255, 0, 0, 255]
    assert eg.shapes.from_trimesh(sphere).face_colors[5].tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(TypeError, match=r"expected a trimesh\.Trimesh, got a Scene; take scene\.to_mesh"):
        eg.shapes.from_trimesh(trimesh.Scene([sphere]))
    with pytest.raises(TypeError, match="got Mesh"):
        eg.shapes.from_trimesh(mesh)
    with pytest.raises(ValueError, match="expected 1 or 3 channels, got 5"):
        eg.shapes.to_trimesh(eg.Mesh(VERTS, FACES, colors=torch.rand(8, 5)))


@pytest.mark.parametrize("ending", ["ply", "obj", "glb"])
@pytest.mark.parametrize("appearance", APPEARANCES)
def test_save_mesh(tmp_path: Path, appearance: str, ending: str) -> None:
    mesh = eg.Mesh(VERTS, FACES, **APPEARANCES[appearance])
    file = tmp_path / "new" / f"cube.{ending}"
    if (ending, appearance) == ("ply", "texture"):  # trimesh writes none there
        with pytest.warns(UserWarning, match=r"save_mesh: cube\.ply holds no uvs, no texture; torch\.save"):
            eg.save_mesh(file, mesh)
        return
    eg.save_mesh(file, mesh)
    close(eg.load_mesh(file), mesh, linear=ending == "glb" and appearance != "texture")


def test_save_shapes_and_faults(tmp_path: Path) -> None:
    mesh = eg.Mesh(VERTS, FACES)
    for ending in ("stl", "off"):
        eg.save_mesh(tmp_path / f"a.{ending}", mesh)
        close(eg.load_mesh(tmp_path / f"a.{ending}"), mesh)
    with pytest.raises(ValueError, match=r"a\.fbx: expected a file name that ends in \.ply"):
        eg.save_mesh(tmp_path / "a.fbx", mesh)
    with pytest.raises(TypeError, match="expected a Mesh, got Scene; a Scene is for save_scene"):
        eg.save_mesh(tmp_path / "a.ply", eg.Scene([mesh]))


@pytest.mark.parametrize("ending", ["obj", "off"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1e-30, 1e-6, 1.0, 1e12])
def test_text_keeps_every_number(tmp_path: Path, ending: str, dtype: torch.dtype, scale: float) -> None:
    """Vertices and texture coordinates of any size come back as they were."""
    mesh = eg.Mesh((torch.rand(8, 3, generator=torch.Generator().manual_seed(5)).double() * scale).to(dtype), FACES)
    if ending == "obj":
        mesh = mesh.replace(**APPEARANCES["texture"])
    eg.save_mesh(tmp_path / f"a.{ending}", mesh)
    back = eg.load_mesh(tmp_path / f"a.{ending}", dtype=dtype)
    assert torch.equal(back.verts[back.faces.long()], mesh.verts[mesh.faces.long()])
    if ending == "obj":
        assert torch.equal(back.uvs[back.uv_faces.long()].float(), mesh.uvs[mesh.uv_faces.long()].float())


def test_what_a_file_does_not_hold_is_said(tmp_path: Path) -> None:
    appearance = {"colors": torch.full((8, 3), 2.0), "material": eg.Material(0.5), "normals": torch.ones(8, 3)}
    for ending in ("ply", "obj"):
        with pytest.warns(UserWarning, match=rf"a\.{ending} holds no material, no normals, no colors beyond 0 … 1;"):
            eg.save_mesh(tmp_path / f"a.{ending}", eg.Mesh(VERTS, FACES, **appearance))
    with pytest.warns(UserWarning, match=r"a\.stl holds no colors;"):
        eg.save_mesh(tmp_path / "a.stl", eg.Mesh(VERTS, FACES, colors=torch.rand(8, 3)))


def test_an_obj_clamps_and_names_other_wraps_and_filters(tmp_path: Path) -> None:
    mesh = eg.Mesh(VERTS, FACES, **APPEARANCES["texture"], wrap=("clamp", "clamp"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        eg.save_mesh(tmp_path / "a.obj", mesh)
    assert eg.load_mesh(tmp_path / "a.obj").wrap == "clamp"
    for fields, message in (
        ({"filter": "nearest"}, r"no filter 'nearest'"),
        ({"wrap": "mirror"}, r"no wrap 'mirror'"),
        ({"wrap": ("clamp", "repeat"), "filter": "mipmap"}, r"no wrap \('clamp', 'repeat'\), no filter 'mipmap'"),
    ):
        with pytest.warns(UserWarning, match=rf"a\.obj holds {message}; torch\.save"):
            eg.save_mesh(tmp_path / "a.obj", mesh.replace(**fields))
    with pytest.warns(UserWarning, match=r"a\.ply holds no uvs, no texture, no wrap 'clamp', no filter 'nearest';"):
        eg.save_mesh(tmp_path / "a.ply", mesh.replace(wrap="clamp", filter="nearest"))


def test_parts_keep_their_names(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    trimesh.Scene({"wheel": box, "door": box}).export(tmp_path / "a.glb")
    scene = eg.load_scene(tmp_path / "a.glb")
    assert [mesh.name for mesh in scene.meshes] == ["wheel", "door"]
    assert repr(scene.meshes[0]).startswith("Mesh('wheel', 8 vertices") and scene.transformed().meshes[1].name == "door"
    assert eg.load_mesh(tmp_path / "a.glb").name is None


def test_a_state_dict_holds_all_of_a_scene(tmp_path: Path) -> None:
    mesh = eg.Mesh(VERTS, FACES, colors=COLORS.requires_grad_(), material=eg.Material(roughness=eg.Texture(torch.rand(2, 2, 1))),
                   uvs=COLORS[:, :2], uv_faces=FACES)  # fmt: skip
    camera = eg.Camera.look_at((0, 0, 4), (0, 0, 0), size=(8, 8))
    lights = [
        eg.lights.DirectionalLight((0, 0, -1)), eg.lights.PointLight((0, 0, 4)), eg.lights.SpotLight((0, 0, 4), (0, 0, -1)),
        eg.lights.Environment(torch.ones(3)), eg.lights.SphericalHarmonics(torch.ones(9, 3)),
        eg.shapes.disc((0, 3, 0), (1, 0, 0), (0, 0, 1), material=eg.Material(base_color=0.0, emission=2.0)),
    ]  # fmt: skip
    scene = eg.Scene([mesh], (0.1, 0.2, 0.3), lights)
    torch.save({"scene": scene.state_dict(), "camera": camera.state_dict()}, tmp_path / "a.pt")
    loaded = torch.load(tmp_path / "a.pt", weights_only=True)
    again, view = eg.Scene.from_state_dict(loaded["scene"]), eg.Camera.from_state_dict(loaded["camera"])
    assert torch.equal(eg.render(again, view, spp=1, seed=0), eg.render(scene, camera, spp=1, seed=0))
    assert repr(again) == repr(scene) and repr(view) == repr(camera)
    before, after = dict(named_tensors(scene)), dict(named_tensors(again))
    assert before.keys() == after.keys()
    for name, tensor in after.items():
        assert tensor.dtype == before[name].dtype and torch.equal(tensor, before[name]) and not tensor.requires_grad


def test_words_of_a_state_dict_are_plain(tmp_path: Path) -> None:
    """torch.load(weights_only=True) refuses numpy's strings."""
    clamp, nearest = np.str_("clamp"), np.str_("nearest")
    texture = eg.Texture(torch.rand(2, 2, 3), wrap=clamp, filter=nearest)
    material = eg.Material(texture, alpha_mode=np.str_("BLEND"))
    mesh = eg.Mesh(VERTS, FACES, uvs=COLORS[:, :2], uv_faces=FACES, material=material, name=np.str_("cube"),
                   wrap=(clamp, np.str_("mirror")), filter=nearest)  # fmt: skip
    torch.save(eg.Scene(mesh).state_dict(), tmp_path / "a.pt")
    (again,) = eg.Scene.from_state_dict(torch.load(tmp_path / "a.pt", weights_only=True)).meshes
    assert (again.name, again.wrap, again.filter) == ("cube", ("clamp", "mirror"), "nearest")
    assert type(mesh.replace(wrap=clamp).wrap) is type(mesh.name) is str


class Own(eg.lights.PointLight):
    """A light of a class of its own."""


def changed(**keys: object) -> dict[str, object]:
    state = eg.Scene([eg.Mesh(VERTS, FACES, material=eg.Material(0.5))]).state_dict()
    for key, value in keys.items():
        at = state if key in ("version", "type") else state["meshes"][0]
        at.pop(key) if value is None else at.update({key: value})
    return state


@pytest.mark.parametrize("state, kind, message", [
    (lambda: 3, TypeError, r"state: expected a dictionary of Scene\.state_dict\(\), got int"),
    (lambda: changed(version=2), ValueError, "state: expected version 1, got 2"),
    (lambda: {}, ValueError, "state: expected version 1, got None"),
    (lambda: changed(type="Camera"), ValueError, "state: expected the type Scene, got 'Camera'"),
    (lambda: changed(verts=None), ValueError, r"state\.meshes\[0\]: expected the keys of a Mesh, missing: verts"),
    (lambda: changed(vertices=VERTS), ValueError, r"state\.meshes\[0\]: .* unexpected: vertices"),
    (lambda: changed(material={"type": "os.system"}), ValueError, r"state\.meshes\[0\]\.material: expected a type among"),
    (lambda: changed(faces=FACES + 1), ValueError, "faces: expected indices"),
])  # fmt: skip
def test_faults_of_a_state_dict_are_named(state, kind, message) -> None:
    with pytest.raises(kind, match=message):
        eg.Scene.from_state_dict(state())


def test_a_light_of_ones_own_has_no_state() -> None:
    scene = eg.Scene([eg.Mesh(VERTS, FACES, material=eg.Material())], lights=[Own((0, 0, 4))])
    with pytest.raises(
        TypeError, match=r"state\.lights\[0\]: expected one of .*, got Own; torch\.save\(\) of the whole"
    ):
        scene.state_dict()


def test_notebooks_show_a_picture(tmp_path: Path) -> None:
    shown = PNGFormatter()
    notebook.register(shown)
    for mesh in (eg.Mesh(VERTS, FACES), eg.Mesh(VERTS, FACES, colors=COLORS.requires_grad_())):
        (tmp_path / "a.png").write_bytes(shown(mesh))
        picture = np.asarray(Image.open(tmp_path / "a.png").convert("RGB"))
        assert picture.shape == (256, 256, 3) and len(np.unique(picture[100:156, 100:156])) > 1
    assert shown(eg.Mesh(VERTS, FACES, colors=torch.rand(8, 5))) is not None
    assert shown(eg.Scene([eg.Mesh(VERTS, FACES)], torch.rand(4, 4, 3))) is not None


def test_a_headlight_shines_only_where_nothing_says_a_look() -> None:
    plain, painted = eg.Scene([eg.Mesh(VERTS, FACES)]), eg.Scene([eg.Mesh(VERTS, FACES, colors=COLORS)])
    camera = framing(plain, (32, 32))
    assert under_headlight(painted, camera) is painted
    lit = under_headlight(plain, camera)
    assert lit.is_lit and plain.lights == ()
    seen = eg.render(lit, camera, spp=4, seed=0).reshape(-1, 3)
    sides = eg.render(
        eg.Scene([eg.Mesh(VERTS, FACES, face_colors=torch.arange(12.0)[:, None] // 2)]), camera, spp=1, seed=0
    )
    assert len(sides.unique()) >= 4 and 0.2 < float(seen.max()) <= 0.7 and float(seen.std()) > 0.05
    dark = eg.Scene([eg.Mesh(VERTS, FACES, material=eg.Material())])
    assert float(eg.render(under_headlight(dark, camera), camera, spp=1, seed=0).max()) > 0.2
    sunny = dark.replace(lights=[eg.lights.PointLight((0, 0, 9))])
    assert under_headlight(sunny, camera) is sunny


def test_a_trimesh_without_faces_is_named() -> None:
    with pytest.raises(ValueError, match=r"mesh: expected a trimesh\.Trimesh with faces"):
        eg.shapes.from_trimesh(trimesh.Trimesh())


def test_two_textured_objs_in_one_folder(tmp_path):
    uvs, faces = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), torch.tensor([[0, 1, 2]])
    names = ("a.obj", "b c.obj")
    for name, value in zip(names, (0.0, 1.0), strict=True):
        texture = torch.full((2, 2, 3), value)
        eg.save_mesh(tmp_path / name, eg.Mesh(torch.eye(3), faces, uvs=uvs, uv_faces=faces, texture=texture))
    assert [float(eg.load_mesh(tmp_path / name).texture.mean()) for name in names] == [0.0, 1.0]
