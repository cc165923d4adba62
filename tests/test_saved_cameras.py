"""Cameras in and out of edgegrad's own files."""

import json

import numpy as np
import pytest
import torch

from edgegrad.camera.camera import Camera
from edgegrad.files.cameras import load_camera, save_camera


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
