"""Poses of rigs from masks, pictures and keypoints."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from arms import TRUTH, arm, degrees, shown, views
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import Checkpoint, FitOptions, Measured, fit_rig, priors, track_rig
from edgegrad.fit.rig.settings import RIG


def test_a_pose_from_masks() -> None:
    rig, cameras = arm(), views(32)
    masks = shown(rig.posed(TRUTH, translation=[0.05, 0.0, -0.1]), cameras)
    found = fit_rig(rig, None, cameras, masks=masks, search=0, options=quiet(coarsest=32))
    assert found.converged and degrees(found.values["rotations"], TRUTH) < 2.0
    assert torch.allclose(found.values["translation"], torch.tensor([0.05, 0.0, -0.1]).double(), atol=0.02)
    assert torch.allclose(found.posed().verts, found.fit.mesh.verts, atol=1e-6)
    assert found.uncertainty is not None and found.reason == "converged" and found.confidence > 0.8
    unsure = replace(found, uncertainty=replace(found.uncertainty, degrees={"bone 0": 1.0, "bone 1": 7.0}, axes={}))
    assert not unsure.converged and "rotations unknown: bone 1 known to ±7° only" in unsure.reason
    # A limb in another's place still shows some edges, but fewer than the others.
    for share, enough in ((0.8, False), (0.9, True)):
        aside = replace(found, explained_joints={"bone 0": 0.99, "bone 1": share, "bone 2": 0.98, "bone 3": 0.99})
        assert aside.converged == enough and ("80% at bone 1" in aside.reason) != enough


def test_a_pose_from_pictures_with_limits_and_some_joints() -> None:
    rig, cameras = arm(colored=True).with_limits(rotations={"bone 1": ([-0.2] * 3, [0.2] * 3)}), views()
    pictures = shown(rig.posed(TRUTH), cameras, "image")
    options = {"seek": ["bone 1"], "init": {"rotations": {"bone 0": TRUTH[0]}}, "search": 0}
    found = fit_rig(rig, pictures, cameras, **arranged(steps=5, **options))
    rotations = found.values["rotations"]
    assert torch.allclose(rotations[0], TRUTH[0]) and rotations[1].abs().max() <= 0.2 + 1e-12
    assert torch.equal(found.values["translation"], torch.zeros(3, dtype=torch.float64))


def photographs(rig: eg.rig.Rig, cameras: list[eg.Camera], seed: int) -> tuple[eg.Mesh, list[torch.Tensor]]:
    """Return the true pose, and pictures of it before clutter, in colours that the rig does not know."""
    g = torch.Generator().manual_seed(seed)
    posed = rig.posed(TRUTH, translation=[0.05, 0.0, -0.1])
    warm = torch.tensor([0.8, 0.35, 0.15]) * (0.7 + 0.3 * torch.rand(len(posed.verts), 1, generator=g))
    photos = []
    for camera in cameras:
        clutter = torch.rand(1, 3, 6, 6, generator=g) * torch.tensor([0.2, 0.5, 0.9])[:, None, None]
        behind = torch.nn.functional.interpolate(clutter, size=camera.size, mode="bilinear")[0].movedim(0, -1)
        photos.append(eg.render(eg.Scene(posed.replace(colors=warm), background=behind), camera, 64, seed=9))
    return posed, photos


def test_a_pose_from_photographs_without_masks() -> None:
    rig, cameras = arm(), views(48)
    _, photos = photographs(rig, cameras, 5)
    start = {"rotations": 0.5 * TRUTH}
    found = fit_rig(rig, photos, cameras, init=start, options=quiet(loss="region", coarsest=24))
    assert degrees(0.5 * TRUTH, TRUTH) > 15.0 and degrees(found.values["rotations"], TRUTH) < 5.0
    assert found.converged and all(view.by_region for view in found.fit.views)
    assert math.isnan(found.confidence)  # There is no noise to compare with.
    far = {"translation": [50.0, 0.0, 0.0]}
    with pytest.raises(ValueError, match="expected an object that the pictures show at the start"):
        fit_rig(rig, photos, cameras, init=far, options=quiet(loss="region"))


@pytest.mark.slow
def test_by_regions_a_limb_that_starts_elsewhere_is_found_or_missed() -> None:
    """In small pictures a descent alone stops with the upper bone across the clutter."""
    rig, cameras = arm(), views(48)
    posed, photos = photographs(rig, cameras, 1)
    start = {"rotations": torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, -1.6]]).double()}
    options = {"loss": "region", "init": start, "progress": False}
    alone, helped = (fit_rig(rig, photos, cameras, search=n, **arranged(**options)) for n in (0, 40))
    off = [float((fit.posed().verts - posed.verts).norm(dim=1).max()) for fit in (alone, helped)]
    assert off[0] > 0.5 and not alone.converged
    assert off[1] < 0.1 and helped.converged


@pytest.mark.slow
def test_keypoints_find_what_masks_do_not() -> None:
    """A limb is far from its mask. Its joints lead there, of which one is wrong in one picture."""
    rig, cameras = arm(3), views(count=4)
    truth = torch.tensor([[0.0, 0.0, 1.3], [0.0, 0.0, 0.9], [0.0, 0.0, 0.3]], dtype=torch.float64)
    joints = rig.shape({"rotations": truth}).joints
    seen = torch.stack([camera.project(joints.float()) for camera in cameras], 1)  # (J, B, 2)
    seen[2, 0] += 10.0
    seen[1, 1] = math.nan
    masks = shown(rig.posed(truth), cameras)
    given = {f"bone {k}": seen[k] for k in range(3)}
    found = fit_rig(
        rig, None, cameras, masks=masks, keypoints=Measured(given, factor=100.0), search=0,
        options=quiet(coarsest=48, steps=30),
    )  # fmt: skip
    assert (found.rig.shape({"rotations": found.values["rotations"]}).joints - joints).norm(dim=1).max() < 0.1


@pytest.mark.slow
def test_a_limb_is_found_from_new_starts() -> None:
    """The limb is bent to the other side, from where a descent alone does not lead to the answer."""
    rig, cameras = arm(3), views(count=2)
    truth = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1.4], [0.0, 0.0, 0.6]], dtype=torch.float64)
    masks = shown(rig.posed(truth), cameras)
    given = {
        "masks": masks,
        "init": {"rotations": -truth},
        "seek": ["rotations"],
        "options": quiet(coarsest=24, steps=8),
    }
    alone, helped = (fit_rig(rig, None, cameras, search=tries, **given) for tries in (0, 6))
    assert helped.loss < 0.3 * alone.loss and not alone.converged


def test_ctrl_c_in_the_search_of_limbs_keeps_the_descent(monkeypatch) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("edgegrad.fit.rig.search.HypothesisSearch.draw_limbs", stop)
    rig, cameras = arm(), views(32, 2)
    found = fit_rig(rig, None, cameras, masks=shown(rig.posed(TRUTH), cameras), options=quiet(steps=2))
    assert found.interrupted and not found.converged
    assert float(found.values["rotations"].abs().max()) > 0.05  # of the descent before


@pytest.mark.slow
def test_a_sequence() -> None:
    rig, cameras = arm(), views()
    truths = [TRUTH * 0.25 * k for k in range(4)]
    frames = [{"masks": shown(rig.posed(truth), cameras)} for truth in truths]
    found = list(track_rig(rig, frames, cameras, init={}, search=0, options=quiet(steps=8)))
    errors = [degrees(one.values["rotations"], truth) for one, truth in zip(found, truths, strict=True)]
    assert max(errors) < 3.0


@pytest.mark.parametrize(("loss", "angles"), [(0.5, [0.0, 2.0, 3.0]), (2.0, [0.0, 1.0, 2.0])])
def test_what_a_frame_misses_is_searched_once(monkeypatch, loss: float, angles: list[float]) -> None:
    """A result is kept where it is better. A limb that is still missed is not searched again in the next frame."""
    calls: list[tuple[int | None, float]] = []

    def fit(
        rig: eg.rig.Rig, *, init: dict[str, torch.Tensor], search: bool | int, options: FitOptions, **_: Any
    ) -> Any:
        angle = float(init["rotations"][0, 0]) + (1.0 if calls else 0.0)
        calls.append((search, angle))
        assert (options.checkpoint is None) == (search == 5)
        values = {"rotations": torch.full((2, 3), angle, dtype=torch.float64)}
        missed = ["bone 1"] if len(calls) > 1 else []
        return SimpleNamespace(values=values, missed=missed, loss=loss if search else 1.0, interrupted=False)

    monkeypatch.setattr("edgegrad.fit.rig.track_rig.fit_rig", fit)
    monkeypatch.setattr("edgegrad.fit.rig.track_rig.RIG", replace(RIG, motion_share=0.0))
    start = {"rotations": torch.zeros(2, 3, dtype=torch.float64)}
    found = list(track_rig(arm(), [{}, {}, {}], views(16, 1), init=start, again=5, options=quiet(checkpoint="a.ckpt")))
    assert [float(one.values["rotations"][0, 0]) for one in found] == angles
    assert [search for search, _ in calls] == [True, 0, 5, 0]


def test_frames_have_checkpoints_of_their_own(tmp_path) -> None:
    rig, cameras = arm(), views(16, 2)
    frames = [{"masks": shown(rig.posed(TRUTH * k), cameras)} for k in (0.1, 0.2)]
    options = {"search": 0, "steps": 2, "coarsest": 16, "progress": False, "checkpoint": tmp_path / "walk.ckpt"}
    first = list(track_rig(rig, frames, cameras, init={}, **arranged(**options)))
    again = list(track_rig(rig, frames, cameras, init={}, **arranged(resume=True, **options)))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["walk-0001.ckpt", "walk-0002.ckpt"]
    for a, b in zip(first, again, strict=True):
        assert torch.equal(a.values["rotations"], b.values["rotations"])
    for error, message, given in (
        (ValueError, "smooth: expected", {"frames": frames, "smooth": -1.0}),
        (TypeError, r"frames\[0\]: expected arguments by name", {"frames": [frames[0]["masks"]]}),
    ):
        with pytest.raises(error, match=message):
            next(track_rig(rig, cameras=cameras, **given))


def test_a_start_within_limits_that_leave_out_rest() -> None:
    rig, cameras = arm().with_limits(rotations={"bone 1": ([0.1] * 3, [0.6] * 3)}), views(16, 2)
    found = fit_rig(rig, None, cameras, masks=shown(rig.posed(TRUTH.abs()), cameras), search=0, options=quiet(steps=1))
    assert float(found.values["rotations"][1].min()) >= 0.1


def test_a_resumed_fit_ends_as_if_it_had_never_stopped(tmp_path) -> None:
    rig, cameras = arm(), views(32, 2)
    options = {"masks": shown(rig.posed(TRUTH), cameras), "search": 0, "steps": 4, "loss_tolerance": 0.0}
    whole = fit_rig(rig, None, cameras, **arranged(**options))
    count = 0

    def stop(record: object) -> None:
        nonlocal count
        count += 1
        if count == 6:
            raise KeyboardInterrupt

    path = tmp_path / "checkpoint.pt"
    half = fit_rig(rig, None, cameras, **arranged(callback=stop, checkpoint=path, **options))
    assert half.interrupted and half.reason == "interrupted"
    rest = fit_rig(rig, None, cameras, **arranged(checkpoint=Checkpoint(path, resume=True), **options))
    assert torch.equal(rest.values["rotations"], whole.values["rotations"]) and len(rest.history) == len(whole.history)
    assert "pose.json" in rest.save(tmp_path / "out", figures=False)


def test_the_command_line(tmp_path, capsys, monkeypatch) -> None:
    from rig_files import simple_skin

    from edgegrad import cli

    rig = eg.rig.load(simple_skin().write(tmp_path))
    camera = eg.Camera.look_at((0.5, 1.0, 4.0), (0.5, 1.0, 0.0), up=(0, 1, 0), fov_y=40, size=(24, 24))
    eg.save_camera(tmp_path / "camera.json", camera)
    (mask,) = shown(rig.posed({"upper": [0.0, 0.0, 0.4]}), [camera])
    eg.write_image(tmp_path / "mask.png", eg.image.srgb_to_linear(mask))
    monkeypatch.chdir(tmp_path)
    command = (
        "fit-rig a.gltf mask.png --camera camera.json --seek upper translation --search 0 --steps 12 --coarsest 24"
    )
    assert cli.main([*command.split(), "--out", "out"]) == 0
    assert "wrote pose.json, joints.json, posed.glb" in capsys.readouterr().out
    found = json.loads((tmp_path / "out" / "pose.json").read_text())["rotations"]
    assert abs(found[-1][2] - 0.4) < 0.15 and found[0] == [0.0, 0.0, 0.0]
    joints = json.loads((tmp_path / "out" / "joints.json").read_text())
    assert list(joints) == ["upper"] and joints["upper"]["explained"] > 0.6 and joints["upper"]["degrees"] > 0.0


def test_priors() -> None:
    values = {"rotations": torch.tensor([[0.1, 0.2, 0.3], [0.1, -0.2, -0.3]]).double(), "scale": torch.tensor(3.0)}
    assert priors.mirrored("rotations", [(0, 1)])(values) == 0.0
    rest = {"rotations": torch.zeros(2, 3)}
    assert torch.isclose(priors.towards(rest, 2.0)(values), torch.tensor(2 * 0.28).double())
    assert torch.isclose(priors.near({"scale": torch.tensor(2.0)}, 3.0)(values).double(), torch.tensor(3.0).double())


def test_errors_name_the_argument() -> None:
    rig, cameras = arm(), views(16, 2)
    masks = shown(rig.posed(), cameras)
    for error, message, change in (
        (TypeError, "rig: expected a Rig", {"rig": rig.posed()}),
        (ValueError, "seek: expected names among .*got 'pose'", {"seek": ["pose"]}),
        (ValueError, "seek: expected a name or more", {"seek": []}),
        (ValueError, "init: expected names among", {"init": {"turns": 1.0}}),
        (ValueError, "seek: expected names among .*bone 0, bone 1, got 'elbow'", {"seek": ["elbow"]}),
        (ValueError, "keypoints: expected joints among", {"keypoints": {"elbow": torch.zeros(2, 2)}}),
        (ValueError, "a pixel for each camera", {"keypoints": {"bone 0": torch.zeros(3, 2)}}),
        (ValueError, "expected numbers for one at least", {"keypoints": {"bone 0": torch.full((2, 2), math.nan)}}),
        (TypeError, "keypoints: expected pixels .*got none", {"keypoints": {}}),
        (TypeError, "keypoints: expected pixels .*got Tensor", {"keypoints": torch.zeros(2, 2)}),
        (ValueError, r"init\['rotations'\]: expected shape .*one pose", {"init": {"rotations": torch.zeros(2, 2, 3)}}),
        (TypeError, "priors: expected a list of functions", {"priors": lambda values: 0.0}),
        (TypeError, r"priors\[0\]: expected a function", {"priors": [0.5]}),
        (
            ValueError,
            r"priors\[0\]: expected it to return a number, got \(2, 3\)",
            {"priors": [lambda v: v["rotations"]]},
        ),
        (
            TypeError,
            "appearance: expected it to return a Mesh or a Scene, got NoneType",
            {"appearance": lambda _: None},
        ),
        (ValueError, "options.max_size: fit_rig compares pictures at their own size", {"max_size": 64}),
        (ValueError, "images: expected pictures or masks", {"masks": None}),
    ):
        given = {"rig": rig, "images": None, "cameras": cameras, "masks": masks, **change}
        with pytest.raises(error, match=message):
            fit_rig(**arranged(**given))
