"""edgegrad fit-texture."""

from __future__ import annotations

import argparse
from typing import Any

from .arguments import add_descent, add_live, add_mesh, add_views, count
from .inputs import read_background, read_mesh, read_options, read_views
from .outputs import finish, live_view, make_folder


def add(commands: Any) -> None:
    parser = commands.add_parser("fit-texture", help="find a texture from pictures", description=run.__doc__)
    add_mesh(parser)
    add_views(parser, "the pictures; an alpha channel is taken as the mask")
    parser.add_argument("--size", type=count, default=512, help="texels on a side (%(default)s)")
    parser.add_argument("--background", help="#rrggbb, where pictures have no alpha; black when left out")
    add_descent(parser, "texture.png, mesh.glb")
    add_live(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the texture of a mesh that has texture coordinates from pictures of it. Ctrl-C keeps the best so far, and --resume
    goes on from there."""
    from ..fit import fit_texture

    mesh = read_mesh(args)
    cameras, pictures, alphas = read_views(args)
    masks = [alpha for alpha in alphas if alpha is not None]
    if masks and len(masks) < len(alphas):
        without = next(path for path, alpha in zip(args.images, alphas, strict=True) if alpha is None)
        raise ValueError(f"{without}: expected alpha like that of other pictures, got none; give it to all, or to none")
    if masks and args.background is not None:
        raise ValueError("--background: expected none with images that have alpha, got both; leave one out")
    background = read_background(args.background, pictures[0])
    make_folder(args.out)
    with live_view(args) as view:
        fit = fit_texture(
            mesh, pictures, cameras, args.size, masks=masks or None, background=background,
            options=read_options(args, view, spp=args.spp),
        )  # fmt: skip
        return finish(fit, args.out, view)
