"""Normals, lights and cameras from glTF files."""

import math

import numpy as np
import pytest
import torch
from lit_gltf import CAMERAS, TURN, file, loaded
from mesh_files import SQUARE, TRIANGLES, changed, glb

import edgegrad as eg

TILTED = np.array([[0, 0, 0], [1, 0, 1], [1, 1, 1], [0, 1, 0]], "<f4")


@pytest.mark.parametrize("scale", [[2, 1, 1], [-1, 1, 0.5], [3, 0.2, -2]])
def test_normals_follow_their_nodes(tmp_path, scale):
    """A plane's normals stay those of the plane, also where it is stretched and mirrored."""
    normals = {"NORMAL": np.array([[-(2**-0.5), 0, 2**-0.5]] * 4, "<f4")}
    node = {"mesh": 0, "scale": scale, "rotation": [0.5, 0.5, 0.5, 0.5], "translation": [1, 2, 3]}
    mesh = loaded(tmp_path, {}, positions=TILTED, nodes=[node], attributes=normals)
    assert mesh.normal_faces is None
    np.testing.assert_allclose(mesh.normals, mesh.vertex_normals(), atol=1e-6)


def test_normals_that_differ_at_a_vertex(tmp_path):
    """Two triangles share an edge and have vertices and normals of their own. Positions are welded, normals are not."""
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
    assert (
        isinstance(point, eg.lights.PointLight)
        and isinstance(sun, eg.lights.DirectionalLight)
        and isinstance(spot, eg.lights.SpotLight)
    )
    np.testing.assert_allclose(point.position, [9, 0, 0], atol=1e-6)
    assert float(point.intensity) == 5.0 and point.color.tolist() == [1.0, 0.5, 0.25]
    np.testing.assert_allclose(sun.direction, [0, 0, 1], atol=1e-6)
    assert float(sun.intensity) == 1.0 and sun.color.tolist() == [1, 1, 1]
    np.testing.assert_allclose(spot.position, [5, 6, 7])
    np.testing.assert_allclose(spot.direction / spot.direction.norm(), [0, 0, -1], atol=1e-6)
    numbers = float(spot.inner_angle), float(spot.outer_angle), float(spot.intensity)
    assert numbers == pytest.approx((0.1, 0.6, 2.0), rel=1e-7)
    assert second.position.tolist() == [0, 0, 0]
    lights[2].pop("spot")
    spot = eg.load_scene(file(tmp_path, nodes=nodes, roots=[0, 3, 4], lights=lights), lit=True).lights[2]
    assert (float(spot.inner_angle), float(spot.outer_angle)) == (0.0, pytest.approx(math.pi / 4))


@pytest.mark.parametrize(
    ("light", "fault"),
    [
        ({"type": "area", "name": "panel"}, "expected a light of type directional, point or spot, got 'area'"),
        ({"type": "spot", "name": "emitter", "spot": {"outerConeAngle": -1.0}}, "inner_angle: expected 0 ≤"),
        ({"type": "point", "intensity": math.nan}, "intensity"),
        ({"type": "point", "color": "red"}, ""),
    ],
)
def test_light_faults(tmp_path, light, fault):
    """A light that cannot be read is left out and named. The others are read."""
    nodes = [{"mesh": 0}, *({"extensions": {"KHR_lights_punctual": {"light": k}}} for k in (0, 1))]
    path = file(tmp_path, nodes=nodes, roots=[0, 1, 2], lights=[light, {"type": "point", "intensity": 3.0}])
    with pytest.warns(UserWarning, match=rf"a\.glb: .*light .* \(left out: {fault}"):
        scene = eg.load_scene(path, lit=True)
    assert [float(light.intensity) for light in scene.lights] == [3.0]
    eg.load_scene(path)  # which reads none


def test_the_transformation_of_a_skinned_node_does_not_count(tmp_path):
    nodes = [
        {"mesh": 0, "skin": 0, "translation": [5, 0, 0], "children": [1]},
        {"mesh": 0, "translation": [0, 0, 1]},
        {"mesh": 0, "skin": 0, "translation": [0, 7, 0]},  # not in the scene
    ]
    joints = [{"joints": [1]}]
    bound = {"JOINTS_0": np.zeros((4, 4), "u1"), "WEIGHTS_0": np.tile(np.array([1, 0, 0, 0], "<f4"), (4, 1))}
    used = ["EXT_mesh_gpu_instancing"]
    path = file(tmp_path, nodes=nodes, roots=[0], skins=joints, extensionsUsed=used, attributes=bound)
    with pytest.warns(UserWarning, match=r"EXT_mesh_gpu_instancing \(shown once\); skins \(shown in the pose"):
        scene = eg.load_scene(path)
    places = sorted(mesh.verts.mean(0).round().tolist() for mesh in scene.meshes)
    center = torch.as_tensor(SQUARE).float().mean(0)
    expected = sorted((center + torch.tensor(shift)).round().tolist() for shift in ([0.0, 0, 0], [5.0, 0, 1]))
    assert places == expected


def test_what_lies_below_a_camera_is_read(tmp_path):
    """trimesh leaves out what a node with a camera holds."""
    cameras = [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1, "aspectRatio": 1.0}}]
    nodes = [{"camera": 0, "translation": [0, 0, 5], "children": [1]}, {"mesh": 0}]
    scene = eg.load_scene(file(tmp_path, nodes=nodes, roots=[0], cameras=cameras))
    np.testing.assert_allclose(scene.meshes[0].verts[:, 2], 5.0)


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
