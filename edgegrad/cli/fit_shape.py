"""edgegrad fit-shape."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from .arguments import add_descent, add_label, add_live, add_views, count
from .inputs import read_coverage, read_options, read_views
from .outputs import finish, live_view, make_folder


def add(commands: Any) -> None:
    parser = commands.add_parser("fit-shape", help="find a shape from masks", description=run.__doc__)
    parser.add_argument("mesh", type=Path, metavar="MESH", help="where to begin; its materials do not count")
    add_views(parser, "masks, white on the object, or pictures whose alpha is one")
    add_label(parser)
    parser.add_argument("--levels", type=count, default=3, help="from coarse to fine (%(default)s)")
    parser.add_argument("--faces", type=count, help="about so many at the end (four times as many on each level)")
    add_descent(parser, "mesh.ply")
    add_live(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the shape of an object from masks, beginning with the mesh, which may be a sphere around the object. Ctrl-C keeps
    the best so far, and --resume goes on from there."""
    from .. import load_mesh
    from ..fit import Refinement, fit_shape

    mesh = load_mesh(args.mesh, materials=False)
    cameras, _, _ = read_views(args)
    masks = [read_coverage(path, args.label) for path in args.images]
    make_folder(args.out)
    with live_view(args) as view:
        refinement = Refinement(args.levels, args.faces)
        options = read_options(args, view, spp=args.spp)
        fit = fit_shape(mesh, None, cameras, masks=masks, refinement=refinement, options=options)
        return finish(fit, args.out, view)
