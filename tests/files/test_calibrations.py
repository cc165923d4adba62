"""Calibrations of OpenCV, ROS and Kalibr land points where OpenCV does, by files that the tests write."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from test_conventions import POINTS, SHIFT, SIZE, R, agree

import edgegrad as eg

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # those that are expected are caught
F64 = torch.float64
K = np.array([[60.0, 0, 30], [0, 55, 25], [0, 0, 1]])
H, W = SIZE


@pytest.mark.parametrize("ending", ["yml", "xml"])
@pytest.mark.parametrize("fisheye", [0, 1])
def test_opencv(tmp_path, ending, fisheye) -> None:
    file = tmp_path / f"calibration.{ending}"
    distortion = np.array([[0.05, -0.02, 0.01, -0.015]])
    rvec = cv2.Rodrigues(R.numpy())[0]
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in {
        "image_width": W, "image_height": H, "camera_matrix": K, "distortion_coefficients": distortion,
        "fisheye_model": fisheye, "extrinsic_parameters": np.array([[*rvec[:, 0], *SHIFT], [0, 0, 0, 0, 0, 9.0]]),
    }.items():  # fmt: skip
        storage.write(key, value)
    storage.release()
    views = eg.load_cameras(file, dtype=F64)
    assert list(views) == ["view 0", "view 1"] and views["view 0"].camera.size == SIZE
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    theirs, _ = project(POINTS.numpy()[:, None], rvec, SHIFT.numpy(), K, distortion[0])
    agree(views["view 0"].camera.project(POINTS) - 0.5, torch.from_numpy(theirs[:, 0]), 1e-8)


def storage(file: Path, **fields: object) -> Path:
    written = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in fields.items():
        written.write(key, value)
    written.release()
    return file


@pytest.mark.parametrize("ending", ["yml", "xml"])
@pytest.mark.parametrize("mode", [0, cv2.FILE_STORAGE_BASE64])
def test_vectors_and_binary_data_of_opencv(tmp_path, ending, mode) -> None:
    """Vectors have sizes in place of rows and columns."""
    file = tmp_path / f"a.{ending}"
    written = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE | mode)
    bent = np.array([0.05, -2e-5, 1e-20, -0.015])
    for key, value in {"camera_matrix": K, "distortion_coefficients": bent, "tilt": np.zeros(2)}.items():
        written.write(key, value)
    written.release()
    camera = eg.load_cameras(file, SIZE, dtype=F64)["camera"].camera
    assert torch.equal(camera.K, torch.from_numpy(K) + torch.tensor([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]))
    assert camera.distortion is not None and camera.distortion.tolist() == bent.tolist()


SECOND = np.array([[70.0, 0, 28], [0, 65, 27], [0, 0, 1]])
BENT = np.array([[0.05, -0.02, 0.01, -0.015, 0.002]])


def lands(
    camera: eg.Camera, R: np.ndarray, t: np.ndarray, K: np.ndarray, bent: np.ndarray | None, fisheye=False
) -> None:
    """Check that points land where OpenCV says."""
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    points = (POINTS + SHIFT).numpy()[:, None]
    theirs, _ = project(points, cv2.Rodrigues(R)[0], np.asarray(t, np.float64).reshape(3, 1), K, bent)
    agree(camera.project(POINTS + SHIFT) - 0.5, torch.from_numpy(theirs[:, 0]), 1e-8)


def test_a_stereo_pair_of_opencv(tmp_path) -> None:
    """stereoCalibrate returns x₂ = R x₁ + T, in one file or in the two of OpenCV's example."""
    lenses = {"M1": K, "D1": BENT, "M2": SECOND, "D2": 0.5 * BENT}
    T = np.array([[-0.3], [0.02], [0.01]])
    place = {"R": R.numpy(), "T": T}
    more = {"R1": np.eye(3), "R2": np.eye(3), "P1": np.ones((3, 4)), "P2": np.ones((3, 4)), "Q": np.eye(4), "rms": 0.3}
    one = storage(tmp_path / "stereo.yml", **lenses, **place, **more, image_width=W, image_height=H)
    storage(tmp_path / "extrinsics.xml", **place, **more)
    two = storage(tmp_path / "intrinsics.xml", **lenses)
    vector = storage(tmp_path / "vector.yml", **lenses, R=cv2.Rodrigues(R.numpy())[0], T=T.T)
    for file, size in ((one, None), (two, SIZE), (vector, SIZE)):
        views = eg.load_cameras(file, size=size, dtype=F64)
        assert list(views) == ["M1", "M2"] and views["M2"].camera.size == SIZE
        lands(views["M1"].camera, np.eye(3), np.zeros(3), K, BENT)
        lands(views["M2"].camera, R.numpy(), T, SECOND, 0.5 * BENT)
    alone = storage(tmp_path / "alone.yml", K1=K, K2=SECOND)
    with pytest.warns(
        UserWarning, match=r"alone\.yml: .* the pose of K2 \(R and T are not there, so it stands where the"
    ):
        views = eg.load_cameras(alone, size=SIZE, dtype=F64)
    lands(views["K2"].camera, np.eye(3), np.zeros(3), SECOND, None)
    with pytest.raises(
        ValueError, match=r"extrinsics\.xml: .* got how a pair stands alone; name the file of its intrinsics"
    ):
        eg.load_cameras(tmp_path / "extrinsics.xml", size=SIZE)


ROS = f"""\
image_width: {W}
image_height: {H}
camera_name: head/left  # Jos\u00e9
camera_matrix:
  rows: 3
  cols: 3
  data: [60, 0, 30, 0, 55, 25, 0, 0, 1]
distortion_model: MODEL
distortion_coefficients:
  rows: 1
  cols: COUNT
  data: DATA
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [60, 0, 30, SHIFT, 0, 55, 25, 0, 0, 0, 1, 0]
"""


def ros(model: str, data: list[float], shift: float = 0.0) -> str:
    numbers = str(data).replace("0.002", "2e-3")  # which YAML 1.1 takes for text
    return (
        ROS.replace("MODEL", model)
        .replace("COUNT", str(len(data)))
        .replace("DATA", numbers)
        .replace("SHIFT", str(shift))
    )


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_ros(tmp_path, model) -> None:
    data = (
        [*BENT[0].tolist(), *[0.01, 0.02, -0.01] * (model[0] == "r")]
        if model != "equidistant"
        else [0.05, -0.02, 0.01, 0.002]
    )
    file = tmp_path / "head.yaml"
    file.write_text(ros(model, data), encoding="latin-1")
    ((name, view),) = eg.load_cameras(file, dtype=F64).items()
    assert name == "head/left" and view.camera.size == SIZE
    lands(view.camera, np.eye(3), np.zeros(3), K, np.array(data), model == "equidistant")
    file.write_text(ros(model, data, -6.0))
    with pytest.warns(UserWarning, match=r"the projection matrix's shift to the other camera \(this one stands at the"):
        eg.load_cameras(file)
    file.write_text(ros("thin_prism", data))
    with pytest.raises(ValueError, match=r"distortion_model: expected one of plumb_bob, .* got 'thin_prism'"):
        eg.load_cameras(file)


def test_camera_info_as_a_topic_prints_it(tmp_path) -> None:
    file = tmp_path / "info.yaml"
    matrices = "K: [60, 0, 30, 0, 55, 25, 0, 0, 1]\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nP: [60, 0, 30, 0, 0, 55, 25, 0, 0, 0, 1, 0]\n"
    roi = "binning_x: 0\nroi: {x_offset: 0, do_rectify: false}\n"
    head = f"header: {{seq: 3}}\nheight: {H}\nwidth: {W}\ndistortion_model: plumb_bob\nD: {BENT[0].tolist()}\n"
    whole = head + matrices + roi
    # `ros2 topic echo` ends each message by ---, and is ended by Ctrl-C in the middle of one.
    for text in (whole, f"{whole}---\n", f"---\n{whole}---\n{whole.replace('60', '70')}---\nheader: {{seq"):
        file.write_text(text)
        lands(eg.load_cameras(file, dtype=F64)["camera"].camera, np.eye(3), np.zeros(3), K, BENT)
    file.write_text(head + matrices + roi.replace("binning_x: 0", "binning_x: 2"))
    with pytest.warns(UserWarning, match=r"binning_x \(left out\)$"):
        eg.load_cameras(file)


def chain(tmp_path: Path, **changes: object) -> Path:
    """Write three cameras, the last before the second. The world is that of the first one."""
    step = np.eye(4)
    step[:3, :3], step[:3, 3] = R.numpy(), [-0.3, 0.02, 0.01]
    usual = {"camera_model": "pinhole", "resolution": [W, H], "rostopic": "/cam", "cam_overlaps": [1]}
    first = {
        **usual,
        "intrinsics": [60.0, 55.0, 30.0, 25.0],
        "distortion_model": "radtan",
        "distortion_coeffs": [0.05, -0.02, 0.01, -0.015],
    }
    second = {**first, "intrinsics": [70.0, 65.0, 28.0, 27.0], "T_cn_cnm1": step.tolist(), **changes}
    aside = np.eye(4)
    aside[:3, :3], aside[:3, 3] = R.numpy().T, [0.1, 0.2, 0.3]
    third = {**first, "distortion_model": "equidistant", "T_cn_cnm1": aside.tolist()}
    file = tmp_path / "camchain.yaml"
    cameras = {"cam0": first, "cam10": third, "cam2": second}
    file.write_text(
        yaml.safe_dump({name: {k: v for k, v in one.items() if v is not None} for name, one in cameras.items()})
    )
    return file


def test_kalibr(tmp_path) -> None:
    views = eg.load_cameras(chain(tmp_path), dtype=F64)
    assert list(views) == ["cam0", "cam2", "cam10"] and all(view.camera.size == SIZE for view in views.values())
    shift = np.array([-0.3, 0.02, 0.01])
    lands(views["cam0"].camera, np.eye(3), np.zeros(3), K, BENT[:, :4])
    lands(views["cam2"].camera, R.numpy(), shift, SECOND, BENT[:, :4])
    lands(views["cam10"].camera, np.eye(3), R.numpy().T @ shift + [0.1, 0.2, 0.3], K, BENT[:, :4], True)
    with pytest.warns(UserWarning, match=r"T_cam_imu \(poses are those to the first camera\)$"):
        eg.load_cameras(chain(tmp_path, T_cam_imu=np.eye(4).tolist()))
    with pytest.warns(UserWarning, match=r"cam2 without T_cn_cnm1 \(it stands where cam0 does\)"):
        eg.load_cameras(chain(tmp_path, T_cn_cnm1=None))


@pytest.mark.parametrize(
    "changes, fault",
    [
        ({"camera_model": "omni"}, "cam2: camera_model: expected pinhole, got 'omni'; undistort"),
        (
            {"distortion_model": "fov"},
            "cam2: distortion_model: expected one of radtan, none, equidistant, equi, got 'fov'",
        ),
        ({"intrinsics": None}, "cam2: intrinsics: expected this key, got only"),
        ({"intrinsics": [1.0, 2.0]}, "cam2: intrinsics: expected 1 × 4 numbers, got 1 × 2"),
        ({"resolution": [float("inf"), 3]}, "cam2: size: expected whole numbers of pixels, got width inf"),
        ({"resolution": "wide"}, "cam2: resolution: expected a matrix"),
        ({"T_cn_cnm1": np.diag([2.0, 2, 2, 1]).tolist()}, "cam2: R: expected a rotation"),
    ],
)
def test_faults_of_kalibr_are_named(tmp_path, changes, fault) -> None:
    with pytest.raises(ValueError, match=rf"camchain\.yaml: {fault}"):
        eg.load_cameras(chain(tmp_path, **changes))


def test_yaml_of_python(tmp_path) -> None:
    """Matrices are lists of rows, as tutorials write them. The rest is named."""
    file = tmp_path / "mine.yaml"
    fields = {"camera_matrix": K.tolist(), "dist_coeff": BENT.tolist(), "image_size": [W, H], "square_size": 0.02}
    file.write_text(yaml.safe_dump(fields))
    lands(eg.load_cameras(file, dtype=F64)["camera"].camera, np.eye(3), np.zeros(3), K, BENT)
    file.write_text(
        yaml.safe_dump({**fields, "K": SECOND.tolist(), "rvecs": [[0.1, 0.2, 0.3]], "note": "", "lens": "wide"})
    )
    with pytest.warns(UserWarning, match=r"mine\.yaml: .*: K \(left out\); lens \(left out\); rvecs \(left out\)$"):
        eg.load_cameras(file)
    with pytest.warns(UserWarning, match=r"tilt \(left out\)$"):
        eg.load_cameras(storage(tmp_path / "tilt.yml", K=K, tilt=np.ones(2)), size=SIZE)
    with pytest.raises(ValueError, match=r"xi: expected none, got a lens of cv2\.omnidir"):
        eg.load_cameras(storage(tmp_path / "omni.yml", K=K, xi=1.2), size=SIZE)


@pytest.mark.parametrize("name", ["a.yaml", "a.yml"])
def test_missing_libraries_are_asked_for(tmp_path, monkeypatch, name) -> None:
    (tmp_path / "a.yaml").write_text(yaml.safe_dump({"K": K.tolist(), "size": [W, H], "resolution": 0.1}))
    storage(tmp_path / "a.yml", K=K)
    with pytest.warns(UserWarning, match=r"resolution \(left out\)$"):
        assert eg.load_cameras(tmp_path / "a.yaml")["camera"].camera.size == SIZE
    monkeypatch.setitem(sys.modules, "yaml", None)
    with pytest.raises(ImportError, match=r"pip install 'edgegrad\[cameras\]'"):
        eg.load_cameras(tmp_path / name, size=SIZE)


@pytest.mark.parametrize(
    "text, fault",
    [
        ("nothing of the kind", "expected YAML or XML of keys and values, got str"),
        ("a: [1, 2", "expected YAML, got a file that PyYAML does not read"),
        ("a: " + "[" * 500, "expected YAML, got a file that PyYAML does not read"),
        ("camera_matrix: {rows: 3, cols: 3, data: [1, 2]}", "camera_matrix: expected a matrix"),
        ("camera_matrix: {rows: .inf, cols: 3, data: [1, 2]}", "camera_matrix: expected a matrix"),
        ("camera_matrix: {rows: 3, cols: -3, data: [1, 0, 2, 0, 1, 2, 0, 0, 1]}", "camera_matrix: expected a matrix"),
        ("camera_matrix: [[1, x, 3]]", "camera_matrix: expected a matrix"),
        ("camera_matrix: [1, 2, 3]\nimage_size: [4, 5]", "K: expected shape"),
        ("camera_matrix: [1, 0, 2, 0, 1, 2, 0, 0, 1]\nimage_size: [4, .nan]", "size: expected whole numbers"),
        (
            "model_type: MEI\nmirror_parameters: {xi: 2}",
            "camera_matrix: expected this key, .* got model_type, mirror_p",
        ),
        ("r: &r [" + "1, " * 2000 + "1]\nK: [" + "*r, " * 600 + "*r]", "K: expected a matrix"),
    ],
)
def test_faults_of_yaml_are_named(tmp_path, text, fault) -> None:
    file = tmp_path / "a.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=rf"a\.yaml: {fault}"):
        eg.load_cameras(file)


def test_opencv_faults(tmp_path) -> None:
    file = tmp_path / "a.yml"
    for text, fault in (
        ("nothing of the kind", "a.yml: expected YAML or XML|camera_matrix: expected this key"),
        ("%YAML:1.0\n---\ncamera_matrix: 3\n", "camera_matrix: expected a matrix"),
        ("%YAML:1.0\n---\nother: 3\n", "camera_matrix: expected this key"),
    ):
        file.write_text(text)
        with pytest.raises(ValueError, match=fault):
            eg.load_cameras(file)
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("K", K)
    storage.release()
    with pytest.raises(ValueError, match=r"image_width: .* pass size="):
        eg.load_cameras(file)
    assert eg.load_cameras(file, size=SIZE)["camera"].camera.size == SIZE


def test_files_that_end_opencv_s_reader_are_refused_by_name(tmp_path) -> None:
    """OpenCV reads sizes that do not match past the end of its memory, and deep files past that of its stack."""
    values = (None, ".Nan", "-3", "3000000", "4294967297", "1e99", "'3'")
    wrong = [(field, value) for field in ("rows", "cols") for value in values]
    wrong += [("dt", value) for value in ("x", "2d", "99d", "-1d", "7")]
    contents = []
    for ending in ("yml", "xml"):
        whole = storage(tmp_path / f"whole.{ending}", image_width=W, image_height=H, camera_matrix=K).read_text()
        for field, value in wrong:
            line = re.compile(rf"( *{field}:).*\n" if ending == "yml" else rf"( *<{field}>).*\n")
            end = "" if ending == "yml" else f"</{field}>"
            contents.append((ending, line.sub("" if value is None else rf"\1 {value}{end}\n", whole, count=1)))
            assert contents[-1][1] != whole
    for deep in ("[" * 200000, "{a: " * 200000, "- " * 200000, "\n" + "\n".join(" " * i + "a:" for i in range(2000))):
        contents.append(("yml", f"%YAML:1.0\n---\ncamera_matrix: {deep}"))
    for depth in (700, 200000):  # deeper than Python goes, and than OpenCV
        contents.append(
            ("xml", f"<?xml version='1.0'?><opencv_storage>{'<a>' * depth}{'</a>' * depth}</opencv_storage>")
        )
    for ending, content in contents:
        file = tmp_path / f"a.{ending}"
        file.write_text(content)
        with pytest.raises(
            ValueError, match=rf"^{re.escape(str(file))}: (camera_matrix: expected |expected YAML|expected XML)"
        ):
            eg.load_cameras(file)
