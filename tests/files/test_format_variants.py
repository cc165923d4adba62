"""Variants of text formats that test_unusual_files.py does not draw, as other programs write them."""

import numpy as np
import pytest
import torch
from mesh_files import CORNERS, OFF, STL, TEXELS, binary_stl, linear, ply_header, quietly, write, write_obj
from PIL import Image

import edgegrad as eg

pytestmark = pytest.mark.unsanitized


def test_obj_corners_of_every_kind_in_one_material(tmp_path):
    """Each face but the first has nine words, which trimesh would take for the same."""
    body = "".join(
        f"v {x} {y} 0\n" for x, y in [(0, 0), (2, 0), (3, 1), (3, 2), (2, 3), (1, 3.5), (0, 3), (-1, 2), (-1, 1)]
    )
    body += "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1 2 3 4 5 6 7 8 9\nf 1//1 2//1 3//1\nf -9/-3 -8/-2 -7/-1\n"
    with pytest.warns(UserWarning, match=r"texture coordinates \(vt\) that only some corners of a part have"):
        mesh = eg.load_mesh(write(tmp_path, "a.obj", body))
    assert mesh.faces.tolist() == [[0, 1, 2], *([0, i, i + 1] for i in range(1, 8)), [0, 1, 2], [0, 1, 2]]


def test_obj_continued_lines_and_several_libraries(tmp_path):
    write(tmp_path, "a b.mtl", "newmtl red\nKd 1 0 0\n")
    write(tmp_path, "c.mtl", "newmtl green\nKd 0 1 0\n")
    write(tmp_path, "d.mtl", "newmtl blue\nKd 0 0 1\n")
    body = "mtllib a b.mtl\nmtllib c.mtl d.mtl\nv 0 0 \\\n0\nv 1 0 0\nv 0 1 0\n"
    body += "usemtl blue\nf 1 2 \\\n3\nusemtl red\nf 1 2 3\nusemtl green\nf 3 2 1\n"
    assert quietly(write(tmp_path, "a.obj", body)).face_colors.tolist() == [[0, 0, 1], [1, 0, 0], [0, 1, 0]]


@pytest.mark.parametrize("lit", [False, True])
def test_mtl_colour_times_texture(tmp_path, lit):
    mesh = quietly(write_obj(tmp_path, mtl="newmtl skin\nKd 0.5 0.25 1 # red, green, blue\nmap_Kd skin.png\n"), lit=lit)
    np.testing.assert_allclose(mesh.texture, linear(TEXELS) * [0.5, 0.25, 1], atol=1e-6)
    mesh = quietly(write_obj(tmp_path, mtl="newmtl skin\nKd 0.5\nmap_Kd \nmap_d\n"), lit=lit)
    assert mesh.face_colors.tolist() == [[0.5] * 3] * 2
    with pytest.warns(UserWarning, match=r"map_Kd times a Kd of 0 \(black, as the format says; set Kd to 1 1 1\)"):
        mesh = eg.load_mesh(write_obj(tmp_path, mtl="newmtl skin\nKd 0 0 0\nmap_Kd skin.png\n"), lit=lit)
    assert float(mesh.texture.max()) == 0
    with pytest.raises(ValueError, match="expected one number or three for Kd in the material, got '1 0'"):
        eg.load_mesh(write_obj(tmp_path, mtl="newmtl skin\nKd 1 0\n"), lit=lit)


@pytest.mark.parametrize(
    "options, scale, offset, wrap",
    [
        ("-s 1 1 1", (1, 1), (0, 0), "repeat"),
        ("-s 2 3 1 -o 0.5", (2, 3), (0.5, 0), "repeat"),
        ("-o 0.5 0.25 -clamp on", (1, 1), (0.5, 0.25), "clamp"),
        ("-clamp off -blendu on -blendv off -cc off -texres 512 -mm 0 1 -t 0 0 0 -bm 2 -boost 3", (1, 1), (0, 0), "repeat"),
    ],
)  # fmt: skip
def test_mtl_options_of_textures(tmp_path, options, scale, offset, wrap):
    plain = eg.load_mesh(write_obj(tmp_path))
    (tmp_path / "skin.png").rename(tmp_path / "my  skin.png")
    path = tmp_path / "quad.obj"
    write(tmp_path, "quad.mtl", f"newmtl skin\nmap_Kd {options} my  skin.png\n")
    mesh = quietly(path)
    assert mesh.wrap == wrap and torch.equal(mesh.texture, plain.texture)
    expected = plain.uvs[plain.uv_faces].numpy() * scale + offset
    np.testing.assert_allclose(mesh.uvs[mesh.uv_faces], expected, atol=1e-6)


def test_quoted_names(tmp_path):
    write_obj(tmp_path, mtl='newmtl skin\nmap_Kd -s 1 1 1 "skin.png"\n')
    path = write(tmp_path, "quad.obj", (tmp_path / "quad.obj").read_text().replace("quad.mtl", '"quad.mtl"'))
    assert quietly(path).texture is not None


def test_mtl_options_that_nothing_follows(tmp_path):
    mtl = "newmtl skin\nmap_Kd -mm 0.1 2 -t 1 1 1 -type cube_top -cc on skin.png\n"
    said = r"map_Kd -mm 0\.1 2 \(.*map_Kd -t 1 1 1 \(.*map_Kd -type cube_top \(.*map_Kd -cc on \("
    with pytest.warns(UserWarning, match=said):
        assert eg.load_mesh(write_obj(tmp_path, mtl=mtl)).texture is not None
    (tmp_path / "skin.png").rename(tmp_path / "my 3 skins.png")
    write(tmp_path, "quad.mtl", "newmtl skin\nmap_Kd -s 1 my 3 skins.png\n")
    assert quietly(tmp_path / "quad.obj").texture is not None
    with pytest.raises(ValueError, match=r"expected the name of an image after map_Kd '-s 1 1 1', got none"):
        eg.load_mesh(write_obj(tmp_path, mtl="newmtl skin\nmap_Kd -s 1 1 1\n"))


RGB = ("red", "green", "blue")


@pytest.mark.parametrize("kind", ["obj", "ply"])
@pytest.mark.parametrize(
    "red, expected",
    [(1.0000001, 1.0), (1.009, 1.0), (-1e-7, 0.0), (0.999, 0.999), (2.0, 2 / 255), (255.0, 1.0), (1.02, None), (1.9, None)],
)  # fmt: skip
def test_float_colours_near_one(tmp_path, kind, red, expected):
    """A colour that rounding moved past 1 is 1. Colours that reach neither 1 nor 255 are refused."""
    other = 0.5 if red < 2.0 else 127.5
    rows = [f"0 0 0 {red} {other} 0", f"1 0 0 {other} 0 0", f"0 1 0 0 0 {other}"]
    if kind == "obj":
        path = write(tmp_path, "a.obj", "".join(f"v {row}\n" for row in rows) + "f 1 2 3\n")
    else:
        properties = "".join(f"property float {name}\n" for name in RGB)
        path = write(tmp_path, "a.ply", ply_header(properties) + "\n".join(rows) + "\n3 0 1 2\n")
    if expected is None:
        with pytest.raises(ValueError, match=rf"expected vertex colours from 0 to 1, or to 255, got \[{red:.3g}"):
            eg.load_mesh(path)
        return
    np.testing.assert_allclose(quietly(path).colors[0], linear([expected * 255, 127.5, 0]), atol=1e-6)


def test_ushort_colours_of_eight_bits_are_named(tmp_path):
    properties = "".join(f"property ushort {name}\n" for name in RGB)
    path = write(tmp_path, "a.ply", ply_header(properties) + "0 0 0 255 128 0\n1 0 0 0 0 0\n0 1 0 3 3 3\n3 0 1 2\n")
    with pytest.warns(UserWarning, match=r"ushort colours of vertex up to 255 \(taken for 0 to 255, not 65535\)"):
        mesh = eg.load_mesh(path)
    np.testing.assert_allclose(mesh.colors[0], linear([255, 128, 0]), atol=1e-6)


def test_binary_stl_of_another_length(tmp_path):
    whole = binary_stl(name=b"solid as some call a binary one")
    assert quietly(write(tmp_path, "a.stl", whole)).faces.shape == (2, 3)
    for more in (1, 50, 1000):
        with pytest.warns(UserWarning, match=rf"{more} bytes after the last of 2 faces \(not read\)"):
            mesh = eg.load_mesh(write(tmp_path, "a.stl", whole + bytes(more)))
        assert mesh.verts[mesh.faces].tolist() == CORNERS
    for fewer in (1, 50):
        with pytest.raises(ValueError, match="expected the 2 faces that the file announces, got 1; it is truncated"):
            eg.load_mesh(write(tmp_path, "a.stl", whole[:-fewer]))


@pytest.mark.parametrize(
    "text",
    [
        STL.replace("\n", " "), "# by hand\n// and so\n" + STL, STL.split("\n", 1)[1], "\n" + STL.replace("\n", "\r"),
        STL.replace("solid a\n", "", 1).replace("endsolid a\n", ""),
    ],
)  # fmt: skip
def test_text_stl_of_other_lines(tmp_path, text):
    """The text is one line, follows comments, or lacks solid."""
    mesh = quietly(write(tmp_path, "a.stl", text))
    assert mesh.verts[mesh.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


def test_words_at_the_head_of_an_off(tmp_path):
    """ModelNet has numbers right after the word, and 4OFF has homogeneous coordinates."""
    for text in (OFF.replace("OFF\n", "OFF"), "4OFF\n3 1 0\n0 0 0 1\n2 0 0 2\n0 3 0 3\n3 0 1 2\n"):
        mesh = quietly(write(tmp_path, "a.off", text))
        assert mesh.verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and mesh.faces.tolist() == [[0, 1, 2]]
    for kind in ("OFF BINARY", "nOFF"):
        with pytest.raises(ValueError, match=f"expected an OFF file in text, in three dimensions, got '{kind}'"):
            eg.load_mesh(write(tmp_path, "e.off", OFF.replace("OFF", kind)))


def test_images_of_one_file_are_read_once(tmp_path):
    write_obj(tmp_path, mtl="newmtl skin\nmap_Kd skin.png\nnewmtl two\nmap_Kd skin.png\n")
    path = tmp_path / "quad.obj"
    path.write_text(path.read_text().replace("f 1/2 3/4", "usemtl two\nf 1/2 3/4"))
    first, second = eg.load_scene(path).meshes
    assert first.texture is second.texture and Image.open(tmp_path / "skin.png").size == (2, 2)
