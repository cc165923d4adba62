"""BOP: its layout, its results, its errors against plain formulas, its recalls by exact numbers, and poses refined."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from bop_scenes import SIZE, TRUTHS, K, make, meshes, pose

import edgegrad as eg
import edgegrad_cli as cli
from edgegrad import bop
from edgegrad.bop.evaluate import matched

ONE = torch.eye(3, dtype=torch.float64)
CAMERA = eg.Camera.from_opencv(ONE, ONE.new_zeros(3), K.double(), SIZE)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make(tmp_path_factory.mktemp("bop"))


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    """To be spoilt."""
    return Path(shutil.copytree(made, tmp_path / "data"))


def estimates(moved: torch.Tensor | None = None) -> list[bop.Estimate]:
    """The true poses, each followed by a motion in the camera's axes."""
    moved = torch.eye(4, dtype=torch.float64) if moved is None else moved
    return [
        bop.Estimate(3, im_id, obj_id, 0.9 - 0.1 * i, moved @ truth, 1.5)
        for im_id, objects in enumerate(TRUTHS)
        for i, (obj_id, truth) in enumerate(objects)
    ]


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


# -- the layout ------------------------------------------------------------------------------------------------------------


def test_what_is_written_is_read(made: Path) -> None:
    data = bop.Dataset(made)
    assert data.split == "test" and data.objects == [1, 5] and data.scenes == [3] and data.images(3) == [0, 1]
    frame = data.frame(3, 1)
    assert torch.equal(frame.K, K.double()) and frame.camera.size == SIZE
    assert float(frame.camera.K[0, 2]) == 48.0  # centres of pixels at +0.5
    assert [truth.obj_id for truth in frame.truths] == [5, 5] and len(frame.truths_of(1)) == 0
    assert torch.allclose(frame.truths[1].pose, TRUTHS[1][1][1], atol=1e-12) and frame.truths[1].visible == 1.0
    five = data.model(5)
    assert abs(five.diameter - math.sqrt(50**2 + 70**2 + 30**2)) < 1e-3
    assert len(five.symmetries.motions) == 4 and data.model(1).symmetries.trivial
    assert five.points.shape == (8, 3) and five.mesh.channels == 3
    # The picture is the mesh in its pose; depth is its depth, to half a step of 0.1 mm; masks are where it is.
    truth = frame.truths[0].pose
    depth = bop.depth_image(meshes()[5], truth, frame.camera)
    own = frame.mask(0) > 0.5
    assert torch.equal(own, depth > 0) and torch.equal(frame.mask_visible(0) > 0.5, own)
    assert float((frame.depth() - depth)[own].abs().max()) < 0.051
    again = eg.render(five.mesh.transformed(truth[:3, :3], truth[:3, 3]), frame.camera, spp=32)
    inside = torch.nn.functional.max_pool2d(1.0 - own.float()[None, None], 3, 1, 1)[0, 0] == 0
    assert float((frame.picture() - again)[inside].abs().mean()) < 0.004
    assert data.targets() == [bop.Target(3, 0, 1, 1), bop.Target(3, 0, 5, 1), bop.Target(3, 1, 5, 2)]


def test_targets_without_a_list(folder: Path) -> None:
    """What is seen by less than a tenth does not count."""
    (folder / "test_targets_bop19.json").unlink()
    info = folder / "test" / "000003" / "scene_gt_info.json"
    content = json.loads(info.read_text())
    content["1"][0]["visib_fract"] = 0.09
    info.write_text(json.dumps(content))
    assert bop.Dataset(folder).targets() == [bop.Target(3, 0, 1, 1), bop.Target(3, 0, 5, 1), bop.Target(3, 1, 5, 1)]


def test_a_covered_instance(tmp_path: Path) -> None:
    """The nearer plate covers the left half of the other."""
    corners = torch.tensor([[-40.0, -20, 0], [40, -20, 0], [40, 20, 0], [-40, 20, 0]])
    plate = {2: eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.full((2, 3), 0.2))}
    far, near = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    far[2, 3], near[:3, 3] = 400.0, torch.tensor([-50.0, 0.0, 300.0])
    bop.write_models(tmp_path, plate)
    bop.write_scene(tmp_path, 1, [bop.Shot(CAMERA, [(2, far), (2, near)])], plate, split="val", spp=1)
    frame = bop.Dataset(tmp_path).frame(1, 0)
    # 40 / 400 · 120 = 12 px to each side of the middle, at 48; the near one's right rim is at -10 / 300 · 120 = -4 px.
    assert frame.truths[0].visible == pytest.approx(16 / 24) and frame.truths[1].visible == 1.0
    assert int(frame.mask(0).sum()) == 24 * 12 and int(frame.mask_visible(0).sum()) == 16 * 12
    assert frame.depth()[36, 48] == 400.0 and frame.depth()[36, 40] == 300.0 and frame.depth()[0, 0] == 0.0
    info = json.loads((tmp_path / "val" / "000001" / "scene_gt_info.json").read_text())["0"][0]
    assert info["bbox_obj"] == [36, 30, 23, 11] and info["bbox_visib"] == [44, 30, 15, 11]


@pytest.mark.parametrize(
    "spoil, ask, words",
    [
        (lambda f: None, lambda f: bop.Dataset(f / "none"), "none: expected the folder of a BOP data set"),
        (lambda f: None, lambda f: bop.Dataset(f / "models"), "models: expected folders of splits"),
        (lambda f: None, lambda f: bop.Dataset(f, "val"), "expected the split 'val', got test"),
        (lambda f: None, lambda f: bop.Dataset(f).frame(4, 0), "expected scene 4, got 3; choose"),
        (lambda f: None, lambda f: bop.Dataset(f).frame(3, 9), r"scene_camera.json: expected image 9 in it, got 0, 1; "),
        (lambda f: None, lambda f: bop.Dataset(f).model(2), r"models_info.json: expected object 2 in it, got 1, 5; "),
        (lambda f: None, lambda f: bop.Dataset(f).targets("other.json"), "other.json: expected a list of targets"),
        (lambda f: (f / "models" / "models_info.json").unlink(), lambda f: bop.Dataset(f).objects, "models_info.json: expected a file"),
        (lambda f: (f / "models" / "models_info.json").write_text("{"), lambda f: bop.Dataset(f).objects, "expected JSON"),
        (lambda f: (f / "models" / "models_info.json").write_text("[]"), lambda f: bop.Dataset(f).objects, "expected an object"),
        (lambda f: (f / "models" / "models_info.json").write_text('{"a": 1}'), lambda f: bop.Dataset(f).objects, "ids as keys, got 'a'"),
        (lambda f: (f / "models" / "models_info.json").write_text('{"1": {}}'), lambda f: bop.Dataset(f).model(1), "object 1: expected the key 'diameter'"),
        (lambda f: (f / "models" / "obj_000001.ply").unlink(), lambda f: bop.Dataset(f).model(1).mesh, "obj_000001.ply: expected a file"),
        (lambda f: (f / "test/000003/rgb/000000.png").unlink(), lambda f: bop.Dataset(f).frame(3, 0).picture(), "000003: expected 000000.png .* in rgb or gray"),
        (lambda f: (f / "test/000003/depth/000000.png").unlink(), lambda f: bop.Dataset(f).frame(3, 0).depth(), "000003: expected 000000.png .* in depth"),
        (lambda f: None, lambda f: bop.Dataset(f).frame(3, 0).mask(7), "expected 000000_000007.png"),
        (lambda f: (f / "test/000003/scene_gt.json").unlink(), lambda f: bop.Dataset(f).frame(3, 0).truths, "scene_gt.json: expected the poses"),
        (lambda f: (f / "test/000003/scene_gt.json").write_text('{"0": [{"obj_id": 1}]}'), lambda f: bop.Dataset(f).frame(3, 0).truths, "image 0, entry 0: expected the key 'cam_R_m2c', got obj_id"),
        (lambda f: (f / "test/000003/scene_camera.json").write_text('{"0": {"cam_K": [1, 2]}}'), lambda f: bop.Dataset(f).frame(3, 0).K, "image 0, cam_K: expected 9 finite numbers"),
        (lambda f: (f / "test_targets_bop19.json").write_text('[{"scene_id": 3}]'), lambda f: bop.Dataset(f).targets(), "entry 0: expected the key 'im_id'"),
        (lambda f: shutil.copytree(f / "test", f / "test_other"), lambda f: bop.Dataset(f, ""), None),
    ],
)  # fmt: skip
def test_messages(spoil, ask, words, folder: Path) -> None:  # noqa: ANN001
    spoil(folder)
    if words is None:
        assert ask(folder).split == "test"  # the exact name goes first
        return
    with pytest.raises((FileNotFoundError, ValueError), match=words):
        ask(folder)


# -- results -----------------------------------------------------------------------------------------------------------------


def test_results_come_back_to_the_bit(tmp_path: Path) -> None:
    given = estimates(pose((0.1, 0.2, 0.3), (1.0, 2.0, 1 / 3)))
    bop.write_results(tmp_path / "a.csv", given)
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    found = bop.read_results(tmp_path / "a.csv")
    for ours, theirs in zip(found, given, strict=True):
        assert torch.equal(ours.pose, theirs.pose) and ours.seconds == 1.5
        assert (ours.scene_id, ours.im_id, ours.obj_id, ours.score) == (theirs.scene_id, theirs.im_id, theirs.obj_id, theirs.score)
    # By rows; the header and the last newline may be missing.
    (tmp_path / "b.csv").write_text("1, 2,3,0.5,0 -1 0 1 0 0 0 0 1,10 20 30,-1")
    (one,) = bop.read_results(tmp_path / "b.csv")
    assert one.pose.tolist() == [[0, -1, 0, 10], [1, 0, 0, 20], [0, 0, 1, 30], [0, 0, 0, 1]] and one.seconds == -1.0


@pytest.mark.parametrize(
    "line, words",
    [
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,1 2 3", "line 2: expected 7 columns"),
        ("1,x,3,0.5,1 0 0 0 1 0 0 0 1,1 2 3,0", "line 2, im_id: expected a whole number from 0 up, got 'x'"),
        ("1,2,3,high,1 0 0 0 1 0 0 0 1,1 2 3,0", "line 2, score: expected 1 finite number, got 'high'"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0,1 2 3,0", "line 2, R: expected 9 finite numbers"),
        ("1,2,3,0.5,1 0 0 0 1 0 0 0 1,1 2 nan,0", "line 2, t: expected 3 finite numbers"),
        ("1,2,3,0.5,2 0 0 0 1 0 0 0 1,1 2 3,0", "line 2, R: expected a rotation matrix"),
        ("1,2,3,0.5,-1 0 0 0 1 0 0 0 1,1 2 3,0", "line 2, R: expected a rotation matrix .* determinant -1"),
    ],
)  # fmt: skip
def test_wrong_results(line: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{line}\n")
    with pytest.raises(ValueError, match=words):
        bop.read_results(tmp_path / "a.csv")


# -- errors, against plain formulas ------------------------------------------------------------------------------------------

E, T = pose((0.5, -0.3, 0.9), (10.0, -20.0, 400.0)), pose((0.4, -0.2, 1.0), (14.0, -18.0, 410.0))
POINTS = torch.from_numpy(np.random.default_rng(0).uniform(-50, 50, (40, 3)))
TURNS = eg.Symmetries(
    torch.diag(torch.tensor([1.0, -1, -1, 1]))[None], [eg.SymmetryAxis([0.0, 0, 1], [1.0, 2, 0])]
)  # fmt: skip


def moved(motion: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.array([motion[:3, :3] @ p + motion[:3, 3] for p in x])


def test_of_points() -> None:
    a, b, x = E.numpy(), T.numpy(), POINTS.numpy()
    A, B = moved(a, x), moved(b, x)
    assert bop.add(E, T, POINTS) == pytest.approx(np.mean([np.linalg.norm(p - q) for p, q in zip(A, B, strict=True)]), rel=1e-12)
    assert bop.adi(E, T, POINTS) == pytest.approx(np.mean([min(np.linalg.norm(p - q) for p in A) for q in B]), rel=1e-12)
    places = A @ K.double().numpy().T
    worst, pixels = [], []
    S = TURNS.transforms(0.1)
    assert len(S) == 64
    for s in S.numpy():
        C = moved(b @ s, x)
        worst.append(np.linalg.norm(A - C, axis=1).max())
        other = C @ K.double().numpy().T
        pixels.append(np.linalg.norm(places[:, :2] / places[:, 2:] - other[:, :2] / other[:, 2:], axis=1).max())
    assert bop.mssd(E, T, POINTS, S) == pytest.approx(min(worst), rel=1e-12)
    assert bop.mspd(E, T, POINTS, S, CAMERA) == pytest.approx(min(pixels), rel=1e-9)
    # A pose that a symmetry makes the same.
    assert bop.mssd(T @ S[40], T, POINTS, S) < 1e-9 and bop.mspd(T @ S[40], T, POINTS, S, CAMERA) < 1e-9
    assert bop.add(T @ S[40], T, POINTS) > 10.0


def test_many_symmetries_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    S = TURNS.transforms()
    whole = bop.mssd(E, T, POINTS, S), bop.mspd(E, T, POINTS, S, CAMERA)
    monkeypatch.setattr("edgegrad.bop.errors.MOST_POINTS", 100)
    assert whole == (bop.mssd(E, T, POINTS, S), bop.mspd(E, T, POINTS, S, CAMERA))


def test_depth_is_that_of_the_plane() -> None:
    """At the centres of the pixels, in OpenCV's convention of K: n·x = d."""
    corners = torch.tensor([[-60.0, -50, 10], [70, -40, -20], [0, 80, 30]])
    depth = bop.depth_image(eg.Mesh(corners, torch.tensor([[0, 1, 2]])), T, CAMERA)
    a, b, c = (T[:3, :3] @ corners.double().T).T + T[:3, 3]
    n = torch.linalg.cross(b - a, c - a)
    seen = 0
    for y in range(SIZE[0]):
        for x in range(SIZE[1]):
            ray = torch.linalg.inv(K.double()) @ torch.tensor([x, y, 1.0], dtype=torch.float64)
            z = float(n @ a / (n @ ray))
            p = z * ray
            sides = [float(n @ torch.linalg.cross(v - u, p - u)) for u, v in ((a, b), (b, c), (c, a))]
            if abs(min(sides)) / float(n.norm()) ** 2 > 1e-3:  # not right at the rim
                seen += min(sides) > 0
                assert float(depth[y, x]) == pytest.approx(z if min(sides) > 0 else 0.0, rel=1e-6)
    assert seen > 500


def test_depth_of_what_is_not_in_the_image() -> None:
    mesh = meshes()[1]
    for shift in ((5000.0, 0, 400), (0, 0, -400.0), (0, -900.0, 300)):
        assert float(bop.depth_image(mesh, pose((0.1, 0, 0), shift), CAMERA).max()) == 0.0
    assert float(bop.depth_image(mesh, pose((0.1, 0, 0), (0, 0, 5.0)), CAMERA).max()) > 0.0  # the eye is inside


def test_vsd_by_pixels() -> None:
    """Against a loop over pixels; each case of what is seen occurs."""
    random = np.random.default_rng(1)
    size = SIZE
    truth = np.where(random.random(size) < 0.6, random.uniform(400, 440, size), 0.0)
    estimate = np.where(random.random(size) < 0.8, truth + random.normal(0, 12, size), 0.0)
    estimate = np.where(random.random(size) < 0.2, random.uniform(400, 440, size), estimate)
    scene = np.where(random.random(size) < 0.3, 0.0, random.uniform(380, 440, size))
    inverse = np.linalg.inv(K.double().numpy())
    taus, diameter, delta = (0.05, 0.1, 0.3), 100.0, 15.0
    wrong, union = np.zeros(3), 0
    for y in range(size[0]):
        for x in range(size[1]):
            length = np.linalg.norm(inverse @ [x, y, 1])
            e, t, m = estimate[y, x] * length, truth[y, x] * length, scene[y, x] * length
            seen_t = t > 0 and (m == 0 or t <= m + delta)
            seen_e = e > 0 and (m == 0 or e <= m + delta or seen_t)
            union += seen_e or seen_t
            wrong += (seen_e != seen_t) + (seen_e and seen_t) * (abs(e - t) / diameter >= np.array(taus))
    found = bop.vsd(*map(torch.from_numpy, (estimate, truth, scene)), CAMERA, diameter, taus, delta)
    assert found == pytest.approx(wrong / union, abs=1e-12) and found[0] > found[1] > found[2] > 0.1
    nothing = torch.zeros(size)
    assert bop.vsd(nothing, nothing, nothing, CAMERA, diameter, taus) == [1.0, 1.0, 1.0]


@pytest.mark.parametrize(
    "errors, threshold, count",
    [
        ([[1.0, 2.0], [0.5, 3.0]], 4.0, 2),  # the first takes the first, the second what is left
        ([[1.0, 2.0], [0.5, 3.0]], 2.5, 1),
        ([[3.0, 1.0], [0.5, 2.0]], 2.5, 2),
        ([[2.0], [1.0]], 1.5, 1),  # the second, for the first is too far
        ([[1.0]], 1.0, 0),  # below, not at
    ],
)  # fmt: skip
def test_matching(errors: list[list[float]], threshold: float, count: int) -> None:
    assert matched(np.array(errors), threshold) == count


# -- recalls -----------------------------------------------------------------------------------------------------------------


def test_true_poses_are_all_found(made: Path) -> None:
    data = bop.Dataset(made)
    given = estimates()
    flip = data.model(5).symmetries.motions[2]
    for i in (1, 2):  # in another of the poses that look the same
        given[i] = bop.Estimate(3, given[i].im_id, 5, given[i].score, given[i].pose @ flip)
    found = bop.evaluate(data, given, progress=False)
    assert found.overall.ar == 1.0
    assert found.overall.add_s == 1.0 and found.overall.instances == found.overall.estimates == 4
    assert found.overall.degrees < 1e-4 and found.overall.distance < 1e-4
    assert all(row.errors is not None and row.errors.mssd < 1e-4 for row in found.rows)
    assert [row.truth.index for row in found.rows if row.truth] == [0, 1, 0, 1]


def test_recalls_by_exact_numbers(made: Path) -> None:
    """Away from the camera by 0.22 of the diameter of object 1: MSSD and ADD are that long, 0.22 · 115.3 = 25.4 mm."""
    data = bop.Dataset(made)
    shift = 0.22 * data.model(1).diameter
    found = bop.evaluate(data, estimates(pose((1e-12, 0, 0), (0.0, 0.0, shift))), progress=False)
    one = found.objects[1]
    assert one.ar_mssd == pytest.approx(0.6) and one.add_s == 0.0  # 0.25 … 0.5
    assert one.distance == pytest.approx(shift) and one.degrees < 1e-4
    five = found.objects[5]
    ratio = shift / data.model(5).diameter
    assert five.ar_mssd == pytest.approx(sum(0.05 * k > ratio for k in range(1, 11)) / 10)
    row = found.rows[0]
    assert row.errors is not None and row.errors.mssd == pytest.approx(shift) == row.errors.add
    # MSPD: by the rows of K, in pixels of an image 640 wide.
    corners = data.model(1).points.numpy() @ TRUTHS[0][0][1][:3, :3].numpy().T + TRUTHS[0][0][1][:3, 3].numpy()
    place = [(c + [0, 0, z]) @ K.double().numpy().T for c in corners for z in (0.0, shift)]
    flat = np.array([p[:2] / p[2] for p in place]).reshape(-1, 2, 2)
    pixels = np.linalg.norm(flat[:, 0] - flat[:, 1], axis=1).max()
    assert row.errors.mspd == pytest.approx(pixels, rel=1e-6)
    assert one.ar_mspd == pytest.approx(sum(5 * k > pixels * 640 / 96 for k in range(1, 11)) / 10)
    # VSD: taus up to 0.2 find no pixel right; beyond, what is wrong are the rims, where the sides are steep.
    assert min(row.errors.vsd[:4]) == 1.0 and max(row.errors.vsd[5:]) < 0.3
    assert one.ar_vsd == pytest.approx(sum(e < 0.05 * k - 1e-9 for e in row.errors.vsd for k in range(1, 11)) / 100)


def test_what_is_missing_or_too_much(made: Path) -> None:
    data = bop.Dataset(made)
    given = estimates()
    far = pose((0.1, 0, 0), (0.0, 0.0, 900.0))
    # One instance has no estimate; a second one of object 1 with a lower score is ignored, as is an object that is not there.
    found = bop.evaluate(
        data, [*given[:3], bop.Estimate(3, 0, 1, 0.1, far), bop.Estimate(3, 1, 1, 0.9, far)], with_vsd=False, progress=False
    )  # fmt: skip
    assert found.overall.ar_mssd == 0.75 and found.overall.ar_vsd is None and found.overall.ar is None and found.ignored == 2
    assert found.objects[1].ar_mssd == 1.0 and found.objects[5].ar_mssd == pytest.approx(2 / 3)
    # With a higher score it goes first, and the right one is ignored.
    found = bop.evaluate(data, [*given, bop.Estimate(3, 0, 1, 0.99, far)], with_vsd=False, progress=False)
    assert found.objects[1].ar_mssd == 0.0 and found.objects[5].ar_mssd == 1.0
    nothing = bop.evaluate(data, [], progress=False)
    assert nothing.overall.ar == 0.0 and math.isnan(nothing.overall.degrees) and "nan" not in nothing.table()
    assert json.loads(nothing.to_json())["median_degrees"] is None
    with pytest.raises(ValueError, match="targets: expected at least one"):
        bop.evaluate(data, given, [])


def test_eval_models_go_first(folder: Path) -> None:
    shutil.copytree(folder / "models", folder / "models_eval")
    info = folder / "models_eval" / "models_info.json"
    content = json.loads(info.read_text())
    content["1"]["diameter"] = 1000.0
    info.write_text(json.dumps(content))
    data = bop.Dataset(folder)
    assert data.model(1, evaluation=True).diameter == 1000.0 and data.model(1).diameter < 120.0
    found = bop.evaluate(data, estimates(pose((1e-12, 0, 0), (0, 0, 40.0))), with_vsd=False, progress=False)
    assert found.objects[1].ar_mssd == 1.0


# -- refined -------------------------------------------------------------------------------------------------------------------

TURN, SHIFT = pose((0.06, -0.05, 0.04), (0, 0, 0)), pose((1e-12, 0, 0), (2.0, -1.0, 4.0))  # 5.0° and 4.6 mm
QUICK = ("--size", 48, "--steps", 6, "--unconverged")


def off(truth: torch.Tensor) -> torch.Tensor:
    """Turned about the object's own origin, and moved."""
    found = SHIFT @ truth
    found[:3, :3] = TURN[:3, :3] @ truth[:3, :3]
    return found


def test_command_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results, out, report = folder / "results.csv", folder / "new" / "better.csv", folder / "report.json"
    given = [replace(one, pose=off(one.pose)) for one in estimates()[:2]]
    bop.write_results(results, given)
    assert run("bop", "refine", folder, results, "-o", out, "--limit", 1, "--pictures", folder / "seen", *QUICK) == 0
    said = capsys.readouterr().out
    assert "scene 3, image 0, object 1: turned" in said and "1 of 1 rows in" in said
    assert len(list((folder / "seen").glob("*.png"))) == 1
    first = out.read_text()
    # It goes on, and keeps what there is.
    assert run("bop", "refine", folder, results, "-o", out, *QUICK) == 2
    assert "--resume" in capsys.readouterr().err and out.read_text() == first
    assert run("bop", "refine", folder, results, "-o", out, "--resume", *QUICK) == 0
    assert out.read_text().splitlines()[1].rsplit(",", 1)[0] == first.splitlines()[1].rsplit(",", 1)[0]
    found = bop.read_results(out)
    assert found[0].seconds == found[1].seconds > 1.5  # one time for the image
    assert run("bop", "errors", folder, results, "--no-vsd") == 0
    assert run("bop", "errors", folder, out, "--out", report) == 0
    said = capsys.readouterr().out
    assert "AR_VSD" in said and f"wrote {report}" in said
    content = json.loads(report.read_text())
    assert content["instances"] == 4 and len(content["estimates"]) == 2
    data = bop.Dataset(folder)
    for row, before in zip(content["estimates"], bop.evaluate(data, given, progress=False).rows, strict=True):
        assert before.errors is not None and row["mssd"] < 0.3 * before.errors.mssd and row["degrees"] < 1.5
    assert content["objects"]["1"]["bop19_average_recall"] > 0.9


def test_refined_keeps_to_the_symmetry(made: Path) -> None:
    """The pose that comes out is the one near the estimate, whichever of the four that was."""
    data = bop.Dataset(made)
    truth = TRUTHS[0][1][1] @ data.model(5).symmetries.motions[1]
    found = bop.refine(data, bop.Estimate(3, 0, 5, 1.0, off(truth)), size=48, steps=6, unconverged=True)
    assert not found.kept and found.degrees < 10.0
    assert eg.Symmetries().error(found.estimate.pose, truth).degrees < 1.5


def test_refined_keeps_what_it_cannot_mend(made: Path) -> None:
    data = bop.Dataset(made)
    beside = bop.Estimate(3, 0, 1, 1.0, pose((0.1, 0, 0), (5000.0, 0.0, 400.0)))
    found = bop.refine(data, beside)
    assert found.kept and found.fit is None and "does not show" in found.why and found.estimate is beside
    start = replace(estimates()[0], pose=off(TRUTHS[0][0][1]))
    early = bop.refine(data, start, size=32, steps=1)
    assert early.kept and early.estimate is start and "not converged" in early.why
    with pytest.raises(ValueError, match="expected object 7 in it, got 1, 5"):
        bop.refine(data, bop.Estimate(3, 0, 7, 1.0, TRUTHS[0][0][1]))


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("errors", "none.csv"), "none.csv: expected a file"),
        (("errors", "results.csv", "--split", "val"), "expected the split 'val', got test"),
        (("errors", "results.csv", "-o", "a.txt"), "a.txt: expected a file name that ends in .json"),
        (("errors", "results.csv", "--targets", "a.json"), "a.json: expected a list of targets"),
        (("refine", "results.csv", "-o", "results.csv"), "--out: expected another file"),
        (("refine", "results.csv", "-o", "other.csv", "--resume"), "--resume: expected .* got another scene"),
        (("refine", "results.csv", "-o", "longer.csv", "--resume", "--limit", "1"), "--resume: expected at most 1 rows"),
    ],
)  # fmt: skip
def test_command_line_messages(
    arguments: tuple[str, ...], words: str, folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    monkeypatch.chdir(folder)
    bop.write_results("results.csv", estimates())
    bop.write_results("longer.csv", estimates())
    bop.write_results("other.csv", estimates()[1:])
    assert run("bop", arguments[0], ".", *arguments[1:]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("edgegrad: error: ")
    with pytest.raises(ValueError, match=words):
        raise ValueError(line)
