"""One warning names what a text format holds and nobody reads, but nothing that is left out on purpose."""

import pytest
from mesh_files import GOOD, OFF, SQUARE, STL, TRIANGLES, binary_stl, ply, ply_header, quietly, write, write_obj

import edgegrad as eg

pytestmark = pytest.mark.unsanitized

VERTS = "0 0 0\n1 0 0\n0 1 0\n"


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
        "a.ply", ply_header("property float intensity\n") + "0 0 0 1\n1 0 0 1\n0 1 0 1\n3 0 1 2\n", "intensity of vertex",
    ),
    "PLY, a colour": (
        "a.ply",
        ply_header("".join(f"property uchar specular_{c}\n" for c in ("red", "green", "blue")))
        + "0 0 0 1 2 3\n1 0 0 1 2 3\n0 1 0 1 2 3\n3 0 1 2\n",
        "specular_red, specular_green, specular_blue of vertex",
    ),
    "PLY, two colours": (
        "a.ply", ply(SQUARE, TRIANGLES, [[1, 2, 3]] * 4, [[1, 2, 3]] * 2), r"red, green, blue of face \(not read\)",
    ),
    "PLY, face": ("a.ply", ply_header("", LABEL) + VERTS + "3 0 1 2 7\n", "label of face"),
    "PLY, element": (
        "a.ply", ply_header("", more="element edge 1\nproperty int vertex1\nproperty int vertex2\n") + VERTS + "3 0 1 2\n0 1\n",
        r"element edge \(not read\)",
    ),
    "PLY, numbers": ("a.ply", ply_header("") + VERTS + "3 0 1 2\n7 8\n", r"2 numbers after the last element \(not read\)"),
    "PLY, bytes": ("a.ply", ply(SQUARE, TRIANGLES, binary=True) + b"abc", r"3 bytes after the last element \(not read\)"),
    "STL, attributes": ("a.stl", binary_stl(31), r"the attributes of faces, where some writers keep colours"),
    "STL, a colour": ("a.stl", binary_stl(name=b"COLOR=\xff\0\0\xff"), r"COLOR= of the header \(a colour by Mat"),
    "STL, no number": (
        "a.stl", binary_stl()[:80] + bytes(4) + binary_stl()[84:], r"0 as the number of faces \(2, by the length",
    ),
    "STL, bytes": ("a.stl", binary_stl() + b"a", r"1 bytes after the last of 2 faces"),
    "STL, keyword": ("a.stl", STL.replace("endfacet", "tint 3\nendfacet"), r"tint \(not read\)"),
    "OFF, vertex": ("a.off", OFF.replace("0 0 0", "0 0 0 9").replace("1 0 0", "1 0 0 9"), "1 more numbers of each vertex"),
    "OFF, colour map": ("a.off", OFF.replace("3 0 1 2", "3 0 1 2 5"), "colours of faces"),
    "OFF, lines": ("a.off", OFF + "3 2 1 0\n", "1 lines after the last face"),
    "MTL, keyword": ("quad.obj", textured("newmtl skin\nKd 1 0 0\nglow 3\n"), r"glow \(left out\)"),
    "MTL, no such material": ("quad.obj", textured("newmtl other\nKd 1 0 0\n"), "usemtl skin "),
    "MTL, spectrum": ("quad.obj", textured("newmtl skin\nKd spectral red.rfl 1\n"), r"Kd spectral red\.rfl 1 \(not read\)"),
}  # fmt: skip


@pytest.mark.parametrize("case", UNREAD)
def test_what_nobody_reads_is_named_once(tmp_path, case):
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
        ("a.ply", ply_header(SCANNED) + "0 0 0 0 0 1 9 1\n1 0 0 0 0 1 9 1\n0 1 0 0 0 1 9 1\n3 0 1 2\n"),
        ("quad.obj", textured("newmtl skin\nKa 1 1 1\nKd 1 1 1\nKs 1 1 1\nNs 9\nNi 1.5\nd 0.9\nTf 1 0 0\nmap_Bump b\n")),
    ],
)  # fmt: skip
def test_what_is_left_out_on_purpose_is_not_named(tmp_path, name, content):
    quietly(content(tmp_path) if callable(content) else write(tmp_path, name, content))


def test_what_a_lit_scene_leaves_out_is_named(tmp_path):
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
