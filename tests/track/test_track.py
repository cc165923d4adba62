"""edgegrad.track.track and `edgegrad track` follow a mesh in a film, in unknown light, before clutter."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
import torch
from moving import DISTANCE, Film, errors, worst
from PIL import Image
from quiet_fits import arranged

import edgegrad as eg
from edgegrad.camera.poses import rotation
from edgegrad.cli import main
from edgegrad.fit import FitOptions
from edgegrad.fit.pose.result import pose_from_json
from edgegrad.track import track

pytest_plugins = "film_fixtures"
SIZE, COUNT = 160, 7  # of its film


def test_a_rotating_stone_is_followed(film, frames):
    read = []

    def one_by_one():
        for frame in frames:
            read.append(frame)
            yield frame

    poses = track(film.mesh, one_by_one(), film.camera, film.poses[0], options=FitOptions(seed=0))
    first = next(poses)
    assert len(read) == 1 and first.index == 0  # no more than is asked for
    found = [first, *poses]
    assert [pose.index for pose in found] == list(range(COUNT)) and not any(pose.lost for pose in found)
    degrees, percent = worst([errors(film, pose.index, pose.R, pose.t) for pose in found])
    assert degrees < 1.5 and percent < 6.0  # 18° further than the start; most of the way off is along the view
    assert min(pose.confidence for pose in found) > 0.5
    assert torch.equal(found[-1].matrix[:3, :3], found[-1].R) and torch.equal(found[-1].matrix[:3, 3], found[-1].t)


@pytest.mark.slow
def test_lost_and_found_again(film):
    gone = replace(film, poses=[film.poses[0]] * 8, gone=(1, 6))
    found = list(track(film.mesh, gone, film.camera, film.poses[0], options=FitOptions(seed=0, spp=2)))
    assert [pose.lost for pose in found[:6]] == [False] + [True] * 5
    assert not found[-1].lost
    degrees, percent = errors(gone, 7, found[-1].R, found[-1].t)
    assert degrees < 1.5 and percent < 6.0
    assert torch.equal(found[4].matrix, found[5].matrix)  # where it was seen last
    assert {pose.reason.split(":")[0] for pose in found} == {"seen", "lost"}


@pytest.mark.slow
def test_found_again_elsewhere_and_rotated(film):
    """The mesh returns rotated by 30° and shifted by a quarter of the picture. Nothing else is taken for it meanwhile.
    The mesh has other units."""
    there = film.poses[0].clone()
    there[:3, :3] = rotation(torch.tensor([0.3, 0.4, 0.15]).double()) @ there[:3, :3]
    there[:3, 3] += film.camera.world_to_camera[1, :3].double() * 0.25 * 2.0 * DISTANCE * math.tan(math.radians(20.0))
    gone = replace(film, poses=[film.poses[0]] * 7 + [there] * 4, gone=(1, 7))
    larger = film.mesh.replace(verts=100.0 * film.mesh.verts)
    init = film.poses[0] @ torch.diag(torch.tensor([0.01, 0.01, 0.01, 1.0]).double())
    found = list(track(larger, gone, film.camera, init, options=FitOptions(seed=0, spp=2)))
    assert all(pose.lost for pose in found[1:7]) and not found[-1].lost
    assert found[-1].scale == pytest.approx(0.01)
    degrees, percent = errors(gone, 10, found[-1].R, found[-1].t)
    assert degrees < 2.0 and percent < 6.0


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda image: image.index_fill(0, torch.tensor([3]), torch.nan), "frames[1]: expected finite numbers"),
        (lambda image: image[:-1], "frames[1]: expected shape"),
        (lambda image: image[..., :2], "frames[1]: expected 3 channels"),
        (lambda image: "missing.png", "frames[1]"),
    ],
)
def test_a_broken_frame_is_named(spoil, words):
    film, found = Film.turning(32, 2, spp=8), []
    given = [film.frame(0), spoil(film.frame(1))]
    assert not list(track(film.mesh, [], film.camera, film.poses[0], options=FitOptions(seed=0)))
    with pytest.raises((ValueError, OSError)) as caught:
        for pose in track(film.mesh, given, film.camera, film.poses[0], options=FitOptions(seed=0, spp=2)):
            found.append(pose)
    assert words in str(caught.value) and len(found) == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": "film.mp4"}, "frames: expected"),
        ({"frames": torch.zeros(SIZE, SIZE, 3)}, "frames: expected"),
        ({"camera": None}, "camera: expected"),
        ({"mesh": 3}, "mesh: expected"),
        ({"init": torch.eye(3)}, "init: expected"),
        ({"spp": 0}, "spp: expected"),
        ({"depths": 1.0}, "depths: expected"),
        ({"depths": torch.ones(SIZE, SIZE)}, r"depths: expected \(T, H, W\), got"),
    ],
)
def test_bad_arguments_are_named_at_once(film, frames, change, words):
    given = {"mesh": film.mesh, "frames": frames, "camera": film.camera, "init": film.poses[0], **change}
    with pytest.raises((TypeError, ValueError), match=words):
        track(**arranged(**given))


def test_depth_for_each_frame(film, frames):
    small = Film.turning(32, 2, spp=8)
    with pytest.raises(ValueError, match="depths: expected one for each frame, got 1"):
        list(track(small.mesh, small, small.camera, small.poses[0], depths=[None], options=FitOptions(seed=0)))
    plain = eg.Mesh(film.mesh.verts, film.mesh.faces)
    depths = []
    for pose in film.poses[:3]:
        moved = plain.transformed(pose[:3, :3].float(), pose[:3, 3].float())
        channels = eg.render_aovs(eg.Scene([moved]), film.camera, ["depth", "alpha"], seed=0)
        alpha = channels["alpha"][..., 0]
        depths.append(torch.where(alpha > 0.99, channels["depth"][..., 0] / alpha, torch.nan))
    for pose in track(plain, frames[:3], film.camera, film.poses[0], depths=depths, options=FitOptions(seed=0)):
        degrees, percent = errors(film, pose.index, pose.R, pose.t)
        assert degrees < 0.3 and percent < 0.2


def test_command_line_on_a_folder(film, frames, arguments, tmp_path, capsys):
    folder = tmp_path / "film"
    folder.mkdir()
    for k, frame in enumerate(frames[:2]):
        eg.write_image(folder / f"{k}.png", frame)
    with Image.open(folder / "1.png") as picture:
        picture.save(folder / "1.webp", lossless=True)
    (folder / "1.png").unlink()
    out = tmp_path / "out"
    assert main(arguments("film")) == 0
    rows = json.loads((out / "poses.json").read_text())["poses"]
    for row in rows:
        M = torch.tensor(row["mesh_to_world"], dtype=torch.float64)
        degrees, percent = errors(film, row["frame"], M[:3, :3], M[:3, 3])
        assert degrees < 1.0 and percent < 6.0 and not row["lost"]
    assert len(rows) == 2 and (out / "frames" / "00001.png").is_file()
    assert any((out / name).is_file() for name in ("film.mp4", "film.webp"))
    # The contour is drawn on the frame and nowhere else.
    drawn = (eg.read_image(out / "frames" / "00000.png", channels=3) - frames[0]).abs().amax(-1) > 0.02
    assert 0.01 < float(drawn.float().mean()) < 0.2

    # The next part of the film goes on from what was found, until a frame of another size.
    following = tmp_path / "following"
    following.mkdir()
    eg.write_image(following / "2.png", frames[2])
    eg.write_image(following / "3.png", frames[3][:-4])
    *given, _ = arguments("following")
    again = [str(tmp_path / "again") if argument == str(out) else argument for argument in given]
    assert main([*again, str(out / "poses.json")]) == 2
    assert "frames[1]: expected" in capsys.readouterr().err
    (row,) = json.loads((tmp_path / "again" / "poses.json").read_text())["poses"]
    M = torch.tensor(row["mesh_to_world"]).double()
    assert errors(film, 2, M[:3, :3], M[:3, 3])[0] < 1.0
    assert main(arguments("nothing")) == 2
    with pytest.raises(SystemExit):  # before the first frame
        main([*arguments("film"), "--fps", "100000"])
    assert "--fps: expected 1 to 1000 frames a second, got '100000'" in capsys.readouterr().err


def test_a_pose_of_a_film_is_the_last_one_that_is_not_lost():
    rows = [{"frame": k, "mesh_to_world": torch.eye(4).tolist(), "lost": k == 2} for k in range(3)]
    for k, row in enumerate(rows):
        row["mesh_to_world"][0][3] = float(k)
    assert pose_from_json(json.dumps({"poses": rows})).t[0] == 1.0
    with pytest.raises(ValueError, match=r"poses: expected one that is not lost, got 1, all lost"):
        pose_from_json(json.dumps({"poses": rows[2:]}))
    with pytest.raises(ValueError, match=r"poses: expected a list of objects, each with mesh_to_world"):
        pose_from_json(json.dumps({"poses": [{}]}))


@pytest.mark.slow
def test_a_hand_that_covers_nearly_half(film):
    """The hand stays for three pictures while the stone rotates. The pose stays, or is said to be lost meanwhile."""
    found = list(track(film.mesh, replace(film, hand=(-4, 9)), film.camera, film.poses[0], options=FitOptions(seed=0)))
    seen = [pose for pose in found if not pose.lost]
    assert len(seen) >= 3
    degrees, percent = worst([errors(film, pose.index, pose.R, pose.t) for pose in seen])
    assert degrees < 2.5 and percent < 6.0


@pytest.mark.slow
def test_two_hundred_frames_and_a_hand():
    film = Film.turning(256, 200, hand=(60, 120))
    found = list(track(film.mesh, film, film.camera, film.poses[0], options=FitOptions(seed=0)))
    degrees = [errors(film, pose.index, pose.R, pose.t)[0] for pose in found]
    assert not any(pose.lost for pose in found)
    assert sum(degrees) / len(degrees) <= 0.5
