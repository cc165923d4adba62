"""edgegrad track."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import outputs
from .arguments import add_mesh, add_out, add_size, add_view, count, number
from .films import MOST_FPS, USUAL_FPS, read_film, write_film
from .inputs import read_photo_view, read_pose, read_scene

if TYPE_CHECKING:
    from torch import Tensor

    from .. import Camera
    from ..scene.scene import Scene
    from ..track import TrackedPose

FRAMES_BETWEEN_WRITES = 10  # frames between two writings of poses.json
FOUND, LOST = (60.0, 230.0, 90.0), (230.0, 60.0, 60.0)  # colours of contours: sure, and not


def add(commands: Any) -> None:
    parser = commands.add_parser("track", help="follow a mesh through a video", description=run.__doc__)
    add_mesh(parser)
    parser.add_argument("film", type=Path, metavar="VIDEO_OR_FOLDER", help="a video, or a folder of images, by name")
    add_view(parser)
    parser.add_argument(
        "--init", type=Path, metavar="POSE.json", required=True,
        help="pose in the first frame, as fit-pose writes it; or the poses.json of a film that this one continues: the last pose "
        "that is not lost",
    )  # fmt: skip
    add_size(parser)
    parser.add_argument("--spp", type=count, default=8, help="samples a pixel (%(default)s)")
    parser.add_argument("--seed", type=number, default=0)
    parser.add_argument(
        "--fps", type=_rate, help=f"frames a second of the film that is written (the video's; of a folder {USUAL_FPS})"
    )
    add_out(parser, "poses.json, frames with contours, and film.mp4 or .webp")
    parser.set_defaults(run=run)


def _rate(text: str) -> int:
    if (found := count(text)) > MOST_FPS:
        raise argparse.ArgumentTypeError(f"expected 1 to {MOST_FPS} frames a second, got {text!r}")
    return found


def run(args: argparse.Namespace) -> int:
    """Follow a mesh through the frames of a video, from its pose in the first one. poses.json is written every few frames;
    Ctrl-C and broken frames keep the poses so far."""
    from ..fit import FitOptions
    from ..track import track
    from . import INTERRUPTED

    scene, init = read_scene(args), read_pose(args.init)
    frames, fps = read_film(args.film, args.camera)
    first = next(frames)
    camera, assumed = read_photo_view(args, scene, args.film, first, args.init)
    outputs.make_folder(args.out)
    outputs.print_note(assumed)
    overlays = args.out / "frames"
    overlays.mkdir(exist_ok=True)
    shown: list[Tensor] = []

    def watched() -> Iterator[Tensor]:
        for frame in chain([first], frames):
            shown[:] = [frame]
            yield frame

    poses: list[TrackedPose] = []
    written: list[Path] = []
    interrupted = False
    try:
        options = FitOptions(max_size=args.size, spp=args.spp, seed=args.seed)
        for pose in track(scene, watched(), camera, init.matrix, options=options):
            poses.append(pose)
            if pose.index % FRAMES_BETWEEN_WRITES == 0:
                with suppress(OSError):  # the last copy reports errors
                    _write_poses(args.out, poses)
            state = "lost" if pose.lost else f"right with a probability of {pose.confidence:.1%}"
            print(f"frame {pose.index}: {state}", file=sys.stderr)
            path = overlays / f"{pose.index:05d}.png"
            _write_overlay(path, shown[0], scene, camera, pose)
            written.append(path)
    except KeyboardInterrupt:
        interrupted = True
    finally:
        names = ["frames"]
        if poses:
            _write_poses(args.out, poses)
            names.insert(0, "poses.json")
        if film := write_film(args.out, written, Fraction(args.fps or fps or USUAL_FPS)):
            names.append(film)
    lost = sum(pose.lost for pose in poses)
    print(
        f"{len(poses)} {'frame' if len(poses) == 1 else 'frames'}, lost in {lost}\nwrote {', '.join(names)} in {args.out}"
    )
    return INTERRUPTED if interrupted else 0


def _write_poses(folder: Path, poses: list[TrackedPose]) -> None:
    from ..files.paths import write_json

    rows = [
        {
            "frame": pose.index, "mesh_to_world": pose.matrix.tolist(), "confidence": pose.confidence, "lost": pose.lost,
            "visible": pose.visible, "reason": pose.reason,
        }
        for pose in poses
    ]  # fmt: skip
    write_json(folder / "poses.json", {"poses": rows}, indent=1)


def _write_overlay(path: Path, frame: Tensor, scene: Scene, camera: Camera, pose: TrackedPose) -> None:
    """Write the frame with the contour of the mesh."""
    import torch

    from .. import render_aovs, write_image
    from ..files.image import srgb_to_linear

    with torch.no_grad():
        moved = scene.transformed(pose.R, pose.t, pose.scale)
        alpha = render_aovs(moved, camera, ["alpha"], 4, 0)["alpha"][..., 0]
    inside = (alpha > 0.5).float()[None, None]
    pool = torch.nn.functional.max_pool2d
    contour = (pool(inside, 3, 1, 1) + pool(-inside, 3, 1, 1))[0, 0] > 0.5
    picture = frame.clone()
    color = torch.lerp(torch.tensor(LOST), torch.tensor(FOUND), 0.0 if pose.lost else pose.confidence)
    picture[contour] = srgb_to_linear(color / 255.0)
    write_image(path, picture)
