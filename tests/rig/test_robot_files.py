"""URDF and its mesh files: mirrored meshes, units, materials, packages, limits, and malformed trees of links."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import edgegrad as eg
from edgegrad.files.image import srgb_to_linear
from edgegrad.rig.robot_visuals import flipped

pytest.importorskip("yourdfpy")
pytest.importorskip("pytorch_kinematics")

BOX = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
TRIANGLES = np.array(
    [[0, 2, 1], [1, 2, 3], [4, 5, 6], [5, 7, 6], [0, 1, 4], [1, 5, 4], [2, 6, 3], [3, 6, 7], [0, 4, 2], [2, 4, 6], [1, 3, 5],
     [3, 7, 5]]
)  # fmt: skip
SHAPE = '<geometry><box size="2 2 2"/></geometry>'


def mesh_link(name: str, file: str, more: str = "", inside: str = "") -> str:
    return f'<link name="{name}"><visual><geometry><mesh filename="{file}"{more}/></geometry>{inside}</visual></link>'


def joint(name: str, parent: str, child: str, kind: str = "fixed", inside: str = "") -> str:
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


def robot(folder: Path, *parts: str) -> Path:
    path = folder / "r.urdf"
    path.write_text(f'<robot name="r">{"".join(parts)}</robot>')
    return path


def volume(mesh: eg.Mesh) -> float:
    a, b, c = mesh.verts.double()[mesh.faces].unbind(1)
    return float((a * torch.linalg.cross(b, c)).sum()) / 6


def write_obj(path: Path, materials: tuple[str, ...] = ()) -> None:
    """Write a box with texture coordinates and normals, whose faces have the materials in turn."""
    lines = [f"v {x} {y} {z}" for x, y, z in BOX] + [f"vt {(x + 1) / 2} {(y + 1) / 2}" for x, y, _ in BOX]
    lines += [f"vn {x} {y} {z}" for x, y, z in BOX]
    if materials:
        lines.insert(0, f"mtllib {path.stem}.mtl")
        entries = [f"newmtl {m}\nmap_Kd {m}.png\n" for m in materials]
        path.with_suffix(".mtl").write_text("".join(entries))
        for k, m in enumerate(materials):
            Image.fromarray(np.full((2, 2, 3), 60 + 90 * k, np.uint8)).save(path.with_name(f"{m}.png"))
    per = len(TRIANGLES) // max(len(materials), 1)
    for k, face in enumerate(TRIANGLES + 1):
        if materials and k % per == 0:
            lines.append(f"usemtl {materials[k // per]}")
        lines.append("f " + " ".join(f"{i}/{i}/{i}" for i in face))
    path.write_text("\n".join(lines) + "\n")


# -- mirrored ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", ["1 -1 1", "-1 -1 -1", "-2 0.5 1", "-1 -1 1"])
def test_a_mirrored_mesh_keeps_its_outside(scale: str, tmp_path) -> None:
    write_obj(tmp_path / "uv.obj")
    mesh = eg.rig.load(robot(tmp_path, mesh_link("a", "uv.obj", f' scale="{scale}"'))).posed()
    assert volume(mesh) == pytest.approx(8.0)
    # Each corner keeps its texture coordinates.
    factor = torch.tensor([float(x) for x in scale.split()])
    expected = (mesh.verts[mesh.faces] / factor)[..., :2] / 2 + 0.5
    assert torch.allclose(mesh.uvs[mesh.uv_faces], expected)


def test_all_that_belongs_to_corners_is_reversed() -> None:
    """A lit textured mesh is mirrored. Values at its points are those of the mesh before, mirrored."""
    g = torch.Generator().manual_seed(0)
    faces = torch.tensor(TRIANGLES)
    own = torch.rand(3 * len(faces), 2, generator=g)
    corners = torch.arange(len(own)).reshape(-1, 3)
    texture = eg.Texture(torch.rand(4, 4, 1, generator=g), uvs=own, uv_faces=corners)
    mesh = eg.Mesh(
        torch.tensor(BOX).float(), faces, corner_colors=torch.rand(len(faces), 3, 3, generator=g), uvs=own, uv_faces=corners,
        alpha=torch.rand(4, 4, generator=g), normals=torch.tensor(BOX).float().repeat_interleave(2, 0),
        normal_faces=2 * faces + 1, material=eg.Material(roughness=texture),
    )  # fmt: skip
    mirror = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    again = flipped(mesh.transformed(mirror))
    assert volume(again) == pytest.approx(8.0) and volume(mesh.transformed(mirror)) == pytest.approx(-8.0)
    order = [2, 1, 0]
    assert torch.equal(again.verts[again.faces], (mesh.verts @ mirror)[mesh.faces][:, order])
    assert torch.equal(again.corner_colors, mesh.corner_colors[:, order])
    assert torch.equal(again.uvs[again.uv_faces], mesh.uvs[mesh.uv_faces][:, order])
    rough = again.material.roughness
    assert torch.equal(rough.uvs[rough.uv_faces], own[corners][:, order])
    assert torch.allclose(again.normals[again.normal_faces], (mesh.normals @ mirror)[mesh.normal_faces][:, order])
    outwards = (again.normals[again.normal_faces] * again.verts[again.faces]).sum(-1)
    assert bool((outwards > 0).all())


# -- appearance ------------------------------------------------------------------------------------------------------------

DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><created>2020-01-01T00:00:00</created>
<modified>2020-01-01T00:00:00</modified><unit name="millimeter" meter="0.001"/></asset>
<library_images><image id="i"><init_from>IMAGE</init_from></image></library_images>
<library_effects>
<effect id="e0"><profile_COMMON><technique sid="t"><phong><diffuse><color>0.8 0.2 0.4 1</color></diffuse></phong></technique>
</profile_COMMON></effect>
<effect id="e1"><profile_COMMON><newparam sid="f"><surface type="2D"><init_from>i</init_from></surface></newparam>
<newparam sid="s"><sampler2D><source>f</source></sampler2D></newparam>
<technique sid="t"><phong><diffuse><texture texture="s" texcoord="UV"/></diffuse></phong></technique></profile_COMMON></effect>
</library_effects>
<library_materials><material id="m0"><instance_effect url="#e0"/></material>
<material id="m1"><instance_effect url="#e1"/></material></library_materials>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 1000 0 0 0 1000 0 0 0 1000</float_array><technique_common>
<accessor source="#pa" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<source id="u"><float_array id="ua" count="6">0 0 1 0 0 1</float_array><technique_common>
<accessor source="#ua" count="3" stride="2"><param name="S" type="float"/><param name="T" type="float"/></accessor>
</technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="2" material="s0"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3</p></triangles>
<triangles count="2" material="s1"><input semantic="VERTEX" source="#v" offset="0"/><input semantic="TEXCOORD" source="#u"
offset="1" set="0"/><p>0 0 3 1 2 2 1 0 2 1 3 2</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="vs"><node><translate>0 0 500</translate><instance_geometry url="#g"><bind_material>
<technique_common><instance_material symbol="s0" target="#m0"/><instance_material symbol="s1" target="#m1"/></technique_common>
</bind_material></instance_geometry></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#vs"/></scene></COLLADA>
"""


def test_a_dae_is_read_in_its_unit_with_its_materials(tmp_path) -> None:
    pytest.importorskip("collada")
    texels = np.random.default_rng(0).integers(0, 256, (3, 2, 3), dtype=np.uint8)
    Image.fromarray(texels).save(tmp_path / "t.png")
    (tmp_path / "a.dae").write_text(DAE.replace("IMAGE", "t.png"))
    plain, textured = eg.rig.load(robot(tmp_path, mesh_link("a", "a.dae"))).posed().meshes
    for mesh in (plain, textured):
        assert torch.allclose(mesh.verts.amin(0), torch.tensor([0.0, 0.0, 0.5]))
        assert torch.allclose(mesh.verts.amax(0), torch.tensor([1.0, 1.0, 1.5]))
    assert torch.allclose(plain.face_colors, torch.tensor([0.8, 0.2, 0.4]), atol=2e-3)
    assert torch.allclose(textured.texture, srgb_to_linear(torch.tensor(texels) / 255.0), atol=1e-6)
    assert textured.uvs[textured.uv_faces].amax((0, 1)).tolist() == [1.0, 1.0]
    (tmp_path / "a.dae").write_text(DAE.replace("IMAGE", "gone.png"))
    with pytest.warns(UserWarning, match=r"a\.dae: not rendered as the file asks: '.*gone\.png' \(no such file"):
        eg.rig.load(tmp_path / "r.urdf")


def test_materials_of_trimesh_have_their_colours() -> None:
    trimesh = pytest.importorskip("trimesh")
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[204, 51, 102, 255])
    given = trimesh.creation.box()
    given.visual = trimesh.visual.TextureVisuals(material=material)
    assert torch.allclose(eg.shapes.from_trimesh(given).face_colors, torch.tensor([0.8, 0.2, 0.4]))


def test_an_obj_of_two_textures_shows_both(tmp_path) -> None:
    write_obj(tmp_path / "two.obj", ("m", "n"))
    first, second = eg.rig.load(robot(tmp_path, mesh_link("a", "two.obj"))).posed().meshes
    for mesh, code in ((first, 60), (second, 150)):
        assert len(mesh.faces) == 6
        assert torch.allclose(mesh.texture, srgb_to_linear(torch.tensor(code / 255.0)).expand(2, 2, 3))
    assert (first.name, second.name) == ("a 0", "a 1")
    # One whose texture is not there is shown without, and named.
    (tmp_path / "n.png").unlink()
    with pytest.warns(
        UserWarning, match=r"r\.urdf: .*materials of two\.obj \(left out: .*'n\.png', and there is no such file"
    ):
        mesh = eg.rig.load(tmp_path / "r.urdf").posed()
    assert mesh.texture is None and volume(mesh) == pytest.approx(8.0)


def test_textures_and_alpha_of_a_urdf(tmp_path) -> None:
    write_obj(tmp_path / "uv.obj")
    Image.fromarray(np.full((2, 2, 3), 150, np.uint8)).save(tmp_path / "t.png")
    shared = '<material name="m"><color rgba="1 0 0 0.5"/><texture filename="t.png"/></material>'
    path = robot(
        tmp_path, shared, mesh_link("a", "uv.obj", "", '<material name="m"/>'),
        f'<link name="b"><visual>{SHAPE}<material name="m"/></visual></link>', joint("j", "a", "b"),
    )  # fmt: skip
    with pytest.warns(
        UserWarning,
        match=r"r\.urdf: not .*alpha 0\.5 of material 'm' \(opaque\); the texture of 'b' .*no texture coordinates",
    ):
        textured, box = eg.rig.load(path).posed().meshes
    assert torch.allclose(textured.texture, srgb_to_linear(torch.tensor(150 / 255.0)).expand(2, 2, 3))
    assert box.face_colors[0].tolist() == [1.0, 0.0, 0.0]
    (tmp_path / "t.png").unlink()
    with pytest.warns(UserWarning, match=r"the texture 't\.png' of link 'a' \(left out, for there is no such file"):
        assert eg.rig.load(path).meshes[0].face_colors[0].tolist() == [1.0, 0.0, 0.0]


def test_meshes_of_packages(tmp_path) -> None:
    (tmp_path / "robots").mkdir()
    (tmp_path / "other" / "arm_meshes" / "visual").mkdir(parents=True)
    write_obj(tmp_path / "other" / "arm_meshes" / "visual" / "a.obj")
    path = robot(tmp_path / "robots", mesh_link("a", "package://arm_meshes/visual/a.obj"))
    for folders in (tmp_path / "other", [str(tmp_path), tmp_path / "other"], tmp_path / "other" / "arm_meshes"):
        assert volume(eg.rig.load(path, package_dirs=folders).posed()) == pytest.approx(8.0)
    with pytest.raises(
        FileNotFoundError, match=r"r\.urdf: link 'a': names the mesh .*pass the folder .* by package_dirs="
    ):
        eg.rig.load(path, package_dirs=tmp_path)
    with pytest.raises(FileNotFoundError, match=r"package_dirs: expected folders, got .*nowhere"):
        eg.rig.load(path, package_dirs=tmp_path / "nowhere")
    with pytest.raises(TypeError, match="package_dirs: expected folders, got int"):
        eg.rig.load(path, package_dirs=[3])  # type: ignore[list-item]
    # Next to the robot's own folder, without an argument.
    shutil.move(tmp_path / "other" / "arm_meshes", tmp_path / "arm_meshes")
    assert volume(eg.rig.load(path).posed()) == pytest.approx(8.0)


# -- links and joints -------------------------------------------------------------------------------------------------


def test_a_robot_of_one_link(tmp_path) -> None:
    found = eg.rig.load(robot(tmp_path, f'<link name="a"><visual>{SHAPE}</visual></link>'))
    assert volume(found.posed()) == pytest.approx(8.0) and found.controls["angles"].rest.shape == (0,)
    assert found.shape({}).joints.tolist() == [[0.0, 0.0, 0.0]]
    assert len(found.posed(angles=torch.zeros(3, 0))) == 3
    path = robot(tmp_path, f'<link name="a"><visual>{SHAPE}</visual></link><link name="b"/>', joint("j", "a", "b"))
    assert volume(eg.rig.load(path).posed()) == pytest.approx(8.0)


LINKS = f'<link name="a"><visual>{SHAPE}</visual></link><link name="b"/><link name="c"/>'
REFUSED = {
    "two roots": ((LINKS, joint("j", "a", "b")), "expected one link that hangs on no other, got 2: 'a', 'c'"),
    "no joints": ((LINKS,), "expected one link that hangs on no other, got 3: 'a', 'b', 'c'"),
    "axis of zeros": (
        (LINKS, joint("j", "a", "b"), joint("k", "b", "c", "continuous", '<axis xyz="0 0 0"/>')),
        r"joint 'k': expected an axis of 3 numbers that are not all 0, got \[0.0, 0.0, 0.0\]",
    ),
    "axis of two numbers": (
        (LINKS, joint("j", "a", "b"), joint("k", "b", "c", "continuous", '<axis xyz="0 1"/>')), "joint 'k': expected an axis"
    ),
    "a scale of two numbers": (
        (mesh_link("a", "uv.obj", ' scale="1 1"'),), r"link 'a': expected a mesh scale of 3 .* got \[1.0, 1.0\]"
    ),
    "a scale of zero": ((mesh_link("a", "uv.obj", ' scale="0 1 1"'),), "link 'a': expected a mesh scale of 3 finite numbers"),
    "a scale that is no number": ((mesh_link("a", "uv.obj", ' scale="nan 1 1"'),), "link 'a': expected a mesh scale of 3"),
    "links of one name": ((LINKS, '<link name="c"/>', joint("j", "a", "b")), "link 'c': expected each link once"),
    "joints of one name": ((LINKS, joint("j", "a", "b"), joint("j", "b", "c")), "joint 'j': expected each joint once"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_robot_is_named(case: str, tmp_path) -> None:
    parts, message = REFUSED[case]
    write_obj(tmp_path / "uv.obj")
    with pytest.raises(ValueError, match=rf"r\.urdf: {message}"):
        eg.rig.load(robot(tmp_path, *parts))


def test_missing_limits_are_zero(tmp_path) -> None:
    limit = '<limit effort="1" velocity="1"{}/><axis xyz="0 0 1"/>'
    path = robot(
        tmp_path, LINKS, joint("j", "a", "b", "revolute", limit.format("")),
        joint("k", "b", "c", "revolute", limit.format(' upper="2"')),
    )  # fmt: skip
    with pytest.warns(
        UserWarning, match=r"limit of joint 'j' without lower \(0, as the format says.*'k' without lower"
    ):
        control = eg.rig.load(path).controls["angles"]
    assert control.low.tolist() == [0.0, 0.0] and control.high.tolist() == [0.0, 2.0]
