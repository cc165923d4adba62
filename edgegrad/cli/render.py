"""edgegrad render."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .arguments import add_mesh, add_view, count, number, shape
from .inputs import read_background, read_pose, read_scene, read_view
from .outputs import make_folder


def add(commands: Any) -> None:
    parser = commands.add_parser("render", help="render a mesh", description=run.__doc__)
    add_mesh(parser)
    parser.add_argument(
        "--out", type=Path, required=True, metavar="IMAGE", help="EXR, HDR (linear), PNG, JPEG or TIFF (sRGB)"
    )
    add_view(parser)
    parser.add_argument("--pose", type=Path, metavar="POSE.json", help="where to put the mesh, as fit-pose writes it")
    parser.add_argument("--background", help="#rrggbb or an image; black when left out")
    parser.add_argument(
        "--size", type=shape, metavar="WIDTHxHEIGHT", help="pixels; one number for a square (the camera's, or 512x512)"
    )  # fmt: skip
    parser.add_argument("--spp", type=count, default=64, help="samples a pixel (%(default)s)")
    parser.add_argument("--seed", type=number, default=0)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Render a mesh to an image file; one without colours under a headlight."""
    import torch

    from .. import render, write_image
    from ..preview import under_headlight

    scene = read_scene(args)
    pose = None if args.pose is None else read_pose(args.pose)
    camera = read_view(args, scene, args.size, args.pose)
    if pose is not None:
        scene = scene.transformed(pose.R, pose.t, pose.scale)
    if args.background is not None:
        scene = scene.replace(background=read_background(args.background, torch.empty(*camera.size, 3)))
    make_folder(args.out.absolute().parent)
    with torch.no_grad():
        write_image(args.out, render(under_headlight(scene, camera), camera, spp=args.spp, seed=args.seed))
    print(f"wrote {args.out}")
    return 0
