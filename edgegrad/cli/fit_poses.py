"""edgegrad fit-poses."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import outputs
from .arguments import add_depth, add_out, add_size, add_steps, add_view, number
from .inputs import check_size, read_depth, read_labels, read_photo_view, read_picture, read_pose, seen_by

if TYPE_CHECKING:
    from ..fit.pose.result import PoseFit


def add(commands: Any) -> None:
    parser = commands.add_parser(
        "fit-poses", help="find several meshes that cover one another in a photograph", description=run.__doc__
    )
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the picture")
    parser.add_argument(
        "--mesh", type=Path, action="append", required=True, metavar="MESH", help="OBJ, glTF, GLB, PLY, …; once for each object"
    )  # fmt: skip
    parser.add_argument(
        "--init", type=Path, action="append", default=[], metavar="POSE.json",
        help="pose to start from, for each mesh in their order; as in the mesh files when left out",
    )  # fmt: skip
    parser.add_argument(
        "--mask", type=Path, help="image of labels of the picture's size: 1 where the first mesh is seen, 2 the second, …"
    )  # fmt: skip
    add_view(parser)
    add_depth(parser)
    add_size(parser)
    add_steps(parser)
    parser.add_argument("--seed", type=number, default=0)
    add_out(parser, "a folder of each mesh, 1, 2, …, as fit-pose writes it")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Find the poses of several meshes in a photograph, in which they may cover one another, from starts within about 15° and 5
    % of their sizes. Ctrl-C keeps the best poses so far."""
    from .. import Scene, load_scene
    from ..fit import FitOptions, fit_poses
    from . import INTERRUPTED

    if args.init and len(args.init) != len(args.mesh):
        raise ValueError(f"--init: expected {len(args.mesh)}, one for each --mesh, got {len(args.init)}")
    scenes = [load_scene(path) for path in args.mesh]
    args.image = seen_by(args.camera, args.image)
    picture, _ = read_picture(args.image)
    mask = None
    if args.mask is not None:
        mask = read_labels(args.mask, len(scenes))
        check_size(mask[0], picture, args.mask, args.image)
    depth = read_depth(args, picture)
    init = [read_pose(path).matrix for path in args.init] or None
    everything = Scene([mesh for scene in scenes for mesh in scene.meshes])
    camera, assumed = read_photo_view(args, everything, args.image, picture, args.init[0] if args.init else None)
    outputs.make_folder(args.out)
    outputs.print_note(assumed)
    options = FitOptions(max_size=args.size, steps=args.steps, seed=args.seed)
    fits = fit_poses(scenes, picture, camera, mask, init, depths=depth, options=options)
    # Neither a full disk nor a closed terminal may lose the result, as in fit-pose.
    folders = [args.out / str(k + 1) for k in range(len(fits))]
    try:
        for path, fit in zip(args.mesh, fits, strict=True):
            _print_fit(path, fit)
    finally:
        for folder, fit in zip(folders, fits, strict=True):
            fit.save(folder, figures=outputs.can_draw())
    print(f"wrote {', '.join(map(str, folders))}")
    return INTERRUPTED if fits[0].interrupted else 0


def _print_fit(path: Path, fit: PoseFit) -> None:
    said = f"{path}: {fit.reason}; {fit.explained:.0%} of the edges, {fit.visible:.0%} of it to be seen"
    print("\n".join([said, *outputs.pose_lines(fit)]), flush=True)
