"""`edgegrad track` reads videos, follows the mesh, and writes a film with its contour; broken videos are named."""

from __future__ import annotations

import json
import sys
from fractions import Fraction

import numpy as np
import pytest
import torch
from moving import errors

import edgegrad as eg
from edgegrad.cli import films, main
from edgegrad.cli.films import read_film, upright
from edgegrad.files.image import linear_to_srgb

av = pytest.importorskip("av", reason="videos need the extra edgegrad[video]")

pytest_plugins = "film_fixtures"
COUNT = 4


@pytest.fixture(scope="module")
def pictures(frames: list[torch.Tensor]) -> list[np.ndarray]:
    """Return frames of 8 bits."""
    return [(linear_to_srgb(frame) * 255.0).round().byte().numpy() for frame in frames[:COUNT]]


def write_video(path, pictures, codec, fps=12):
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=fps)
        stream.bit_rate = 8_000_000
        stream.height, stream.width = pictures[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
        container.mux(stream.encode())


def write_sound(path):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        silence = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        silence.sample_rate = 8000
        container.mux(stream.encode(silence))
        container.mux(stream.encode())


CODECS = [("film.mp4", "libx264"), pytest.param("film.avi", "mpeg4", marks=pytest.mark.slow)]


@pytest.mark.parametrize(("name", "codec"), CODECS)
def test_a_video_is_followed(film, pictures, arguments, tmp_path, monkeypatch, name, codec):
    if codec not in av.codecs_available:
        pytest.skip(f"FFmpeg was built without {codec}")
    write_video(tmp_path / name, pictures, codec)
    monkeypatch.setattr(films, "CODECS", (codec,))  # of what is written
    assert main(arguments(name)) == 0
    rows = json.loads((tmp_path / "out" / "poses.json").read_text())["poses"]
    assert len(rows) == COUNT
    for row in rows:
        M = torch.tensor(row["mesh_to_world"], dtype=torch.float64)
        degrees, percent = errors(film, row["frame"], M[:3, :3], M[:3, 3])
        assert degrees < 1.5 and percent < 6.0 and not row["lost"]  # 9° further than the start
    # The film shows the frames, with the contours that the pictures have, at the video's rate.
    with av.open(str(tmp_path / "out" / "film.mp4")) as container:
        assert container.streams.video[0].average_rate == Fraction(12)
        written = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(written) == COUNT
    for k, (picture, frame) in enumerate(zip(written, pictures, strict=True)):
        drawn = eg.read_image(tmp_path / "out" / "frames" / f"{k:05d}.png", channels=3)
        drawn = (linear_to_srgb(drawn) * 255.0).round().numpy()
        contour = np.abs(drawn - frame).max(-1) > 60.0
        assert 0.01 < contour.mean() < 0.2
        assert np.abs(picture - drawn)[~contour].mean() < 6.0  # of 255
        # Colours have half the resolution in a film; its green stands out all the same.
        green = picture[..., 1] - picture[..., [0, 2]].mean(-1) - (frame[..., 1] - frame[..., [0, 2]].mean(-1))
        assert green[contour].mean() > 20.0


def test_frames_of_a_video_are_read_as_they_were_written(pictures, tmp_path):
    write_video(tmp_path / "film.mp4", pictures, "mpeg4")
    film = read_film(tmp_path / "film.mp4")
    read = [linear_to_srgb(frame) * 255.0 for frame in film.frames]
    assert film.fps == 12 and len(read) == COUNT
    for picture, frame in zip(read, pictures, strict=True):
        # Means over 8 × 8 pixels: colours lose their detail.
        means = [torch.nn.functional.avg_pool2d(x.movedim(-1, 0), 8) for x in (picture, torch.tensor(frame).float())]
        off = (means[0] - means[1]).abs()
        assert float(off.max()) < 10.0 and float(off.mean()) < 2.0


def test_frames_are_rotated_as_the_file_says():
    picture = torch.arange(6.0).reshape(2, 3, 1)
    assert torch.equal(upright(picture, 0), picture)
    assert upright(picture, 90)[..., 0].tolist() == [[2.0, 5.0], [1.0, 4.0], [0.0, 3.0]]  # counterclockwise
    assert torch.equal(upright(picture, -90), upright(picture, 270))
    assert torch.equal(upright(picture, 180), picture.flip(0, 1))


@pytest.mark.parametrize("matrix", [(1, 0, 0, 1), (0, 1, -1, 0), (-1, 0, 0, -1), (0, -1, 1, 0), (-1, 0, 0, 1), (1, 0, 0, -1),
                                    (0, 1, 1, 0), (0, -1, -1, 0)])  # fmt: skip
def test_all_orientations_of_a_film_are_shown_as_players_do(matrix, tmp_path):
    """The display matrix in the tkhd takes a pixel (p, q) to (a p + c q, b p + d q); those of front cameras mirror."""
    stored = np.zeros((48, 64, 3), np.uint8)
    stored[:24, :32, 0], stored[:24, 32:, 1], stored[24:, :32, 2] = 255, 255, 255
    write_video(tmp_path / "a.mp4", [stored] * 2, "mpeg4")
    content = (tmp_path / "a.mp4").read_bytes()
    a, b, c, d = matrix
    at = content.index(b"tkhd") + 44
    rows = (np.array([a, b, 0, c, d, 0, 0, 0, 1 << 14]) << 16).astype(">i4")
    (tmp_path / "a.mp4").write_bytes(content[:at] + rows.tobytes() + content[at + 36 :])
    # Each pixel of the stored picture where the matrix takes its middle, from the corner that the picture then begins at.
    q, p = np.mgrid[:48, :64] + 0.5
    x, y = a * p + c * q, b * p + d * q
    x, y = (x - x.min()).astype(int), (y - y.min()).astype(int)
    expected = np.zeros((y.max() + 1, x.max() + 1, 3))
    expected[y, x] = stored / 255.0
    frames = list(read_film(tmp_path / "a.mp4").frames)
    assert len(frames) == 2
    for frame in frames:
        assert frame.shape == expected.shape
        assert float((frame - torch.tensor(expected)).abs().mean()) < 0.05


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: path.write_bytes(b""), "expected a video"),
        (lambda path: path.write_bytes(b"no film at all\n" * 40), "expected a video"),
        (write_sound, "without pictures"),
        (lambda path: write_video(path, [np.zeros((48, 64, 3), np.uint8)] * 2, "mpeg4"), "expected a camera for 64"),
    ],
)
def test_what_is_no_video_of_the_camera_is_named(arguments, tmp_path, capsys, make, words):
    make(tmp_path / "film.mp4")
    code = main([*arguments("film.mp4")])
    error = capsys.readouterr().err
    assert code == 2 and words in error and "Traceback" not in error
    assert not (tmp_path / "out" / "poses.json").exists()


def test_frames_of_another_size_end_what_is_kept(film, pictures, arguments, tmp_path, capsys):
    """Joined streams may change their size on the way."""
    write_video(tmp_path / "a.mjpeg", pictures[:2], "mjpeg")
    write_video(tmp_path / "b.mjpeg", [frame[:64, :64] for frame in pictures[2:]], "mjpeg")
    (tmp_path / "film.mjpeg").write_bytes((tmp_path / "a.mjpeg").read_bytes() + (tmp_path / "b.mjpeg").read_bytes())
    assert main(arguments("film.mjpeg")) == 2
    assert "frames[2]: expected shape" in capsys.readouterr().err
    assert len(json.loads((tmp_path / "out" / "poses.json").read_text())["poses"]) == 2
    with av.open(str(tmp_path / "out" / "film.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 2


def test_without_the_library(pictures, arguments, tmp_path, capsys, monkeypatch):
    write_video(tmp_path / "film.mp4", pictures, "mpeg4")
    monkeypatch.setitem(sys.modules, "av", None)
    assert main(arguments("film.mp4")) == 2
    assert "pip install 'edgegrad[video]'" in capsys.readouterr().err
