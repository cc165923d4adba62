"""Materials from OBJ and other formats."""

import numpy as np
import pytest
import torch
from lit_gltf import shown
from mesh_files import SQUARE, TEXELS, TRIANGLES, linear, ply, write_obj
from PIL import Image

import edgegrad as eg


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
