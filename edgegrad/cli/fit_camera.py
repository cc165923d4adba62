"""edgegrad fit-camera."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .arguments import CHECKPOINT, add_background, add_live, add_mesh, add_out, add_resume, add_steps, add_view, number
from .inputs import read_background, read_options, read_picture, read_scene, read_view, seen_by
from .outputs import finish, live_view, make_folder


def add(commands: Any) -> None:
    parser = commands.add_parser("fit-camera", help="find the camera of a picture", description=run.__doc__)
    add_mesh(parser)
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the picture; an alpha channel is taken as the mask")
    add_view(parser)
    parser.add_argument("--no-focal", action="store_true", help="keep the focal length")
    parser.add_argument("--principal", action="store_true", help="also find the principal point")
    parser.add_argument(
        "--distortion", type=number, default=0, metavar="N", help="also find so many coefficients, up to 8 (a fisheye: 4)"
    )  # fmt: skip
    add_background(parser)
    add_steps(parser, 60)
    parser.add_argument("--seed", type=number, default=0)
    add_resume(parser)
    add_out(parser, f"camera.json, calibration.json, history.json, pose.json, fit.png, loss.png, {CHECKPOINT}")
    add_live(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find pose and focal length of the camera that took a picture of a mesh, from a start within about 30° and 15 % of the
    mesh's size. Ctrl-C keeps the best so far, and --resume goes on from there."""
    from ..fit import fit_camera

    scene = read_scene(args)
    args.image = seen_by(args.camera, args.image)
    picture, mask = read_picture(args.image)
    if mask is not None and args.background is not None:
        raise ValueError("--background: expected none with an image that has alpha, got both; leave one out")
    start = read_view(args, scene, (picture.shape[0], picture.shape[1]), None)
    if args.background is not None:
        scene = scene.replace(background=read_background(args.background, picture))
    make_folder(args.out)
    with live_view(args) as view:
        fit = fit_camera(
            scene, picture, start, masks=mask, focal=not args.no_focal, principal=args.principal, distortion=args.distortion,
            options=read_options(args, view),
        )  # fmt: skip
        K = fit.camera.K.tolist()
        print(f"focal length {K[0][0]:.6g} px, principal point {K[0][2]:.6g}, {K[1][2]:.6g} px", flush=True)
        if fit.uncertainty is not None:
            print(f"standard deviation: {fit.uncertainty.words}", flush=True)
        return finish(fit, args.out, view)
