"""Cameras in and out of edgegrad's own files."""

import json
import struct

import numpy as np
import pytest
import torch

from edgegrad.camera.camera import Camera
from edgegrad.files.cameras import load_camera, load_cameras, save_camera

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]


def test_camera_round_trip(tmp_path):
    eye = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    camera = Camera.look_at(eye, (0.0, 0.0, 0.0), fov_y=33.3, size=(120, 200))
    save_camera(tmp_path / "c.json", camera)
    back = load_camera(tmp_path / "c.json", dtype=torch.float64)
    assert torch.equal(back.world_to_camera, camera.world_to_camera) and torch.equal(back.K, camera.K)
    assert back.size == (120, 200) and back.projection == "perspective"
    assert load_camera(tmp_path / "c.json").K.dtype == torch.float32
    flat = Camera.orthographic((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), size=(8, 9))
    save_camera(tmp_path / "b.json", Camera.stack([flat, flat]))
    assert load_camera(tmp_path / "b.json").batch == 2
    assert load_camera(tmp_path / "b.json").projection == "orthographic"


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"K": None}, "K: expected this key"),
        ({"K": [[1, 0], [0, 1]]}, r"K: expected shape \(3, 3\)"),
        ({"K": [[1, 0, 0], [0, 1], [0, 0, 1]]}, "K: expected rows of numbers"),
        ({"K": "identity"}, "K: expected rows of numbers"),
        ({"world_to_camera": np.diag([2.0, 2, 2, 2]).tolist()}, "world_to_camera: expected the last row"),
        ({"size": 5}, r"size: expected \[height, width\]"),
        ({"size": [0, 5]}, "size: expected an int from 1"),
        ({"projection": "fish"}, "projection: expected"),
        ({"colour": 1}, "colour: expected only the keys"),
        (b"{", "Expecting"),
        (b"[]", "expected a JSON object"),
        (b"\xff\xfe\x00", "codec"),
        (b"", "an empty file"),
    ],
)
def test_camera_faults(tmp_path, change, fault):
    path = tmp_path / "c.json"
    if isinstance(change, bytes):
        path.write_bytes(change)
    else:
        save_camera(path, Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0)))
        fields = {**json.loads(path.read_text()), **change}
        path.write_text(json.dumps({key: value for key, value in fields.items() if value is not None}))
    with pytest.raises(ValueError, match=fault) as caught:
        load_camera(path)
    assert str(caught.value).startswith(str(path))


def test_camera_path_faults(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"gone\.json"):
        load_camera(tmp_path / "gone.json")
    camera = Camera.look_at((0.0, 0.0, 3.0), (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"c\.txt: expected a file name that ends in \.json"):
        save_camera(tmp_path / "c.txt", camera)
    save_camera(tmp_path / "new" / "c.json", camera)
    assert load_camera(tmp_path / "new" / "c.json").size == camera.size
    with pytest.raises(TypeError, match="camera: expected a Camera, got dict"):
        save_camera(tmp_path / "c.json", {})


EYES = np.array([[500000.3, 4600000.3, 4.0], [500003.1, 4600001.7, 5.2]])  # of a map, in metres


def written(folder, kind, eyes):
    """Write a file of cameras at these places that look down, by hand."""
    if kind == "save_camera":
        poses = np.stack([np.diag([1.0, -1, -1, 1])] * len(eyes))
        poses[:, :3, 3] = -(eyes * [1, -1, -1])
        fields = {"world_to_camera": poses.tolist(), "K": [[60, 0, 32], [0, 60, 24], [0, 0, 1]], "size": [48, 64]}
        (folder / "a.json").write_text(json.dumps(fields))
        return folder / "a.json"
    poses = np.stack([np.eye(4)] * len(eyes))
    poses[:, :3, 3] = eyes
    if kind == "transforms.json":
        frames = [{"transform_matrix": pose.tolist()} for pose in poses]
        (folder / kind).write_text(json.dumps({"w": 64, "h": 48, "fl_x": 60, "frames": frames}))
        return folder / kind
    if kind == "glTF":
        nodes = [{"camera": 0, "matrix": pose.T.ravel().tolist()} for pose in poses]
        cameras = [{"type": "perspective", "perspective": {"yfov": 0.6, "znear": 0.1}}]
        tree = {
            "asset": {"version": "2.0"},
            "nodes": nodes,
            "cameras": cameras,
            "scenes": [{"nodes": [*range(len(eyes))]}],
        }
        (folder / "a.gltf").write_text(json.dumps({**tree, "scene": 0}))
        return folder / "a.gltf"
    (folder / "cameras.bin").write_bytes(struct.pack("<QiiQQ4d", 1, 1, 1, 64, 48, 60, 60, 32, 24))
    images = b"".join(
        struct.pack("<I7dI", i, 0, 1, 0, 0, *-(eye * [1, -1, -1]), 1) + b"%d.png\0" % i + bytes(8)
        for i, eye in enumerate(eyes)
    )
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(eyes)) + images)
    return folder


@pytest.mark.parametrize("kind", ["save_camera", "transforms.json", "glTF", "COLMAP"])
@pytest.mark.parametrize("count", [1, 2])
def test_eyes_in_coordinates_of_a_map_stay_where_they_are(tmp_path, kind, count):
    file, size = written(tmp_path, kind, EYES[:count]), (48, 64) if kind == "glTF" else None
    views = list(load_cameras(file, size).values())
    assert all(view.camera.K.dtype == view.camera.world_to_camera.dtype == torch.float64 for view in views)
    np.testing.assert_array_equal([view.camera.eye.tolist() for view in views], EYES[:count])
    with pytest.warns(UserWarning, match=r"eyes in float64 \(moved by up to 0\.2, for they are rounded to float32"):
        assert all(
            view.camera.K.dtype == torch.float32 for view in load_cameras(file, size, dtype=torch.float32).values()
        )
    if kind in ("save_camera", "glTF"):
        one = load_camera(file, size=size)
        np.testing.assert_array_equal(one.eye.reshape(-1, 3)[0].numpy(), EYES[0])
        with pytest.warns(UserWarning, match="eyes in float64"):
            assert load_camera(file, torch.float32, size).K.dtype == torch.float32


@pytest.mark.filterwarnings("error::UserWarning")
def test_cameras_are_as_precise_as_their_file_needs(tmp_path):
    def dtype(*eyes, **asked):
        file = written(tmp_path, "transforms.json", np.array(eyes))
        return {view.camera.eye.dtype for view in load_cameras(file, **asked).values()}

    near = (0.1, -1.3, 3.7)
    assert dtype(near) == dtype(near, (3.1, 0.2, 0.9)) == dtype((100.3, 3.7, 0.1)) == {torch.float32}
    assert dtype(near, dtype=torch.float32) == {torch.float32} and dtype(near, dtype=torch.float64) == {torch.float64}
    assert dtype((9000.3, 3.7, 0.1)) == {torch.float64}  # moved by 3e-4
    # Moved by up to 3e-6: more than a millionth of 0.6, and not of 10.
    assert dtype((50.3, 0, 0), (50.9, 0, 0)) == {torch.float64} and dtype((50.3, 0, 0), (60.3, 0, 0)) == {torch.float32}
    assert dtype((500000.25, 4600000.5, 4.0)) == {torch.float32}  # which floats hold
    with pytest.raises(TypeError, match=r"dtype: expected torch\.float32, torch\.float64 or None, got torch\.float16"):
        dtype(near, dtype=torch.float16)
