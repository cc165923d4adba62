"""The command line: edgegrad fit-pose, render, demo, report."""

from __future__ import annotations

import argparse
import errno
import math
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

from . import __version__
from ._files import check_readable, replacing
from .camera import Camera
from .fit import PoseFit, fit_pose
from .fit.result import Pose, pose_from_json
from .image import DISPLAY, linear_to_srgb, read_image, srgb_to_linear, write_image
from .io import load_camera, load_scene
from .render import render
from .scene import Scene

INTERRUPTED = 130  # exit code of a program that Ctrl-C ended, as shells have it


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:  # one line instead of argparse's usage
        self.exit(2, f"edgegrad: error: {message}; see {self.prog} --help\n")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs a command; the exit code is 0, 2 after an error, 130 after Ctrl-C."""
    args = _parser().parse_args(argv)
    try:
        return args.run(args)
    except KeyboardInterrupt:
        print("edgegrad: interrupted", file=sys.stderr)
        return INTERRUPTED
    except (OSError, ValueError, TypeError, ImportError, MemoryError) as error:
        print(f"edgegrad: error: {_one_line(error)}", file=sys.stderr)
        return 2


def _one_line(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}"
    return " ".join(str(error).split())


# -- commands -----------------------------------------------------------------------------------------------------------


def _fit_pose(args: argparse.Namespace) -> int:
    """Finds rotation and translation of a mesh in a picture, from a start within about 20° and 15 % of the mesh's size.
    Ctrl-C keeps the best pose so far."""
    scene = load_scene(args.mesh)
    picture, mask = _picture(args.image)
    if args.mask is not None:
        mask = _mask(args.mask)
        if mask.shape != picture.shape[:2]:
            raise ValueError(f"{args.mask}: expected {_size(picture)} pixels like {args.image}, got {_size(mask)}")
    if mask is not None and args.background is not None:
        raise ValueError("--background: expected none with a mask (or an image with alpha), got both; leave one out")
    init = None if args.init is None else _pose(args.init)
    camera = _camera(args, scene, (picture.shape[0], picture.shape[1]), args.init)
    make_folder(args.out)

    def save(fit: PoseFit) -> None:
        # After each step, which takes far longer: whatever ends the process, the best pose so far is on disk.
        with suppress(OSError):  # the last copy will say what is wrong
            _write_pose(args.out, fit)

    fit = fit_pose(
        scene, picture, camera, mask, None if init is None else init.matrix,
        fit_scale=args.fit_scale, fit_focal=args.fit_focal, background=_background(args.background, picture),
        max_size=args.size, steps=args.steps, seed=args.seed, callback=save,
    )  # fmt: skip
    # Neither a full disk nor a closed terminal may lose the result: it is printed before the files are written, and they
    # are written also when printing failed.
    try:
        _print_fit(fit, args.fit_focal)
    finally:
        written = _write_outputs(args.out, fit)
    print(f"wrote {', '.join(written)} in {args.out}")
    return INTERRUPTED if fit.interrupted else 0


def _print_fit(fit: PoseFit, focal: bool) -> None:
    state = "interrupted" if fit.interrupted else "converged" if fit.converged else "not converged: try more --steps"
    lines = [f"loss {fit.loss:.3e} after {fit.steps} steps in {fit.seconds:.1f} s, {state}", "mesh to world:"]
    lines += ["  " + "  ".join(f"{value:12.6f}" for value in row) for row in fit.matrix.tolist()]
    if focal:
        lines.append(f"focal length: {float(fit.camera.K[0, 0]):.6g} px")
    print("\n".join(lines), flush=True)


def _render(args: argparse.Namespace) -> int:
    """Renders a mesh to an image file."""
    scene = load_scene(args.mesh)
    pose = None if args.pose is None else _pose(args.pose)
    camera = _camera(args, scene, args.size, args.pose)
    if pose is not None:
        scene = scene.transformed(pose.R, pose.t, pose.scale)
    if args.background is not None:
        scene = scene.replace(background=_background(args.background, torch.empty(*camera.size, 3)))
    make_folder(args.out.absolute().parent)
    with torch.no_grad():
        write_image(args.out, render(scene, camera, spp=args.spp, seed=args.seed))
    print(f"wrote {args.out}")
    return 0


def _demo(args: argparse.Namespace) -> int:
    """Finds an airliner in pictures that are rendered at known poses, each from a start up to 20° and 15 % of its size away."""
    from . import demo  # imports pyvista when it runs

    mesh, background = demo.airliner(), demo.earth()
    make_folder(args.out)
    print("Finding an airliner in a picture, from wrong poses. Errors in degrees and in percent of its size:\n")
    print("  run     start             fit               seconds")
    runs: list[demo.Run] = []
    for k in range(args.runs):
        runs.append(run := demo.run(mesh, background, args.seed + k))
        start, end = (f"{e.degrees:6.2f}°  {e.percent:6.2f} %" for e in (run.start, run.end))
        print(f"  {k + 1:3d}  {start}  {end}  {run.fit.seconds:7.1f}", flush=True)
        if run.fit.interrupted:
            break
        if k == 0:
            _write_outputs(args.out, run.fit)
    good = sum(run.end.degrees <= demo.GOOD and run.end.percent <= demo.GOOD for run in runs)
    print(f"\n{good} of {len(runs)} within {demo.GOOD}° and {demo.GOOD} %; pictures of the first in {args.out}")
    return INTERRUPTED if runs[-1].fit.interrupted else 0


# -- files --------------------------------------------------------------------------------------------------------------


def make_folder(folder: Path) -> None:
    """Before the work rather than after it. Raises OSError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if not os.access(folder, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except OSError as error:
        raise OSError(
            f"--out: expected a folder to write to, got {folder} ({error.strerror}); choose another"
        ) from error


def _write_pose(folder: Path, fit: PoseFit) -> None:
    with replacing(folder / "pose.json") as temporary:
        temporary.write_text(fit.to_json() + "\n", encoding="utf-8")


def _write_outputs(folder: Path, fit: PoseFit) -> list[str]:
    """The names of what was written. Raises OSError that names what was not."""
    names = ["pose.json"] + ["fit.png", "loss.png", "fit.webp"] * bool(fit.history)
    for name in names:
        try:
            if name == "pose.json":
                _write_pose(folder, fit)
            else:
                from .fit import report  # matplotlib takes a while to import

                draw = {"fit.png": report.draw_fit, "loss.png": report.draw_loss, "fit.webp": report.draw_animation}
                draw[name](folder / name, fit)
        except OSError as error:
            raise OSError(
                f"{folder / name}: expected to write it, got: {error.strerror or error}; make room or rights"
            ) from error
    return names


def _picture(path: Path) -> tuple[Tensor, Tensor | None]:
    """(H, W, 3), and (H, W) from its alpha where that says anything."""
    image = read_image(path, channels=4)
    alpha = image[..., 3]
    return image[..., :3].contiguous(), alpha if bool((alpha < 1.0).any()) else None


def _mask(path: Path) -> Tensor:
    """(H, W). A mask's greys are coverage as they are, not sRGB."""
    mask = read_image(path, channels=1)[..., 0]
    return linear_to_srgb(mask) if path.suffix.lower() in DISPLAY else mask


def _size(image: Tensor) -> str:
    return f"{image.shape[1]} × {image.shape[0]}"


def _background(text: str | None, picture: Tensor) -> Tensor | None:
    """A colour (3,) from #rrggbb, or an image (H, W, 3)."""
    if text is None:
        return None
    if text.startswith("#"):
        try:
            return srgb_to_linear(torch.tensor(list(bytes.fromhex(text[1:])), dtype=torch.float32).reshape(3) / 255.0)
        except (ValueError, RuntimeError):
            raise ValueError(f"--background: expected #rrggbb or an image file, got {text!r}") from None
    image = read_image(text, channels=3)
    if image.shape != picture.shape:
        raise ValueError(f"{text}: expected {_size(picture)} pixels like the picture, got {_size(image)}; resize it")
    return image


def _pose(path: Path) -> Pose:
    try:
        return pose_from_json(check_readable(path, (".json",)).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def _camera(args: argparse.Namespace, scene: Scene, size: tuple[int, int] | None, pose_file: Path | None) -> Camera:
    """From --camera; else from the pose file, unless a view is described; else one that frames the mesh."""
    described = any(value is not None for value in (args.fov, args.eye, args.target, args.up))
    camera, source = None, args.camera
    if args.camera is not None:
        if described:
            raise ValueError(
                "--camera: expected none of --fov, --eye, --target, --up beside it, got both; leave one out"
            )
        camera = load_camera(args.camera, torch.float64)
    elif pose_file is not None and not described:
        source, text = pose_file, pose_file.read_text(encoding="utf-8")
        if '"camera"' in text:  # else a pose alone, written by hand
            camera = PoseFit.from_json(text).camera
    if camera is None:
        fov, up = 40.0 if args.fov is None else args.fov, args.up or (0.0, 1.0, 0.0)
        return framing(scene, size or (512, 512), fov, args.eye, args.target, up)
    if size is None:
        return camera
    (H, W), (h, w) = size, camera.size
    # More than a pixel apart when one is scaled to the other: not the same view.
    if abs(H * w - W * h) > max(H, W, h, w):
        raise ValueError(
            f"{source}: expected a camera for {W} × {H} pixels or in proportion, got {w} × {h}; crop alike"
        )
    return camera.resized(size)


def framing(
    scene: Scene,
    size: tuple[int, int],
    fov: float = 40.0,
    eye: Sequence[float] | None = None,
    target: Sequence[float] | None = None,
    up: Sequence[float] = (0.0, 1.0, 0.0),
) -> Camera:
    """The whole scene, seen from (0.5, 0.4, 0.77) of the middle of its box as far as nothing else is said."""
    verts = torch.cat([mesh.verts for mesh in scene.meshes]).double()
    low, high = verts.aminmax(dim=0)
    middle = (low + high) / 2 if target is None else torch.tensor(target).double()
    radius = float((verts - middle).norm(dim=1).max())
    if not 0.0 < fov < 180.0:
        raise ValueError(f"--fov: expected degrees between 0 and 180, got {fov:g}")
    narrow = math.atan(math.tan(math.radians(fov) / 2) * min(1.0, size[1] / size[0]))  # half the smaller field of view
    direction = torch.tensor([0.5, 0.4, 0.77]).double()
    distance = 1.02 * max(radius, 1e-30) / math.sin(narrow)
    place = middle + distance * direction / direction.norm() if eye is None else torch.tensor(eye).double()
    return Camera.look_at(place, middle, torch.tensor(up).double(), fov, size)


# -- arguments ----------------------------------------------------------------------------------------------------------


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="edgegrad", description="Differentiable rendering of triangle meshes on the CPU.")
    parser.add_argument("--version", action="version", version=f"edgegrad {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    fit = commands.add_parser("fit-pose", help="find a mesh in a picture", description=_fit_pose.__doc__)
    fit.add_argument("mesh", type=Path, metavar="MESH", help="OBJ, glTF, GLB, PLY, STL, OFF or 3MF")
    fit.add_argument("image", type=Path, metavar="IMAGE", help="the picture; an alpha channel is taken as the mask")
    fit.add_argument("--mask", type=Path, help="image of the picture's size, white on the object")
    _add_view(fit)
    fit.add_argument(
        "--init", type=Path, metavar="POSE.json", help="pose to start from; as in the mesh file when left out"
    )
    fit.add_argument("--fit-scale", action="store_true", help="also find the scale; the distance then stays")
    fit.add_argument("--fit-focal", action="store_true", help="also find the focal length")
    fit.add_argument("--background", help="#rrggbb or an image; without it the median colour of the picture's border")
    fit.add_argument("--size", type=count, default=256, help="most pixels on the longer side (%(default)s)")
    fit.add_argument("--steps", type=count, default=40, help="most steps on each level of resolution (%(default)s)")
    fit.add_argument("--seed", type=_number, default=0)
    fit.add_argument(
        "--out", type=Path, required=True, metavar="DIR", help="for pose.json, fit.png, loss.png, fit.webp"
    )
    fit.set_defaults(run=_fit_pose)

    draw = commands.add_parser("render", help="render a mesh", description=_render.__doc__)
    draw.add_argument("mesh", type=Path, metavar="MESH", help="OBJ, glTF, GLB, PLY, STL, OFF or 3MF")
    draw.add_argument(
        "--out", type=Path, required=True, metavar="IMAGE", help="EXR, HDR (linear), PNG, JPEG or TIFF (sRGB)"
    )
    _add_view(draw)
    draw.add_argument("--pose", type=Path, metavar="POSE.json", help="where to put the mesh, as fit-pose writes it")
    draw.add_argument("--background", help="#rrggbb or an image; black when left out")
    draw.add_argument("--size", type=_shape, metavar="WIDTHxHEIGHT", help="pixels (the camera's, or 512x512)")
    draw.add_argument("--spp", type=count, default=64, help="samples a pixel (%(default)s)")
    draw.add_argument("--seed", type=_number, default=0)
    draw.set_defaults(run=_render)

    show = commands.add_parser("demo", help="find an airliner above the Earth", description=_demo.__doc__)
    show.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="(%(default)s)")
    show.add_argument("--runs", type=count, default=10, help="targets and starts to try (%(default)s)")
    show.add_argument("--seed", type=_number, default=0)
    show.set_defaults(run=_demo)

    from .report.command import add_report  # here, since it takes types of arguments from this module

    add_report(commands)
    return parser


def _add_view(parser: argparse.ArgumentParser) -> None:
    view = parser.add_argument_group(
        "view", "a camera file, or a look at the mesh, which is framed as far as nothing is said"
    )
    view.add_argument("--camera", type=Path, metavar="CAMERA.json", help="world_to_camera 4 × 4, K 3 × 3, size [H, W]")
    view.add_argument("--fov", type=float, metavar="DEGREES", help="vertical field of view (40)")
    for name, help in (
        ("eye", "where the camera is"),
        ("target", "what it looks at"),
        ("up", "up in the image (0 1 0)"),
    ):
        view.add_argument(f"--{name}", type=float, nargs=3, metavar=("X", "Y", "Z"), help=help)


def _shape(text: str) -> tuple[int, int]:
    """(height, width) from 640x480 or 512."""
    numbers = [count(number) for number in text.lower().split("x")]
    if len(numbers) > 2:
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT or one number, got {text!r}")
    return numbers[-1], numbers[0]


def count(text: str) -> int:
    return _number(text, least=1)


def _number(text: str, least: int = 0) -> int:
    if not text.isdecimal() or int(text) < least:
        raise argparse.ArgumentTypeError(f"expected a whole number from {least} up, got {text!r}")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
