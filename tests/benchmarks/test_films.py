"""The benchmark of trackers: a seed makes a film whose poses are those of the render, and figures of known errors are exact."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

import edgegrad as eg
from benchmarks.poses.objects import Sources
from benchmarks.track import __main__ as command
from benchmarks.track import drafts, measures, pictures, runs, shapes, summary, trackers
from benchmarks.track.films import Draft, Film, Length, Studio, measure, render
from benchmarks.track.trackers import Estimate

SMALL = Length(3, (96, 128))
SOURCES = Sources()


def drawn(kind: str, seed: int = 1, frames: int = 100) -> Draft:
    return drafts.drawn(kind, seed, SOURCES, Length(frames, SMALL.size))


def equal(a: Film, b: Film) -> bool:
    return (
        a.files == b.files and (a.poses == b.poses).all() and (a.visible == b.visible).all() and (a.start == b.start).all()
        and (a.depths is None or bool((a.depths == b.depths).all()))
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["hand", "fast", "depth", "three"])
def test_a_kind_and_a_seed_make_one_film(kind: str, tmp_path: Path) -> None:
    first, again, other = (render(drafts.drawn(kind, seed, SOURCES, SMALL), 3) for seed in (1, 1, 2))
    assert equal(first, again) and not equal(first, other)
    made, kept = (drafts.film(kind, 1, SOURCES, SMALL, tmp_path) for _ in range(2))
    assert len(list(tmp_path.iterdir())) == 1 and equal(made, first) and equal(kept, first)
    assert kept.frame(0).shape == (96, 128, 3) and kept.frame(0).dtype == np.uint8
    assert len(kept.meshes) == kept.poses.shape[1] == (3 if kind == "three" else 1)


@pytest.mark.parametrize("kind", ["block", "bolt", "far"])
def test_poses_are_where_the_render_has_the_object(kind: str) -> None:
    draft = drafts.drawn(kind, 3, SOURCES, Length(2, (480, 640)))
    film = render(replace(draft, behind=torch.zeros(480, 640, 3), wear=(0.0, 0.0, 95)), 2)
    seen = torch.from_numpy(film.frame(1)).sum(-1) > 30

    def iou(aside: np.ndarray) -> float:
        M = torch.from_numpy(film.poses[1, 0]).float()
        placed = film.meshes[0].transformed(M[:3, :3], M[:3, 3] + torch.from_numpy(aside * drafts.SIZE).float())
        alpha = eg.render_aovs(eg.Mesh(placed.verts, placed.faces), film.camera, ["alpha"], 16, 0)["alpha"][..., 0] > 0
        return float((alpha & seen).sum() / (alpha | seen).sum())

    best = iou(np.zeros(3))
    assert best > 0.97
    # 1 % of the size is two pixels, of `far` one; along the axis 5 % are as many at the contour.
    assert all(
        iou(step * np.array(way)) < best for step in (-0.015, 0.015) for way in ((1, 0, 0), (0, 1, 0), (0, 0, 5))
    )


def test_starts_are_near_the_first_poses() -> None:
    film = render(drafts.drawn("three", 1, SOURCES, Length(1, SMALL.size)), 1)
    for n, (centre, size) in enumerate(film.measures):
        step = measures.deviation(film.poses[0, n], film.start[n], centre)
        assert 0.0 < np.degrees(np.linalg.norm(step[:3])) <= 2.0 and 0.0 < np.linalg.norm(step[3:]) / size <= 0.01


def test_a_hand_covers_up_to_half_and_a_board_all_for_a_while() -> None:
    hand, board = drawn("hand"), drawn("covered")
    assert hand.occluder is not None and board.occluder is not None
    share = Studio(hand).visible((hand.occluder.visit.begin + hand.occluder.visit.end) / 2)[0]
    assert 0.4 < share < 0.75
    shares = [Studio(board).visible(float(k))[0] for k in range(0, 100, 2)]
    assert 8 <= 2 * sum(share < measures.GONE for share in shares) <= 24 and min(shares[0], shares[-1]) > 0.95


def test_an_object_that_leaves_comes_back_elsewhere_with_time_to_be_found() -> None:
    for seed in range(4):
        draft = drawn("away", seed)
        shares = np.array([Studio(draft).visible(float(k))[0] for k in range(0, 100, 2)])
        gone, back = np.flatnonzero(shares < measures.GONE), np.flatnonzero(shares >= measures.BACK)
        assert len(gone) >= 3 and shares[0] >= measures.BACK
        assert 2 * back[back > gone[0]][0] + measures.SECOND < 100 and (shares[gone[-1] + 8 :] > 0.9).all()
        turn = [draft.motions[0].at(time)[:3, :3] @ draft.motions[0].first.as_matrix().T for time in (10.0, 90.0)]
        assert Rotation.from_matrix(turn[1] @ turn[0].T).magnitude() > 0.1


def test_depth_has_the_noise_of_a_sensor_about_the_objects_depth() -> None:
    draft = drafts.drawn("depth", 1, SOURCES, Length(2, (480, 640)))
    film, M = render(draft, 2), torch.from_numpy(draft.poses(1.0)[0]).float()
    placed, depth = film.meshes[0].transformed(M[:3, :3], M[:3, 3]), film.depth(1)
    assert depth is not None
    seen = eg.render_aovs(placed, film.camera, ["depth", "alpha", "normal", "position"], 16, 0)
    facing = -(seen["normal"] * F.normalize(seen["position"], dim=-1)).sum(-1)
    on = (seen["alpha"][..., 0] > 0.999) & depth.isfinite() & (facing > 0.6)  # less than 53° from the surface's normal
    z = seen["depth"][..., 0][on]
    ratio = (depth[on] - z) / (0.0012 + 0.0019 * (z - 0.4) ** 2)
    assert on.sum() > 1000 and abs(float(ratio.mean())) < 0.1
    assert 0.95 < float(ratio.abs().median() / 0.6745) < 1.05
    assert depth[0].isfinite().all()  # the wall behind


@pytest.mark.parametrize("name", ["carton", "bracket"])
def test_a_mesh_in_more_faces_is_the_same_object(name: str) -> None:
    mesh = SOURCES.mesh(name, 1, np.random.default_rng(0)).replace(normals=None)
    more, camera = (
        shapes.subdivided(mesh, 4 * len(mesh.faces)),
        eg.Camera.look_at((0, 1, -4), (0, 0, 0), (0, 1, 0), 40.0, (48, 64)),
    )
    assert len(more.faces) == 4 * len(mesh.faces)
    torch.testing.assert_close(eg.render(more, camera, 16, 0), eg.render(mesh, camera, 16, 0), atol=2e-3, rtol=0.0)


# An off-centre mesh: the centre of its box is at (1, 1, 1), and its size is √3.
BOX = eg.shapes.box((1.0, 1.0, 1.0), (1.0, 1.0, 1.0))


def still(frames: int, visible: list[float] | None = None) -> Film:
    """Return a film of a box that stands still, in grey pictures whose value is their number."""
    files = []
    for k in range(frames):
        file = io.BytesIO()
        Image.new("RGB", (8, 6), (k, k, k)).save(file, "PNG")
        files.append(file.getvalue())
    truth = np.eye(4)
    truth[:3, :3], truth[:3, 3] = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), (0.0, 0.0, 8.0)
    camera = drafts.opencv(torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 3.0], [0.0, 0.0, 1.0]]), (6, 8))
    shown = np.array(visible or [1.0] * frames)[:, None]
    poses = np.broadcast_to(truth, (frames, 1, 4, 4))
    return Film("block", 7, ("box",), (BOX,), camera, tuple(files), poses, shown, truth[None])


def off(film: Film, degrees: float = 0.0, share: float = 0.0, **said: Any) -> Estimate:
    """Return an estimate that is rotated about the centre and shifted by a share of the size."""
    centre, size = measure(BOX)
    M = film.poses[0, 0].copy()
    R = Rotation.from_rotvec(np.radians(degrees) * np.array([0.0, 0.6, 0.8])).as_matrix() @ M[:3, :3]
    M[:3, 3] = M[:3, :3] @ centre + M[:3, 3] + share * size * np.array([0.0, 1.0, 0.0]) - R @ centre
    M[:3, :3] = R
    return Estimate(M, **said)


class Fake:
    """A tracker with given answers."""

    def __init__(self, answers: Iterable[Estimate]) -> None:
        self.answers, self.seen = iter(answers), []

    def update(self, image: np.ndarray, depth: Tensor | None) -> list[Estimate]:
        self.seen.append(int(image[0, 0, 0]))
        return [next(self.answers)]


def test_errors_of_a_fake_tracker_are_counted_exactly() -> None:
    film = still(10, [1.0] * 9 + [0.1])
    answers = [off(film, 1.0 + 0.1 * k, 0.01) for k in range(10)]
    answers[2] = off(film, 6.0)  # off and not said
    answers[3] = off(film, 6.0, lost=True)
    answers[5] = off(film, 2.0, lost=True)  # right, and said to be lost
    answers[7] = off(film, 0.0, 0.06)
    answers[9] = off(film, 90.0)  # where the object is hardly seen
    tracker = Fake(answers)
    (record,) = measures.measured(film, lambda _: tracker)
    assert tracker.seen == list(range(10)) and len(record["seconds"]) == 10
    np.testing.assert_allclose(record["degrees"], [1.0, 1.1, 6, 6, 1.4, 2.0, 1.6, 0.0, 1.8, 90.0], atol=1e-5)
    np.testing.assert_allclose(record["shift"], [0.01, 0.01, 0, 0, 0.01, 0, 0.01, 0.06, 0.01, 0], atol=1e-6)
    f = summary.Figures.of([record])
    assert (f.films, f.frames) == (1, 10)
    assert (f.unsaid, f.unsaid_seen, f.lost_right, f.lost) == pytest.approx((0.3, 2 / 9, 1 / 9, 2 / 9))
    kept = [1.0, 1.1, 6.0, 1.4, 1.6, 0.0, 1.8]  # seen and not said to be lost
    assert f.angle == pytest.approx((np.median(kept), np.quantile(kept, 0.9)), abs=1e-5)
    assert f.shift[0] == pytest.approx(0.01, abs=1e-6) and math.isnan(f.found) and math.isnan(f.calibration)
    missed = [one for one in summary.musts([record]) if one.endswith("missed")]
    assert any("not said to be lost" in one and " 30.00 " in one for one in missed)
    assert pictures.worst(record) == 9 and pictures.worst({**record, "lost": [True] * 10}) == 9


def test_nees_is_one_where_errors_are_as_large_as_the_covariance_says() -> None:
    film, rng = still(1), np.random.default_rng(0)
    A = rng.normal(size=(6, 6))
    covariance = A @ A.T * 1e-4
    e = np.linalg.cholesky(covariance) @ np.full(6, 1.0)  # one standard deviation along each direction
    M, (centre, _) = film.poses[0, 0], measure(BOX)
    R = Rotation.from_rotvec(-e[:3]).as_matrix() @ M[:3, :3]
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = R, M[:3, :3] @ centre + M[:3, 3] - e[3:] - R @ centre
    np.testing.assert_allclose(measures.deviation(M, found, centre), e, atol=1e-12)
    (record,) = measures.measured(film, lambda _: Fake([Estimate(found, covariance=covariance)]))
    assert record["nees"] == [pytest.approx(1.0, rel=1e-5)] and summary.Figures.of([record]).nees == pytest.approx(1.0)
    assert measures.nees(2.0 * e, covariance) == pytest.approx(4.0)
    assert math.isnan(measures.nees(e, np.zeros((6, 6)))) and math.isnan(measures.nees(e, None))


@pytest.mark.parametrize(("found", "expected"), [(10, [0]), (14, [4]), (40, [30]), (41, [None]), (99, [None])], ids=str)
def test_frames_until_an_object_is_found_again(found: int, expected: list[int | None]) -> None:
    film = still(60, [1.0] * 5 + [0.0] * 4 + [0.3] + [0.8] * 50)  # half of it is back in frame 10
    answers = [off(film, lost=5 <= k < found) for k in range(60)]
    (record,) = measures.measured(film, lambda _: Fake(answers))
    assert measures.recoveries(record) == expected
    f = summary.Figures.of([record])
    assert f.returns == 1 and f.found == (0.0 if expected == [None] else 1.0)


def test_a_return_that_leaves_no_second_counts_only_if_found() -> None:
    record = {
        "visible": [1.0, 0.0, 1.0, 1.0],
        "degrees": [0.0] * 4,
        "shift": [0.0] * 4,
        "lost": [False, True, True, True],
    }
    assert measures.recoveries(record) == []
    assert measures.recoveries({**record, "lost": [False, True, True, False]}) == [1]
    assert measures.recoveries({**record, "lost": [False] * 4, "degrees": [0.0, 0.0, 9.0, 9.0]}) == []


def test_calibration_error_and_training_by_features(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    film, lines = still(40), []
    for mesh in ("a", "b"):
        answers = [
            off(film, 9.0 if k % 4 == 0 else 1.0, confidence=0.95, features={"edges": float(k % 4 > 0), "k": 0.1 * k})
            for k in range(40)
        ]
        (record,) = measures.measured(film, lambda _, said=answers: Fake(said))
        lines.append(json.dumps({**record, "mesh": mesh}))
    file = tmp_path / "films.jsonl"
    file.write_text("\n".join(lines))
    assert summary.Figures.of([json.loads(line) for line in lines]).calibration == pytest.approx(0.2)
    assert command.main(["--train", str(file), "--features", "edges"]) == 0
    out = capsys.readouterr().out
    assert "names=('edges',)" in out and "60 of 80 frames right" in out and "0 of them wrong" in out
    assert command.main(["--calibration", str(file), "--figure", str(tmp_path / "figure.png")]) == 0
    assert "expected calibration error 0.200" in capsys.readouterr().out and (tmp_path / "figure.png").exists()
    assert command.main(["--summary", str(file)]) == 0
    assert "block" in capsys.readouterr().out
    bare = json.loads(lines[0])
    with pytest.raises(ValueError, match="features"):
        summary.training([{**bare, "features": {}}])
    with pytest.raises(ValueError, match="confidence"):
        summary.calibration([{**bare, "confidence": [math.nan] * 40}])


def generator(
    mesh: eg.Mesh, frames: Iterable[Tensor], camera: eg.Camera, init: Tensor, *, depths: Iterable[Tensor | None]
) -> Iterator[Any]:
    """Follow like edgegrad.track: pictures are read one by one, and their mean tells which one it is."""
    for frame, _ in zip(frames, depths, strict=False):
        yield SimpleNamespace(matrix=init, lost=bool(frame.mean() < 1e-4))


class Class:
    """Follow like a tracker with update()."""

    def __init__(self, mesh: Any, camera: eg.Camera, init: Any) -> None:
        self.mesh, self.init = mesh, init

    def update(self, image: Tensor, depth: Tensor | None = None) -> Any:
        assert image.dtype == torch.uint8 and image.shape == (6, 8, 3)

        def pose(init: Tensor) -> Any:
            return SimpleNamespace(
                R=init[:3, :3], t=init[:3, 3], lost=False, confidence=0.5, covariance=torch.eye(6), visible=None,
                features={"edges": torch.tensor(2.0)},
            )  # fmt: skip

        return pose(self.init) if isinstance(self.mesh, eg.Mesh) else tuple(pose(one) for one in self.init)


@pytest.mark.parametrize("follow", [generator, Class])
@pytest.mark.parametrize("count", [1, 3])
def test_generators_and_classes_are_shown_films(
    follow: Callable[..., Any], count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(eg.fit, "track", follow)
    film = still(4)
    poses, start = (np.repeat(one, count, -3) for one in (film.poses, film.start))
    film = replace(
        film, poses=poses, start=start, meshes=(BOX,) * count, names=("box",) * count, visible=np.ones((4, count))
    )
    records = measures.measured(film, trackers.maker(trackers.GENERATOR))
    assert [one["object"] for one in records] == list(range(count))
    for record in records:
        assert command.line(record).startswith("block              7 box")
        assert max(record["degrees"]) < 1e-5 and max(record["shift"]) < 1e-6
        if follow is Class:
            assert record["nees"] == [0.0] * 4 and record["features"] == {"edges": [2.0] * 4}
            assert record["confidence"] == [0.5] * 4 and math.isnan(record["said_visible"][0])
        else:
            assert record["lost"] == [True, False, False, False]  # The first picture is black, the next ones are not.
    assert summary.Figures.of(records).films == 1


def test_wrong_names_of_trackers_are_said() -> None:
    for name in ("edgegrad.fit", "edgegrad.fit:nothing", "edgegrad:load_mesh"):
        with pytest.raises(ValueError, match="--tracker"):
            trackers.maker(name)
    with pytest.raises(ValueError, match="--photos"):
        command.main(["--kinds", "squirrel"])


def test_a_run_leaves_out_what_its_file_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    asked: list[list[tuple[str, int]]] = []

    def run(jobs: list[runs.Job], processes: int, threads: int) -> Iterator[list[measures.Record]]:
        asked.append([job.key for job in jobs])
        return map(runs.followed, jobs)

    def broken(*_: Any, **__: Any) -> Iterator[Any]:
        raise ZeroDivisionError("on purpose")

    monkeypatch.setattr(runs, "run", run)
    monkeypatch.setattr(runs.drafts, "film", lambda kind, seed, *_: replace(still(3), kind=kind, seed=seed))
    for count, follow in ((1, generator), (2, broken)):
        monkeypatch.setattr(
            eg.fit, "track", lambda mesh, frames, *given, follow=follow, **named: follow(mesh, frames, *given, **named)
        )
        arguments = [
            "--kinds",
            "block",
            "--count",
            str(count),
            "--films",
            str(tmp_path),
            "--pictures",
            str(tmp_path / "worst"),
        ]
        command.main([*arguments, "--out", str(tmp_path / "films.jsonl")])
    assert asked == [[("block", 1000)], [("block", 1001)]]
    assert "ZeroDivisionError: on purpose" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "worst").iterdir()] == ["block-1000-0-box.png"]


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    """A folder with a bottle, a box here, in two grey frames."""
    for name in ("_sequence", "_body"):
        (tmp_path / "bottle" / name).mkdir(parents=True)
    for k in (200, 201):
        Image.new("RGB", (64, 48), (k, 90, 60)).save(tmp_path / "bottle" / "_sequence" / f"color_camera_image_{k}.png")
    box = eg.shapes.box((0.0, 0.0, 0.0), (0.05, 0.03, 0.02))
    eg.save_mesh(tmp_path / "bottle" / "_body" / "schauma.obj", eg.Mesh(box.verts, box.faces))
    pose = {"cam_R_body": np.eye(3).tolist(), "cam_t_body_m": [0.02, 0.0, 0.5], "geometry_offset_z_m": -0.01}
    K = [[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]]
    (tmp_path / "bottle" / "reference.json").write_text(json.dumps({"K": K, "schauma": pose}))
    return tmp_path


def test_real_frames_and_objects_before_photographs(photos: Path, tmp_path: Path) -> None:
    real = drafts.film("bottle_frames", 1, SOURCES, Length(5), tmp_path / "films", photos)
    assert [int(real.frame(k)[0, 0, 0]) for k in range(5)] == [200, 201, 200, 201, 200]
    centre, size = real.measures[0]
    step = measures.deviation(real.poses[0, 0], real.start[0], centre)
    assert np.degrees(np.linalg.norm(step[:3])) == pytest.approx(4.0) and np.linalg.norm(
        step[3:]
    ) / size == pytest.approx(0.02)
    moved = drafts.film("bottle", 1, SOURCES, Length(3), tmp_path / "films", photos)
    assert equal(moved, drafts.film("bottle", 1, SOURCES, Length(3), tmp_path / "films", photos))
    assert moved.meshes[0].channels is None and (moved.visible > 0.7).all()  # of few pixels
    assert not (moved.poses[0] == moved.poses[2]).all()
