"""Arguments that several commands have in common, and errors of one line."""

from __future__ import annotations

import argparse
import difflib
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

CHECKPOINT = "checkpoint.pt"  # file of fits


class Parser(argparse.ArgumentParser):
    """A parser that suggests the nearest name for an unknown one."""

    def __init__(self, **options: object) -> None:
        super().__init__(**options)  # type: ignore[arg-type]
        self.set_defaults(parser=self)  # the command's own default comes last and wins

    def parse(self, argv: Sequence[str] | None) -> argparse.Namespace:
        args, unknown = self.parse_known_args(argv)
        if unknown:
            parser: Parser = args.parser
            parser.error(f"unrecognized arguments: {' '.join(unknown)}{_nearest(unknown[0], parser.options)}")
        return args

    @property
    def options(self) -> list[str]:
        return [name for action in self._actions for name in action.option_strings]

    def error(self, message: str) -> NoReturn:  # one line instead of argparse's usage
        if wrong := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            message += _nearest(wrong[1], re.findall(r"[\w-]+", wrong[2]))
        self.exit(2, f"edgegrad: error: {message}; see {self.prog} --help\n")


def _nearest(word: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(word.split("=")[0], list(known), n=1)
    return f"; did you mean {close[0]}?" if close else ""


def add_mesh(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("mesh", type=Path, metavar="MESH", help="OBJ, glTF, GLB, PLY, STL, OFF or 3MF")
    parser.add_argument(
        "--texture", type=Path, metavar="IMAGE", help="to lay on its texture coordinates instead of its materials"
    )
    parser.add_argument("--no-materials", action="store_true", help="leave out its textures and materials")


def add_view(parser: argparse.ArgumentParser) -> None:
    view = parser.add_argument_group(
        "view", "a camera file, or a view of the mesh, which is framed as far as nothing is given"
    )
    view.add_argument(
        "--camera", type=Path, metavar="CAMERA.json", help="world_to_camera 4 × 4, K 3 × 3, size [H, W]; or glTF"
    )
    view.add_argument("--fov", type=float, metavar="DEGREES", help="vertical field of view (40)")
    points = {
        "eye": "where the camera is",
        "target": "the point in the middle of its view",
        "up": "up in the image (0 1 0)",
    }
    for name, help in points.items():
        view.add_argument(f"--{name}", type=float, nargs=3, metavar=("X", "Y", "Z"), help=help)


def add_views(parser: argparse.ArgumentParser, images: str) -> None:
    """Add several images, and the camera of each."""
    parser.add_argument("images", type=Path, nargs="+", metavar="IMAGE", help=images)
    parser.add_argument(
        "--camera", type=Path, nargs="+", required=True, metavar="CAMERA.json", help="one for each image, in their order"
    )  # fmt: skip


def add_label(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--label", type=number, metavar="N", help="the object's number in a mask of several labels")


def add_depth(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of inputs.read_depth."""
    parser.add_argument(
        "--depth", type=Path, metavar="IMAGE",
        help="distances along the camera's axis, as the picture's camera sees them; 0 where there is none",
    )  # fmt: skip
    parser.add_argument(
        "--depth-scale", type=float, metavar="LENGTH",
        help="of one unit of it, in those of the mesh: 0.001 for millimetres and metres; floating point needs none",
    )  # fmt: skip


def add_descent(parser: argparse.ArgumentParser, result: str) -> None:
    """Add the arguments of fits by descent, for inputs.read_options."""
    parser.add_argument("--steps", type=count, default=150, help="most steps; of fit-shape on each level (%(default)s)")
    parser.add_argument("--spp", type=count, default=4, help="samples a pixel (%(default)s)")
    parser.add_argument("--seed", type=number, default=0)
    add_resume(parser)
    add_out(parser, f"{result}, values.pt, fit.json, history.json, fit.png, loss.png, cameras, {CHECKPOINT}")


def add_out(parser: argparse.ArgumentParser, files: str) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help=f"for {files}")


def add_size(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--size", type=longer_side, default=256, help="most pixels on the longer side (%(default)s)")


def add_steps(parser: argparse.ArgumentParser, default: int = 40) -> None:
    parser.add_argument(
        "--steps", type=count, default=default, help="most steps on each level of resolution (%(default)s)"
    )


def add_background(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--background", help="#rrggbb or an image; without it the median colour of the picture's border"
    )


def add_resume(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--resume", action="store_true", help=f"go on from DIR/{CHECKPOINT}, if it is there")


def add_live(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of outputs.live_view."""
    parser.add_argument(
        "--view", action="store_true",
        help="watch, pause and stop the fit in a browser; the page stays after the result is saved, until Ctrl-C or its Close",
    )  # fmt: skip
    parser.add_argument("--port", type=port, default=8080, help="of the page (%(default)s), or the next free one")


def port(text: str) -> int:
    if (found := number(text)) > 65535:
        raise argparse.ArgumentTypeError(f"expected a port from 0 to 65535, got {text!r}")
    return found


def shape(text: str) -> tuple[int, int]:
    """Return (height, width) from 640x480 or 512."""
    numbers = [count(number) for number in text.lower().split("x")]
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT or one number, got {text!r}")
    return numbers[-1], numbers[0]


def count(text: str) -> int:
    return number(text, least=1)


def longer_side(text: str) -> int:
    """Return the pixels on the longer side of a picture, which determine the other side."""
    if "x" in text.lower():
        raise argparse.ArgumentTypeError(
            f"expected one number, pixels on the longer side, from which the other follows, got {text!r}"
        )
    return number(text, least=8)


def number(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number from {least} up, got {text!r}")
    return int(text)


def millimetres(text: str) -> float:
    try:
        found = float(text)
    except ValueError:
        found = -1.0
    if not 0.0 <= found < float("inf"):
        raise argparse.ArgumentTypeError(f"expected millimetres from 0 up, got {text!r}")
    return found
