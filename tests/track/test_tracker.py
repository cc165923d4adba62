"""Tracker and track(): errors on films, state, several objects, depth, loss, and bad input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from moving import Film, errors, stone, worst
from quiet_fits import quiet

import edgegrad as eg
from edgegrad.camera.poses import rotation
from edgegrad.files.image import linear_to_srgb
from edgegrad.track import Tracker, track
from edgegrad.track.confidence import TRACK_CONFIDENCE, confidence_of

SIDE, COUNT = 160, 12


def bytes_of(frame: torch.Tensor) -> torch.Tensor:
    return (linear_to_srgb(frame) * 255.0).round().byte()


@pytest.fixture(scope="module")
def film() -> Film:
    return Film.turning(SIDE, COUNT, spp=16)


@pytest.fixture(scope="module")
def frames(film: Film) -> list[torch.Tensor]:
    return [bytes_of(frame) for frame in film]


def test_a_rotating_stone_is_followed_frame_by_frame(film, frames):
    tracker = Tracker(film.mesh, film.camera, film.poses[0])
    found = [tracker.update(frame) for frame in frames]
    degrees, percent = worst([errors(film, pose.index, pose.R, pose.t) for pose in found])
    assert degrees < 1.5 and percent < 4.0
    assert [pose.index for pose in found] == list(range(COUNT)) and not any(pose.lost for pose in found)
    last = found[-1]
    assert torch.equal(last.matrix[:3, :3], last.R) and torch.equal(last.matrix[:3, 3], last.t)
    assert last.reason == "seen" and last.confidence > 0.5 and 0.9 < last.visible <= 1.0
    assert set(TRACK_CONFIDENCE.names) <= set(last.features) and last.confidence == confidence_of(last.features)
    assert last.covariance.shape == (6, 6) and bool((torch.linalg.eigvalsh(last.covariance) > 0.0).all())


def test_a_film_is_read_as_far_as_poses_are_asked_for(film, frames):
    read = []

    def one_by_one():
        for frame in frames:
            read.append(frame)
            yield frame

    poses = track(film.mesh, one_by_one(), film.camera, film.poses[0])
    first = next(poses)
    assert len(read) == 1 and first.index == 0


def test_the_first_pose_may_be_off(film, frames):
    start = film.poses[0].clone()
    start[:3, :3] = rotation(torch.tensor([0.08, -0.06, 0.05]).double()) @ start[:3, :3]
    start[:3, 3] += torch.tensor([0.03, -0.03, 0.03]).double()
    found = list(track(film.mesh, frames[:4], film.camera, start))
    assert errors(film, 3, found[-1].R, found[-1].t)[0] < 1.5


def test_float_frames_are_linear_radiance(film, frames):
    a = [tracker.update(bytes_of(f)) for tracker in [Tracker(film.mesh, film.camera, film.poses[0])] for f in film]
    b = [tracker.update(f) for tracker in [Tracker(film.mesh, film.camera, film.poses[0])] for f in film]
    for one, other in zip(a, b, strict=True):
        assert math.degrees(float(torch.linalg.norm(one.R - other.R)) / math.sqrt(2.0)) < 0.3
        assert float((one.t - other.t).norm()) < 0.02


def test_grey_frames(film, frames):
    grey = [(frame.float() @ torch.tensor([0.3, 0.59, 0.11])).round().byte()[..., None] for frame in frames]
    colors = film.mesh.colors @ torch.tensor([[0.3], [0.59], [0.11]])
    found = list(track(eg.Mesh(film.mesh.verts, film.mesh.faces, colors=colors), grey[:6], film.camera, film.poses[0]))
    degrees, percent = worst([errors(film, pose.index, pose.R, pose.t) for pose in found])
    assert degrees < 3.5 and percent < 5.0


def other_stone(film: Film) -> tuple[eg.Mesh, torch.Tensor]:
    """Return a second body to the left, in front."""
    mesh = stone(2)
    mesh = mesh.replace(verts=0.6 * mesh.verts)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, 3] = torch.tensor([-0.55, 0.0, -0.7]).double()
    return mesh, pose


def test_objects_that_cover_one_another_have_the_same_poses_at_any_number_of_threads(film):
    mesh, pose = other_stone(film)
    pictures = []
    for k in range(5):
        here = film.mesh.transformed(film.poses[k][:3, :3].float(), film.poses[k][:3, 3].float())
        there = mesh.transformed(pose[:3, :3].float(), pose[:3, 3].float())
        background = torch.full((SIDE, SIDE, 3), 0.3)
        pictures.append(
            bytes_of(eg.render(eg.Scene([here, there], background=background), film.camera, spp=16, seed=k))
        )
    runs = []
    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            tracker = Tracker([film.mesh, mesh], film.camera, [film.poses[0], pose])
            runs.append([tracker.update(picture) for picture in pictures])
    finally:
        torch.set_num_threads(before)
    for one, other in zip(*runs, strict=True):
        assert len(one) == 2
        for a, b in zip(one, other, strict=True):
            assert torch.equal(a.matrix, b.matrix) and torch.equal(a.covariance, b.covariance)
    # The nearer one covers the other, which does not claim what it shows.
    first, second = runs[0][-1]
    assert second.visible > 0.95 and first.visible < 0.9
    assert errors(film, 4, first.R, first.t)[0] < 2.5
    assert float((second.t - pose[:3, 3]).norm()) < 0.05


def test_a_saved_state_goes_on_with_the_same_bits(film, frames, tmp_path):
    tracker = Tracker(film.mesh, film.camera, film.poses[0])
    for frame in frames[:5]:
        tracker.update(frame)
    torch.save(tracker.state_dict(), tmp_path / "state.pt")
    expected = [tracker.update(frame) for frame in frames[5:8]]
    again = Tracker(film.mesh, film.camera, film.poses[0])
    again.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for pose, frame in zip(expected, frames[5:8], strict=True):
        other = again.update(frame)
        assert (
            torch.equal(other.matrix, pose.matrix) and other.confidence == pose.confidence and other.index == pose.index
        )
    with pytest.raises(ValueError, match="state: expected"):
        again.load_state_dict({})
    other = Tracker(eg.Mesh(1.01 * film.mesh.verts, film.mesh.faces), film.camera, film.poses[0])
    with pytest.raises(ValueError, match=r"state: expected objects\[0\] to be of this tracker's mesh"):
        other.load_state_dict(again.state_dict())


def test_depth_holds_a_plain_mesh(film, frames):
    plain = eg.Mesh(film.mesh.verts, film.mesh.faces)
    depths = []
    for pose in film.poses[:4]:
        moved = plain.transformed(pose[:3, :3].float(), pose[:3, 3].float())
        channels = eg.render_aovs(eg.Scene([moved]), film.camera, ["depth", "alpha"], seed=0)
        alpha = channels["alpha"][..., 0]
        depths.append(torch.where(alpha > 0.99, channels["depth"][..., 0] / alpha, torch.nan))
    for pose in track(plain, frames[:4], film.camera, film.poses[0], depths=depths):
        degrees, percent = errors(film, pose.index, pose.R, pose.t)
        assert degrees < 1.0 and percent < 1.0


@pytest.mark.slow
def test_an_object_that_is_gone_is_lost_and_found_again(film):
    gone = replace(film, poses=[film.poses[0]] * 9, gone=(2, 6))
    tracker = Tracker(film.mesh, film.camera, film.poses[0], options=quiet(spp=2), wait=True)
    found = [tracker.update(bytes_of(frame)) for frame in gone]
    assert [pose.lost for pose in found] == [k in range(2, 6) for k in range(9)]
    assert torch.equal(found[3].matrix, found[5].matrix)  # where it was seen last
    assert errors(gone, 8, found[-1].R, found[-1].t)[0] < 1.5
    assert found[4].reason.startswith("lost: ")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda frame: frame[:-1], r"frames\[1\]: expected shape"),
        (lambda frame: frame[..., :2], r"frames\[1\]: expected 3 channels"),
        (lambda frame: frame.int(), r"frames\[1\]: expected"),
        (lambda frame: (frame / 255.0).index_fill(0, torch.tensor([3]), torch.nan), r"frames\[1\]: expected finite"),
        (lambda frame: "missing.png", r"frames\[1\]"),
        (lambda frame: None, r"frames\[1\]: expected an image"),
    ],
)
def test_a_frame_that_cannot_be_used_is_named_and_changes_nothing(film, frames, spoil, words):
    tracker = Tracker(film.mesh, film.camera, film.poses[0])
    tracker.update(frames[0])
    before = tracker.state_dict()
    with pytest.raises((TypeError, ValueError, OSError), match=words):
        tracker.update(spoil(frames[1]))
    after = tracker.state_dict()
    assert after["index"] == 1 and torch.equal(before["objects"][0]["numbers"], after["objects"][0]["numbers"])
    assert tracker.update(frames[1]).index == 1


def test_depth_without_measurements_counts_for_nothing(film, frames):
    a, b = (Tracker(film.mesh, film.camera, film.poses[0]) for _ in range(2))
    for frame in frames[:3]:
        nothing = np.full((SIDE, SIDE), np.nan, np.float32)
        assert torch.equal(a.update(frame).matrix, b.update(frame, nothing).matrix)
    with pytest.raises(ValueError, match=r"depths\[3\]: expected shape"):
        b.update(frames[3], torch.ones(3, 3))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera": None}, "camera: expected"),
        ({"mesh": 3}, "mesh: expected"),
        ({"mesh": eg.Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))}, "mesh: expected faces with an area"),
        ({"mesh": []}, "mesh: expected"),
        ({"init": torch.eye(3)}, "init: expected"),
        (
            {"init": torch.diag(torch.tensor([1.0, 1.0, 1.0, 1.0])) + 50.0 * torch.eye(4)[:, [3, 0, 1, 2]].T},
            "init: expected",
        ),
        ({"mesh": [stone(1), stone(1)]}, "init: expected a pose for each of 2 meshes"),
        ({"options": quiet(steps=4)}, "options.steps"),
    ],
)
def test_bad_arguments_are_named(film, change, words):
    given = {"mesh": film.mesh, "camera": film.camera, "init": film.poses[0], **change}
    options = given.pop("options", None)
    with pytest.raises((TypeError, ValueError), match=words):
        Tracker(given["mesh"], given["camera"], given["init"], options=options)


def test_an_object_out_of_view_or_behind_the_camera_is_refused_at_the_start(film):
    aside, behind = film.poses[0].clone(), film.poses[0].clone()
    V = film.camera.world_to_camera.double()
    aside[:3, 3] += 20.0 * V[0, :3]
    behind[:3, 3] -= 20.0 * V[2, :3]
    with pytest.raises(ValueError, match="init: expected a pose at which the camera sees"):
        Tracker(film.mesh, film.camera, aside)
    with pytest.raises(ValueError, match="init: expected the object in front"):
        Tracker(film.mesh, film.camera, behind)


def test_an_object_that_leaves_the_picture_is_lost_without_an_error(film, frames):
    tracker = Tracker(eg.Mesh(film.mesh.verts, film.mesh.faces), film.camera, film.poses[0], options=quiet(spp=1))
    tracker.update(frames[0])
    black = torch.zeros_like(frames[0])
    found = [tracker.update(black) for _ in range(2)]
    assert all(pose.lost and torch.isfinite(pose.matrix).all() for pose in found)
