"""edgegrad fit-pose."""

from __future__ import annotations

import argparse
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import outputs
from .arguments import (
    CHECKPOINT,
    add_background,
    add_depth,
    add_label,
    add_live,
    add_mesh,
    add_out,
    add_resume,
    add_size,
    add_steps,
    add_view,
    number,
)  # fmt: skip
from .inputs import (
    check_not_black,
    check_size,
    read_background,
    read_coverage,
    read_depth,
    read_options,
    read_photo_view,
    read_picture,
    read_pose,
    read_scene,
    read_weight,
    seen_by,
)  # fmt: skip

if TYPE_CHECKING:
    from ..fit.pose.result import PoseFit


def add(commands: Any) -> None:
    parser = commands.add_parser("fit-pose", help="find a mesh in a picture", description=run.__doc__)
    add_mesh(parser)
    parser.add_argument("image", type=Path, metavar="IMAGE", help="the picture; an alpha channel is taken as the mask")
    parser.add_argument("--mask", type=Path, help="image of the picture's size, white on the object, or of labels")
    add_label(parser)
    add_view(parser)
    parser.add_argument(
        "--init", type=Path, metavar="POSE",
        help="pose to start from: a pose.json, or mesh to world 4 × 4 by rows as JSON, text or .npy (as in the mesh file)",
    )  # fmt: skip
    parser.add_argument(
        "--search", type=_search, default=True, metavar="no|N|global",
        help="no: refine the start alone; N starts, around --init or in all rotations; global: the whole picture (other poses, "
        "where the picture does not show the edges)",
    )  # fmt: skip
    add_resume(parser)
    parser.add_argument(
        "--weight", type=Path, help="image of the picture's size: how much a pixel counts, black not at all"
    )
    add_depth(parser)
    parser.add_argument("--scale", action="store_true", help="also find the scale; the distance then stays")
    parser.add_argument("--focal", action="store_true", help="also find the focal length")
    add_background(parser)
    add_size(parser)
    add_steps(parser)
    parser.add_argument("--seed", type=number, default=0)
    add_out(parser, f"pose.json, fit.png, loss.png, {CHECKPOINT}")
    add_live(parser)
    parser.set_defaults(run=run)


def _search(text: str) -> bool | int | str:
    if text in ("no", "global") or (text.isdecimal() and int(text) >= 2):
        return int(text) if text.isdecimal() else text == "global" and text
    raise argparse.ArgumentTypeError(f"expected no, a whole number from 2 up, or global, got {text!r}")


def run(args: argparse.Namespace) -> int:
    """Find rotation and translation of a mesh in a picture, from a start within about 30° and 15 % of the mesh's size. Ctrl-C
    keeps the best pose so far, and --resume goes on from there."""
    from ..fit import fit_pose
    from . import INTERRUPTED

    if args.label is not None and args.mask is None:
        raise ValueError("--label: expected --mask with it, an image that has labels, got none; name it")
    scene = read_scene(args)
    args.image = seen_by(args.camera, args.image)
    picture, mask = read_picture(args.image)
    if args.mask is not None:
        mask = read_coverage(args.mask, args.label)
        check_size(mask, picture, args.mask, args.image)
    if mask is not None:
        check_not_black(mask, args.mask or args.image)
    weight = None
    if args.weight is not None:
        weight = read_weight(args.weight)
        check_size(weight, picture, args.weight, args.image)
    if mask is not None and args.background is not None:
        raise ValueError("--background: expected none with a mask (or an image with alpha), got both; leave one out")
    depth = read_depth(args, picture)
    background = read_background(args.background, picture)
    init = None if args.init is None else read_pose(args.init)
    camera, assumed = read_photo_view(args, scene, args.image, picture, args.init)
    outputs.make_folder(args.out)
    outputs.print_note(assumed)

    with outputs.live_view(args) as view:

        def after_step(fit: PoseFit) -> None:
            # Writing takes far less time than a step, and keeps the best pose on disk, whatever ends the process.
            with suppress(OSError):  # the last copy reports errors
                outputs.write_pose(args.out, fit)
            if view is not None:
                view(fit)

        fit = fit_pose(
            scene if background is None else scene.replace(background=background), picture, camera, mask,
            None if init is None else init.matrix, scale=args.scale, focal=args.focal, weights=weight, depths=depth,
            search=args.search, options=read_options(args, after_step, max_size=args.size),
        )  # fmt: skip
        # Neither a full disk nor a closed terminal may lose the result. It is printed before the files are written, and they
        # are written also if printing fails.
        try:
            _print_fit(fit, args.focal)
        finally:
            written = [*fit.save(args.out, figures=outputs.can_draw()), CHECKPOINT]
        print(f"wrote {', '.join(written)} in {args.out}")
        outputs.wait_for_close(view, fit)
    return INTERRUPTED if fit.interrupted else 0


def _print_fit(fit: PoseFit, focal: bool) -> None:
    lines = [
        f"loss {fit.loss:.3e} after {fit.steps} steps in {fit.seconds:.1f} s, {fit.reason}",
        *outputs.pose_lines(fit),
    ]
    if fit.scale != 1.0:
        lines.append(f"scale: {fit.scale:.6g}")
    if focal:
        lines.append(f"focal length: {float(fit.camera.K[0, 0]):.6g} px")
    print("\n".join(lines), flush=True)
