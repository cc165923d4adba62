"""edgegrad fit-rig."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .arguments import add_descent, add_label, add_live, add_views, count, number
from .inputs import read_coverage, read_options, read_views
from .outputs import finish, live_view, make_folder


def add(commands: Any) -> None:
    parser = commands.add_parser("fit-rig", help="find the pose of a rig from masks", description=run.__doc__)
    parser.add_argument(
        "rig", type=Path, metavar="RIG", help="glTF or GLB with a skin or morph targets, or a robot's URDF"
    )
    add_views(parser, "masks, white on the object, or pictures whose alpha is one")
    add_label(parser)
    parser.add_argument("--seek", nargs="+", metavar="NAME", help="joints and controls (all joints, and translation)")
    parser.add_argument(
        "--search", type=number, default=40, help="limbs drawn anew; 0 for a start nearby (%(default)s)"
    )
    parser.add_argument("--coarsest", type=count, default=16, help="pixels of the first level (%(default)s)")
    add_descent(parser, "pose.json, posed.glb")
    parser.set_defaults(steps=15)
    add_live(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find how a skinned mesh or a robot is posed from masks, from coarse to fine, beginning at rest. Ctrl-C keeps the best so
    far, and --resume goes on from there."""
    from ..fit import fit_rig
    from ..rig.files import load

    rig = load(args.rig)
    cameras, _, _ = read_views(args)
    masks = [read_coverage(path, args.label) for path in args.images]
    make_folder(args.out)
    with live_view(args) as view:
        options = read_options(args, view, spp=args.spp, coarsest=args.coarsest)
        found = fit_rig(rig, None, cameras, masks=masks, seek=args.seek, search=args.search, options=options)
        unknown = "" if found.uncertainty is None else found.uncertainty.unknown
        if unknown and unknown not in found.reason:
            print(f"not determined by the masks: {unknown}", flush=True)
        return finish(found, args.out, view)
