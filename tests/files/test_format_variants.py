"""Variants of formats, as other programs write them, keep their colours and faces; a warning names what is not read."""

import struct
import warnings

import numpy as np
import pytest
import torch
from mesh_files import GOOD, OFF, SQUARE, STL, TEXELS, TEXTURED, TRIANGLES, linear, ply, saved, square_glb, write_obj
from PIL import Image

import edgegrad as eg

VERTS = "0 0 0\n1 0 0\n0 1 0\n"


def write(folder, name, content):
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode("latin-1"))
    return folder / name


def quietly(path, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return eg.load_mesh(path, **options)


def header(vertex, face="property list uchar int vertex_indices\n", form="ascii", faces=1, more="", vertices=3):
    return (
        f"ply\nformat {form} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n{vertex}"
        f"element face {faces}\n{face}{more}end_header\n"
    )


# -- text --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["latin-1", "utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_names_and_comments_in_any_encoding(tmp_path, encoding, newline):
    def text(name, content):
        return write(tmp_path, name, content.replace("\n", newline).encode(encoding))

    text("a.mtl", "# grün\nnewmtl Würfel\nKd 0 1 0\n")
    path = text("a.obj", f"# José\nmtllib a.mtl\no Tür\nusemtl Würfel\n{GOOD}")
    assert quietly(path).face_colors.tolist() == [[0, 1, 0]]
    assert eg.load_scene(path).meshes[0].name == "Tür"
    assert eg.load_scene(text("b.stl", STL.replace("solid a", "solid Würfel"))).meshes[0].name == "Würfel"
    assert quietly(text("a.off", "# José\n" + OFF)).verts.shape == (3, 3)
    if encoding in ("latin-1", "utf-8"):
        colors = "property uchar red\nproperty uchar green\nproperty uchar blue\n"
        content = header(colors).replace("element v", "comment José\nelement v") + "0 0 0 0 255 0\n" * 3 + "3 0 1 2\n"
        assert quietly(text("a.ply", content)).corner_colors is None


def test_binary_ply_with_a_latin_comment(tmp_path):
    content = ply(SQUARE, TRIANGLES, [[255, 0, 0]] * 4, binary=True, comment="comment Jos\n").replace(
        b"Jos", b"Jos\xe9"
    )
    assert quietly(write(tmp_path, "a.ply", content)).colors.tolist() == [[1, 0, 0]] * 4


# -- OBJ ---------------------------------------------------------------------------------------------------------------


def test_obj_corners_of_every_kind_in_one_material(tmp_path):
    """Nine words in each face but the first, which trimesh would take for the same."""
    body = "".join(
        f"v {x} {y} 0\n" for x, y in [(0, 0), (2, 0), (3, 1), (3, 2), (2, 3), (1, 3.5), (0, 3), (-1, 2), (-1, 1)]
    )
    body += "vt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nf 1/1/1 2/2/1 3/3/1\nf 1 2 3 4 5 6 7 8 9\nf 1//1 2//1 3//1\nf -9/-3 -8/-2 -7/-1\n"
    with pytest.warns(UserWarning, match=r"texture coordinates \(vt\) that only some corners of a part have"):
        mesh = eg.load_mesh(write(tmp_path, "a.obj", body))
    assert mesh.faces.tolist() == [[0, 1, 2], *([0, i, i + 1] for i in range(1, 8)), [0, 1, 2], [0, 1, 2]]


def test_obj_faces_that_count_backwards_among_their_vertices(tmp_path):
    body = "v 0 0 0\nvt 0 0\nv 1 0 0\nvt 1 0\nv 0 1 0\nvt 0 1\nf -3/-3 -2/-2 -1/-1\n"
    body += "v 5 0 0\nvt 9 9\nv 6 0 0\nv 5 1 0\nf -3/-4 5/-3 -1/-2\n"
    mesh = quietly(write(tmp_path, "a.obj", body))
    assert mesh.verts[mesh.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[5, 0, 0], [6, 0, 0], [5, 1, 0]]]
    assert mesh.uvs[mesh.uv_faces].tolist() == [[[0, 0], [1, 0], [0, 1]]] * 2


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
        assert (
            float(
                eg.load_mesh(write_obj(tmp_path, mtl="newmtl skin\nKd 0 0 0\nmap_Kd skin.png\n"), lit=lit).texture.max()
            )
            == 0
        )
    with pytest.raises(ValueError, match="expected one number or three for Kd in the material, got '1 0'"):
        eg.load_mesh(write_obj(tmp_path, mtl="newmtl skin\nKd 1 0\n"), lit=lit)


@pytest.mark.parametrize(
    "options, scale, offset, wrap",
    [
        ("-s 1 1 1", (1, 1), (0, 0), "repeat"),
        ("-s 2 3 1 -o 0.5", (2, 3), (0.5, 0), "repeat"),
        ("-o 0.5 0.25 -clamp on", (1, 1), (0.5, 0.25), "clamp"),
        (
            "-clamp off -blendu on -blendv off -cc off -texres 512 -mm 0 1 -t 0 0 0 -bm 2 -boost 3",
            (1, 1),
            (0, 0),
            "repeat",
        ),
    ],
)
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


# -- PLY ---------------------------------------------------------------------------------------------------------------

NAMES = [("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")]


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize(
    "kind, scale",
    [("uchar", 1), ("int", 1), ("short", 1), ("ushort", 257), ("uint", 257), ("float", 1 / 255), ("double", 1)],
)
def test_ply_colours_by_any_name_and_type(tmp_path, names, kind, scale):
    values = np.array([[255, 128, 0], [0, 3, 64], [10, 20, 30]])
    properties = "".join(f"property {kind} {name}\n" for name in names)
    given = values * scale
    rows = "".join(f"{row} {r} {g} {b}\n" for row, (r, g, b) in zip(VERTS.splitlines(), given, strict=True))
    mesh = quietly(write(tmp_path, "a.ply", header(properties) + rows + "3 0 1 2\n"))
    np.testing.assert_allclose(mesh.colors, linear(values), atol=1e-6)
    face = "property list uchar int vertex_indices\n" + properties
    rows = VERTS + "3 0 1 2 {} {} {}\n".format(*given[0])
    mesh = quietly(write(tmp_path, "b.ply", header("", face) + rows))
    np.testing.assert_allclose(mesh.face_colors, linear(values[:1]), atol=1e-6)


@pytest.mark.parametrize("kind", ["obj", "ply"])
@pytest.mark.parametrize(
    "red, expected",
    [(1.0000001, 1.0), (1.009, 1.0), (-1e-7, 0.0), (0.999, 0.999), (2.0, 2 / 255), (255.0, 1.0), (1.02, None), (1.9, None)],
)  # fmt: skip
def test_float_colours_near_one(tmp_path, kind, red, expected):
    """What rounding moves past 1 is 1, and the others stay what they were; what is neither up to 1 nor to 255 is refused."""
    other = 0.5 if red < 2.0 else 127.5
    rows = [f"0 0 0 {red} {other} 0", f"1 0 0 {other} 0 0", f"0 1 0 0 0 {other}"]
    if kind == "obj":
        path = write(tmp_path, "a.obj", "".join(f"v {row}\n" for row in rows) + "f 1 2 3\n")
    else:
        properties = "".join(f"property float {name}\n" for name in NAMES[0])
        path = write(tmp_path, "a.ply", header(properties) + "\n".join(rows) + "\n3 0 1 2\n")
    if expected is None:
        with pytest.raises(ValueError, match=rf"expected vertex colours from 0 to 1, or to 255, got \[{red:.3g}"):
            eg.load_mesh(path)
        return
    np.testing.assert_allclose(quietly(path).colors[0], linear([expected * 255, 127.5, 0]), atol=1e-6)


def test_ushort_colours_of_eight_bits_are_said(tmp_path):
    properties = "".join(f"property ushort {name}\n" for name in NAMES[0])
    path = write(tmp_path, "a.ply", header(properties) + "0 0 0 255 128 0\n1 0 0 0 0 0\n0 1 0 3 3 3\n3 0 1 2\n")
    with pytest.warns(UserWarning, match=r"ushort colours of vertex up to 255 \(taken for 0 to 255, not 65535\)"):
        mesh = eg.load_mesh(path)
    np.testing.assert_allclose(mesh.colors[0], linear([255, 128, 0]), atol=1e-6)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("count", ["uchar", "int"])
def test_ply_lists_of_mixed_lengths(tmp_path, form, count):
    """With other lists and numbers around them; the colours stay with their faces."""
    order = ">" if form.endswith("big_endian") else "<"
    corners, extra = [[0, 1, 2, 3], [0, 1, 4], [3, 2, 1]], [[], [1.5], [2.5, 3.5]]
    colors = [[255, 0, 0], [0, 255, 0], [0, 0, 255]]
    face = f"property uchar red\nproperty uchar green\nproperty list {count} int vertex_indices\nproperty uchar blue\n"
    head = header("", face + "property list uchar double weights\n", form, faces=3, vertices=5)
    verts = [*SQUARE, [2, 2, 0]]
    rows = "".join("{} {} {}\n".format(*v) for v in verts)
    body = b"".join(struct.pack(order + "3f", *v) for v in verts)
    for c, i, w in zip(colors, corners, extra, strict=True):
        rows += " ".join(map(str, [*c[:2], len(i), *i, c[2], len(w), *w])) + "\n"
        n = count == "int"
        body += struct.pack(f"{order}2B{'i' if n else 'B'}{len(i)}iBB{len(w)}d", *c[:2], len(i), *i, c[2], len(w), *w)
    content = head.encode() + (rows.encode() if form == "ascii" else body)
    with pytest.warns(UserWarning, match=r"asks: weights of face \(not read\)$"):
        mesh = eg.load_mesh(write(tmp_path, "a.ply", content))
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 4], [3, 2, 1]]
    np.testing.assert_allclose(mesh.face_colors, linear([colors[0], *colors]), atol=1e-6)


def test_ply_triangle_strips(tmp_path):
    """Two, of which every other triangle is turned round, after a face."""
    grid = [[x, y, 0] for x in range(4) for y in range(2)]
    strips = "element tristrips 1\nproperty list int int vertex_indices\n"
    rows = "".join("{} {} {}\n".format(*v) for v in grid) + "3 0 2 1\n"
    head = header("", vertices=8, more=strips)
    mesh = quietly(write(tmp_path, "a.ply", head + rows + "9 2 4 3 5 -1 4 6 5 7\n"))
    assert mesh.faces.tolist() == [[0, 2, 1], [2, 4, 3], [3, 4, 5], [4, 6, 5], [5, 6, 7]]
    mesh = quietly(write(tmp_path, "b.ply", head.replace("face 1", "face 0") + rows[:-8] + "7 0 2 1 3 -1 -1 0\n"))
    assert mesh.faces.tolist() == [[0, 2, 1], [1, 2, 3]]


def test_ply_texture_coordinates_of_corners(tmp_path):
    face = "property list uchar int vertex_indices\nproperty list uchar float texcoord\n"
    rows = "".join("{} {} {}\n".format(*v) for v in SQUARE) + "4 0 1 2 3 8 0 0 .5 0 .5 1 0 1\n3 0 2 1 6 1 1 .5 .5 0 1\n"
    mesh = quietly(write(tmp_path, "a.ply", header("", face, vertices=4, faces=2) + rows))
    expected = [[[0, 0], [0.5, 0], [0.5, 1]], [[0, 0], [0.5, 1], [0, 1]], [[1, 1], [0.5, 0.5], [0, 1]]]
    assert mesh.uvs[mesh.uv_faces].tolist() == expected


# -- STL and OFF -------------------------------------------------------------------------------------------------------


def binary_stl(faces, attribute=0, name=b"x"):
    body = b"".join(struct.pack("<12fH", 0, 0, 1, *np.ravel(face), attribute) for face in faces)
    return name.ljust(80, b"\0") + struct.pack("<I", len(faces)) + body


CORNERS = [[SQUARE[i] for i in face] for face in TRIANGLES]


def test_binary_stl_of_another_length(tmp_path):
    whole = binary_stl(CORNERS, name=b"solid as some call a binary one")
    assert quietly(write(tmp_path, "a.stl", whole)).faces.shape == (2, 3)
    for more in (1, 2, 49, 50, 1000):
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
    """In one line; after comments; without solid."""
    mesh = quietly(write(tmp_path, "a.stl", text))
    assert mesh.verts[mesh.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]]


def test_text_stl_whose_names_are_keywords(tmp_path):
    names = ["vertex normal", "endsolid", "solid", "", "facet"]
    text = "".join(STL.upper().replace("SOLID A", f"SOLID {name}") for name in names)
    scene = eg.load_scene(write(tmp_path, "a.stl", text))
    assert [mesh.name for mesh in scene.meshes] == ["vertex normal", "endsolid", "solid", None, "facet"]
    assert all(mesh.verts[mesh.faces].tolist() == [[[0, 0, 0], [1, 0, 0], [0, 1, 0]]] for mesh in scene.meshes)


def test_off_with_numbers_right_after_the_word(tmp_path):
    """As in ModelNet."""
    mesh = quietly(write(tmp_path, "a.off", OFF.replace("OFF\n", "OFF")))
    assert mesh.verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]] and mesh.faces.tolist() == [[0, 1, 2]]


def test_off_with_colours_normals_and_texture_coordinates(tmp_path):
    rows = ["0 0 0  0 0 1  255 128 0 255  0 0", "1 0 0  0 1 0  0 3 64 255  1 0", "0 1 0  0 0 1  10 20 30 255  0 1"]
    mesh = quietly(write(tmp_path, "a.off", "STCNOFF # all\n3 1 0\n" + "\n\n".join(rows) + "\n3 0 1 2\n"), lit=True)
    np.testing.assert_allclose(mesh.colors, linear([[255, 128, 0], [0, 3, 64], [10, 20, 30]]), atol=1e-6)
    assert mesh.normals.tolist() == [[0, 0, 1], [0, 1, 0], [0, 0, 1]] and mesh.uvs.tolist() == [[0, 0], [1, 0], [0, 1]]
    mesh = quietly(write(tmp_path, "b.off", "COFF 3 1 0\n0 0 0 1 .5 0 1\n1 0 0 0 1 0 1\n0 1 0 0 0 1 1\n3 0 1 2\n"))
    np.testing.assert_allclose(mesh.colors, linear(np.array([[255, 127.5, 0], [0, 255, 0], [0, 0, 255]])), atol=1e-6)
    faces = "OFF\n4 2 5\n" + "".join("{} {} {}\n".format(*v) for v in SQUARE) + "4 0 1 2 3 255 128 0\n3 0 2 1 0 0 3\n"
    mesh = quietly(write(tmp_path, "c.off", faces))
    np.testing.assert_allclose(mesh.face_colors, linear([[255, 128, 0], [255, 128, 0], [0, 0, 3]]), atol=1e-6)
    homogeneous = quietly(write(tmp_path, "d.off", "4OFF\n3 1 0\n0 0 0 1\n2 0 0 2\n0 3 0 3\n3 0 1 2\n"))
    assert homogeneous.verts.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    for kind in ("OFF BINARY", "nOFF"):
        with pytest.raises(ValueError, match=f"expected an OFF file in text, in three dimensions, got '{kind}'"):
            eg.load_mesh(write(tmp_path, "e.off", OFF.replace("OFF", kind)))


# -- what nobody reads -------------------------------------------------------------------------------------------------


def textured(mtl="newmtl skin\nmap_Kd skin.png\n"):
    return lambda folder: write_obj(folder, mtl=mtl)


LABEL = "property list uchar int vertex_index\nproperty int label\n"
UNREAD = {
    "OBJ, a line": ("a.obj", GOOD + "l 1 2\nl 2 3\np 1\n", r"2 × l \(not read\); 1 × p \(not read\)"),
    "OBJ, a curve": ("a.obj", GOOD + "cstype bezier\ncurv 0 1 1 2 3\nend\n", r"1 × cstype .*; 1 × curv .*; 1 × end "),
    "OBJ, colours of some": ("a.obj", "v 0 0 0 1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "after the positions of some vertices"),
    "OBJ, no vt": ("a.obj", GOOD.replace("1 2 3", "1/1 2/2 3/3"), r"texture coordinates \(vt\) of faces \(left out, for"),
    "OBJ, colours by ZBrush": ("a.obj", "#MRGB ffff0000\n" + GOOD + "#MRGB ffff0000\n", "2 × #MRGB "),
    "OBJ, no mtllib": ("a.obj", GOOD.replace("f 1", "usemtl red\nf 1"), r"usemtl without a mtllib \(no materials\)"),
    "OBJ, Kd and colours": (
        "quad.obj",
        lambda folder: write_obj(
            folder, mtl="newmtl red\nKd 1 0 0\n",
            body="mtllib quad.mtl\nusemtl red\nv 0 0 0 1 1 1\nv 1 0 0 1 1 1\nv 0 1 0 1 1 1\nf 1 2 3\n",
        ),
        "Kd beside colours of vertices",
    ),
    "OBJ, faces of two": ("a.obj", GOOD + "f 1 2\nf 3\n", r"2 faces of fewer than three corners \(left out\)"),
    "OFF, faces of two": ("a.off", OFF.replace("3 1 0", "3 2 0") + "2 0 1\n", "1 faces of fewer than three corners"),
    "PLY, faces of two": ("a.ply", ply(SQUARE, [[0, 1], [0, 1, 2]], binary=True), "1 faces of fewer than three corners"),
    "MTL, another case": ("quad.obj", textured("newmtl skin\nmap_Kd SKIN.png\n"), r"'SKIN\.png' \(skin\.png in its place\)"),
    "PLY, vertex": (
        "a.ply", header("property float intensity\n") + "0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2\n", "intensity of vertex",
    ),
    "PLY, a colour": (
        "a.ply",
        header("".join(f"property uchar specular_{c}\n" for c in ("red", "green", "blue")))
        + "0 0 0 1 2 3\n1 0 0 1 2 3\n0 1 0 1 2 3\n3 0 1 2\n",
        "specular_red, specular_green, specular_blue of vertex",
    ),
    "PLY, two colours": (
        "a.ply", ply(SQUARE, TRIANGLES, [[1, 2, 3]] * 4, [[1, 2, 3]] * 2), r"red, green, blue of face \(not read\)",
    ),
    "PLY, face": ("a.ply", header("", LABEL) + VERTS + "3 0 1 2 7\n", "label of face"),
    "PLY, element": (
        "a.ply", header("", more="element edge 1\nproperty int vertex1\nproperty int vertex2\n") + VERTS + "3 0 1 2\n0 1\n",
        r"element edge \(not read\)",
    ),
    "PLY, numbers": ("a.ply", header("") + VERTS + "3 0 1 2\n7 8\n", r"2 numbers after the last element \(not read\)"),
    "PLY, bytes": ("a.ply", ply(SQUARE, TRIANGLES, binary=True) + b"abc", r"3 bytes after the last element \(not read\)"),
    "STL, attributes": ("a.stl", binary_stl(CORNERS, 31), r"the attributes of faces, where some writers keep colours"),
    "STL, a colour": ("a.stl", binary_stl(CORNERS, name=b"COLOR=\xff\0\0\xff"), r"COLOR= of the header \(a colour by Mat"),
    "STL, no number": (
        "a.stl", binary_stl(CORNERS)[:80] + bytes(4) + binary_stl(CORNERS)[84:], r"0 as the number of faces \(2, by the length",
    ),
    "STL, bytes": ("a.stl", binary_stl(CORNERS) + b"a", r"1 bytes after the last of 2 faces"),
    "STL, keyword": ("a.stl", STL.replace("endfacet", "tint 3\nendfacet"), r"tint \(not read\)"),
    "OFF, vertex": ("a.off", OFF.replace("0 0 0", "0 0 0 9").replace("1 0 0", "1 0 0 9"), "1 more numbers of each vertex"),
    "OFF, colour map": ("a.off", OFF.replace("3 0 1 2", "3 0 1 2 5"), "colours of faces"),
    "OFF, lines": ("a.off", OFF + "3 2 1 0\n", "1 lines after the last face"),
    "MTL, keyword": ("quad.obj", textured("newmtl skin\nKd 1 0 0\nglow 3\n"), r"glow \(left out\)"),
    "MTL, no such material": ("quad.obj", textured("newmtl other\nKd 1 0 0\n"), "usemtl skin "),
    "MTL, spectrum": ("quad.obj", textured("newmtl skin\nKd spectral red.rfl 1\n"), r"Kd spectral red\.rfl 1 \(not read\)"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNREAD)
def test_what_nobody_reads_is_said_once(tmp_path, case):
    name, content, said = UNREAD[case]
    path = content(tmp_path) if callable(content) else write(tmp_path, name, content)
    with pytest.warns(UserWarning, match=rf"{name}: .*{said}") as caught:
        assert len(eg.load_scene(path).meshes[0].faces) >= 1
    assert len(caught) == 1


SCANNED = "property float nx\nproperty float ny\nproperty float nz\nproperty uchar alpha\nproperty float confidence\n"


@pytest.mark.parametrize(
    "name, content",
    [
        ("a.obj", "g a\ns 1\nmg 1 2\n" + GOOD),
        ("a.ply", header(SCANNED) + "0 0 0 0 0 1 9 1\n1 0 0 0 0 1 9 1\n0 1 0 0 0 1 9 1\n3 0 1 2\n"),
        ("quad.obj", textured("newmtl skin\nKa 1 1 1\nKd 1 1 1\nKs 1 1 1\nNs 9\nNi 1.5\nd 0.9\nTf 1 0 0\nmap_Bump b\n")),
    ],
)  # fmt: skip
def test_what_is_left_out_on_purpose_is_not_said(tmp_path, name, content):
    quietly(content(tmp_path) if callable(content) else write(tmp_path, name, content))


def test_what_a_lit_scene_leaves_out_is_said(tmp_path):
    path = write(tmp_path, "a.obj", "s 1\n" + GOOD)
    with pytest.warns(UserWarning, match=r"s \(flat faces, for there are no normals"):
        eg.load_mesh(path, lit=True)
    mtl = "newmtl skin\nKd 1 1 1\nTf 1 1 0\nPs 0\nPc 1\nmap_Bump b.png\n"
    with pytest.warns(UserWarning, match=r"tf \(left out\); pc \(left out\); map_bump \(left out\)$"):
        eg.load_mesh(write_obj(tmp_path, mtl=mtl), lit=True)


def test_a_long_list_is_cut(tmp_path):
    body = GOOD + "".join(f"word{i} 1\n" for i in range(50))
    with pytest.warns(UserWarning, match=r"1 × word19 \(not read\); 30 more$"):
        eg.load_mesh(write(tmp_path, "a.obj", body))


def test_images_of_one_file_are_read_once(tmp_path):
    write_obj(tmp_path, mtl="newmtl skin\nmap_Kd skin.png\nnewmtl two\nmap_Kd skin.png\n")
    path = tmp_path / "quad.obj"
    path.write_text(path.read_text().replace("f 1/2 3/4", "usemtl two\nf 1/2 3/4"))
    first, second = eg.load_scene(path).meshes
    assert first.texture is second.texture and Image.open(tmp_path / "skin.png").size == (2, 2)


# -- images ------------------------------------------------------------------------------------------------------------

STORED = np.random.default_rng(5).integers(0, 256, (4, 5, 4), dtype=np.uint8)


@pytest.mark.parametrize(
    "mode, channels",
    [("1", 1), ("L", 1), ("LA", 2), ("P", 3), ("RGB", 3), ("RGBA", 4), ("I;16", 1)],
)
def test_modes_of_png_and_tiff(tmp_path, mode, channels):
    """Also as textures, where alpha is dropped."""
    if mode == "I;16":
        image = Image.fromarray(np.random.default_rng(6).integers(0, 65536, (4, 5), dtype=np.uint16))
        values = np.asarray(image)[..., None] / 257.0
    else:
        image = Image.fromarray(STORED).convert("RGB").convert(mode) if mode != "RGBA" else Image.fromarray(STORED)
        if mode == "LA":
            image.putalpha(Image.fromarray(STORED[..., 3]))
        values = np.asarray(image.convert({"P": "RGB", "1": "L"}.get(mode, mode)), np.float64).reshape(4, 5, -1)
    colors = channels - (channels in (2, 4))
    expected = np.concatenate([linear(values[..., :colors]), values[..., colors:] / 255.0], -1)
    for suffix in ("png", "tif"):
        image.save(tmp_path / f"a.{suffix}")
        found = eg.read_image(tmp_path / f"a.{suffix}")
        assert found.shape == (4, 5, channels)
        # Pillow writes the 16-bit palette of a TIFF as 256 times the byte, not 257.
        loose = mode == "P" and suffix == "tif"
        np.testing.assert_allclose(found.numpy(), expected, atol=0.01 if loose else 1e-6)
    material = {"images": [{"bufferView": 3}], "textures": [{"source": 0}], "extra": [saved("PNG", image)]}
    mesh = eg.load_mesh(write(tmp_path, "a.glb", square_glb(TEXTURED, uv=True, **material)))
    np.testing.assert_allclose(mesh.texture.numpy(), np.broadcast_to(expected[..., :colors], (4, 5, 3)), atol=1e-6)
