"""BOP's layout and result files, and poses refined on the command line."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path

import pytest
import torch
from bop_scenes import SIZE, TRUTHS, K, camera, estimates, meshes, pose
from PIL import Image
from quiet_fits import quiet

import edgegrad as eg
from edgegrad import bop, cli
from edgegrad.bop.dataset import Target
from edgegrad.fit import fit_pose

pytest_plugins = "bop_fixtures"


def run(*arguments: object) -> int:
    return cli.main([str(argument) for argument in arguments])


# -- the layout ------------------------------------------------------------------------------------------------------------


def test_written_data_sets_are_read_back(made: Path) -> None:
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
    depth = bop.errors.depth_image(meshes()[5], truth, frame.camera)
    own = frame.mask(0) > 0.5
    assert torch.equal(own, depth > 0) and torch.equal(frame.mask_visible(0) > 0.5, own)
    assert float((frame.depth() - depth)[own].abs().max()) < 0.051
    again = eg.render(five.mesh.transformed(truth[:3, :3], truth[:3, 3]), frame.camera, spp=32, seed=0)
    inside = torch.nn.functional.max_pool2d(1.0 - own.float()[None, None], 3, 1, 1)[0, 0] == 0
    assert float((frame.picture() - again)[inside].abs().mean()) < 0.004
    assert data.targets() == [Target(3, 0, 1, 1), Target(3, 0, 5, 1), Target(3, 1, 5, 2)]


def test_pictures_are_read_as_they_are_stored(folder: Path) -> None:
    """K and poses refer to stored pixels, whatever the EXIF orientation."""
    frame = bop.Dataset(folder).frame(3, 1)
    before, size = frame.picture(), frame.camera.size
    exif = Image.Exif()
    exif[0x112] = 6
    with Image.open(frame.picture_path) as image:
        image.load()
    image.save(frame.picture_path, exif=exif)
    again = bop.Dataset(folder).frame(3, 1)
    assert again.camera.size == size and torch.equal(again.picture(), before)


def test_targets_without_a_file_are_the_visible_instances(folder: Path) -> None:
    """Instances that are visible by less than a tenth do not count."""
    (folder / "test_targets_bop19.json").unlink()
    info = folder / "test" / "000003" / "scene_gt_info.json"
    content = json.loads(info.read_text())
    content["1"][0]["visib_fract"] = 0.09
    info.write_text(json.dumps(content))
    assert bop.Dataset(folder).targets() == [Target(3, 0, 1, 1), Target(3, 0, 5, 1), Target(3, 1, 5, 1)]


def test_covered_instances_have_visible_masks_and_shares(tmp_path: Path) -> None:
    """The nearer plate covers the left half of the other."""
    corners = torch.tensor([[-40.0, -20, 0], [40, -20, 0], [40, 20, 0], [-40, 20, 0]])
    plate = {2: eg.Mesh(corners, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.full((2, 3), 0.2))}
    far, near = torch.eye(4, dtype=torch.float64), torch.eye(4, dtype=torch.float64)
    far[2, 3], near[:3, 3] = 400.0, torch.tensor([-50.0, 0.0, 300.0])
    bop.files.write_models(tmp_path, plate)
    bop.files.write_scene(tmp_path, 1, [bop.files.Shot(camera(), [(2, far), (2, near)])], plate, split="val", spp=1)
    frame = bop.Dataset(tmp_path).frame(1, 0)
    # 40 / 400 · 120 = 12 px to each side of the middle, at 48; the near one's right border is at -10 / 300 · 120 = -4 px.
    assert frame.truths[0].visible == pytest.approx(16 / 24) and frame.truths[1].visible == 1.0
    assert int(frame.mask(0).sum()) == 24 * 12 and int(frame.mask_visible(0).sum()) == 16 * 12
    assert frame.depth()[36, 48] == 400.0 and frame.depth()[36, 40] == 300.0 and frame.depth()[0, 0] == 0.0
    info = json.loads((tmp_path / "val" / "000001" / "scene_gt_info.json").read_text())["0"][0]
    assert info["bbox_obj"] == [36, 30, 23, 11] and info["bbox_visib"] == [44, 30, 15, 11]


@pytest.mark.parametrize(
    "ask, words",
    [
        (lambda folder: bop.Dataset(folder / "none"), "none: expected the folder of a BOP data set"),
        (lambda folder: bop.Dataset(folder / "models"), "models: expected folders of splits"),
        (lambda folder: bop.Dataset(folder, "val"), "expected the split 'val', got test"),
        (lambda folder: bop.Dataset(folder).frame(4, 0), "expected scene 4, got 3; choose"),
        (lambda folder: bop.Dataset(folder).frame(3, 9), "scene_camera.json: expected image 9 in it, got 0, 1; "),
        (lambda folder: bop.Dataset(folder).model(2), "models_info.json: expected object 2 in it, got 1, 5; "),
        (lambda folder: bop.Dataset(folder).targets("other.json"), "other.json: expected a list of targets"),
        (lambda folder: bop.Dataset(folder).frame(3, 0).mask(7), "expected 000000_000007.png"),
    ],
)  # fmt: skip
def test_missing_files_are_named(ask: Callable[[Path], object], words: str, made: Path) -> None:
    with pytest.raises((FileNotFoundError, ValueError), match=words):
        ask(made)


INFO, TRUTH, VIEWS = "models/models_info.json", "test/000003/scene_gt.json", "test/000003/scene_camera.json"


@pytest.mark.parametrize(
    "file, content, ask, words",
    [
        (INFO, None, lambda data: data.objects, "expected models/models_info.json, got no folder with such a file"),
        (INFO, "{", lambda data: data.objects, "models_info.json: expected JSON"),
        (INFO, "[]", lambda data: data.objects, "expected an object"),
        (INFO, '{"a": 1}', lambda data: data.objects, "expected ids as keys, got 'a'"),
        (INFO, '{"1": {}}', lambda data: data.model(1), "object 1: expected the key 'diameter', got none"),
        (INFO, '{"1": {"diameter": 1, "symmetries_discrete": [[1]]}}', lambda data: data.model(1), "object 1: .* 16 numbers"),
        ("models/obj_000001.ply", None, lambda data: data.model(1).mesh, "obj_000001.ply: expected a file"),
        ("test/000003/rgb/000000.png", None, lambda data: data.frame(3, 0).picture(), "expected 000000.png .* rgb or gray"),
        ("test/000003/depth/000000.png", None, lambda data: data.frame(3, 0).depth(), "000003: expected 000000.png .* in depth"),
        (TRUTH, None, lambda data: data.frame(3, 0).truths, "scene_gt.json: expected the poses"),
        (TRUTH, '{"1": []}', lambda data: data.frame(3, 0).truths, "scene_gt.json: expected image 0 in it, got 1"),
        (TRUTH, '{"0": [{"obj_id": 1}]}', lambda data: data.frame(3, 0).truths, "entry 0: expected the key 'cam_R_m2c'"),
        (VIEWS, '{"0": {"cam_K": [1, 2]}}', lambda data: data.frame(3, 0).K, "image 0, cam_K: expected 9 finite numbers"),
        ("test_targets_bop19.json", '[{"scene_id": 3}]', lambda data: data.targets(), "entry 0: expected the key 'im_id'"),
    ],
)  # fmt: skip
def test_malformed_files_are_named(
    file: str, content: str | None, ask: Callable[[bop.Dataset], object], words: str, folder: Path
) -> None:  # fmt: skip
    (folder / file).unlink()
    if content is not None:
        (folder / file).write_text(content)
    with pytest.raises((FileNotFoundError, ValueError), match=words):
        ask(bop.Dataset(folder))


def test_models_folder_is_chosen_or_must_be_named(folder: Path) -> None:
    """Of two folders, as in T-LESS, one must be named; models_eval is for errors alone."""
    (folder / "models").rename(folder / "models_cad")
    shutil.copytree(folder / "models_cad", folder / "models_eval")
    assert bop.Dataset(folder).model(1).path.parent.name == "models_cad"
    shutil.copytree(folder / "models_cad", folder / "models_reconst")
    chosen = bop.Dataset(folder, models="models_reconst")
    assert chosen.model(1).path.parent.name == "models_reconst" and chosen.objects == [1, 5]
    assert chosen.model(1, evaluation=True).path.parent.name == "models_eval"
    with pytest.raises(FileNotFoundError, match="got models_cad, models_eval, models_reconst; download"):
        bop.Dataset(folder).model(1)


def test_split_is_chosen_or_must_be_named(folder: Path) -> None:
    """ "test" is preferred, then the only split; otherwise one must be named."""
    scenes = folder / "test"
    shutil.copytree(scenes, folder / "test_other")
    assert bop.Dataset(folder).split == "test"
    scenes.rename(folder / "train")
    data = bop.Dataset(folder, "train")
    assert bop.Dataset(folder).split == "test_other" and data.split == "train"
    (folder / "test_targets_bop19.json").write_text("[]")  # says nothing of another split
    assert data.targets()[-1] == Target(3, 1, 5, 2) and bop.Dataset(folder).targets() == []
    (folder / "test_other").rename(folder / "val")
    with pytest.raises(ValueError, match="expected the name of a split, got train, val; name one"):
        bop.Dataset(folder)


# -- results -----------------------------------------------------------------------------------------------------------------


def test_results_come_back_to_the_bit(tmp_path: Path) -> None:
    given = estimates(pose((0.1, 0.2, 0.3), (1.0, 2.0, 1 / 3)))
    bop.files.write_results(tmp_path / "a.csv", given)
    assert (tmp_path / "a.csv").read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    found = bop.files.read_results(tmp_path / "a.csv")
    for ours, theirs in zip(found, given, strict=True):
        assert torch.equal(ours.pose, theirs.pose) and ours.seconds == 1.5
        assert (ours.scene_id, ours.im_id, ours.obj_id, ours.score) == (
            theirs.scene_id,
            theirs.im_id,
            theirs.obj_id,
            theirs.score,
        )
    # By rows; the header and the last newline may be missing.
    (tmp_path / "b.csv").write_text("1, 2,3,0.5,0 -1 0 1 0 0 0 0 1,10 20 30,-1")
    (one,) = bop.files.read_results(tmp_path / "b.csv")
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
def test_malformed_result_files_are_named(line: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(f"scene_id,im_id,obj_id,score,R,t,time\n{line}\n")
    with pytest.raises(ValueError, match=words):
        bop.files.read_results(tmp_path / "a.csv")


# -- refined -------------------------------------------------------------------------------------------------------------------

TURN, SHIFT = pose((0.06, -0.05, 0.04), (0, 0, 0)), pose((1e-12, 0, 0), (2.0, -1.0, 4.0))  # 5.0° and 4.6 mm
QUICK = ("--steps", 12, "--unconverged")


def pose_off(truth: torch.Tensor) -> torch.Tensor:
    """Return a pose after a rotation about the object's own origin and a shift."""
    found = SHIFT @ truth
    found[:3, :3] = TURN[:3, :3] @ truth[:3, :3]
    return found


def test_command_line_writes_errors_and_refined_poses(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(import_module("edgegrad.bop.refine"), "fit_pose", partial(fit_pose, search=False))
    results, out, report = folder / "results.csv", folder / "new" / "better.csv", folder / "report.json"
    data = bop.Dataset(folder)
    # The second in another of the poses that look the same: what comes out is near that one.
    starts = [TRUTHS[0][0][1], TRUTHS[0][1][1] @ data.model(5).symmetries.motions[1]]
    given = [replace(one, pose=pose_off(start)) for one, start in zip(estimates()[:2], starts, strict=True)]
    bop.files.write_results(results, given)
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
    found = bop.files.read_results(out)
    assert found[0].seconds == found[1].seconds > 0.5  # one time for the image
    assert run("bop", "errors", folder, results, "--no-vsd") == 0
    assert run("bop", "errors", folder, out, "--out", report) == 0
    said = capsys.readouterr().out
    assert "AR_VSD" in said and f"wrote {report}" in said
    content = json.loads(report.read_text())
    assert content["instances"] == 4 and len(content["estimates"]) == 2
    for one, start in zip(found, starts, strict=True):
        assert eg.Symmetries().error(one.pose, start).degrees < 0.3
    for row, before in zip(content["estimates"], bop.evaluate(data, given, progress=False).rows, strict=True):
        assert before.errors is not None and row["mssd"] < 0.1 * before.errors.mssd and row["degrees"] < 0.3
    assert content["objects"]["1"]["bop19_average_recall"] > 0.9


REASONS = ("steps ran out", "edges not explained", "ambiguous", "directions unknown")


def test_refine_keeps_poses_whose_fit_fails(made: Path) -> None:
    data = bop.Dataset(made)
    off_image = bop.files.Estimate(3, 0, 1, 1.0, pose((0.1, 0, 0), (5000.0, 0.0, 400.0)))
    found = bop.refine(data, off_image, options=quiet())
    assert found.kept and found.fit is None and "does not show" in found.why and found.estimate is off_image
    start = replace(estimates()[0], pose=pose_off(TRUTHS[0][0][1]))
    early = bop.refine(data, start, options=quiet(max_size=16, steps=1))
    assert early.kept and early.estimate is start and early.why.split(":")[0] in REASONS
    with pytest.raises(ValueError, match="expected object 7 in it, got 1, 5"):
        bop.refine(data, bop.files.Estimate(3, 0, 7, 1.0, TRUTHS[0][0][1]))


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
    bop.files.write_results("results.csv", estimates())
    bop.files.write_results("longer.csv", estimates())
    bop.files.write_results("other.csv", estimates()[1:])
    command, *rest = arguments
    assert run("bop", command, ".", *rest) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("edgegrad: error: ")
    with pytest.raises(ValueError, match=words):
        raise ValueError(line)
