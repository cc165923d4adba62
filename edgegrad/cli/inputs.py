"""Read pictures, masks, backgrounds, poses and views for commands."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .arguments import CHECKPOINT

FOV = 40.0  # degrees, the default vertical field of view

if TYPE_CHECKING:
    from torch import Tensor

    from .. import Camera, Mesh, Scene
    from ..fit import FitOptions
    from ..fit.placement import Pose


def read_scene(args: argparse.Namespace) -> Scene:
    """Return the mesh file, with --texture and --no-materials. Raises what load_scene raises, in words of the command line."""
    from .. import Scene, load_scene

    if args.texture is not None:
        return Scene([read_mesh(args)])
    with _in_words_of_the_shell():
        return load_scene(args.mesh, materials=not args.no_materials)


def read_mesh(args: argparse.Namespace) -> Mesh:
    """Return the mesh file as one mesh, as read_scene reads it."""
    from .. import load_mesh

    with _in_words_of_the_shell():
        return load_mesh(args.mesh, args.texture, materials=not args.no_materials)


@contextmanager
def _in_words_of_the_shell() -> Iterator[None]:
    try:
        yield
    except (ValueError, FileNotFoundError) as error:
        text = str(error)
        for ours, theirs in (("pass materials=False", "pass --no-materials"), ("with label=", "with --label")):
            text = text.replace(ours, theirs)
        raise type(error)(text) from error


def read_picture(path: Path) -> tuple[Tensor, Tensor | None]:
    """Return (H, W, 3), and (H, W) from its alpha if any is below 1."""
    from .. import read_image

    image = read_image(path, channels=4)
    alpha = image[..., 3]
    return image[..., :3].contiguous(), alpha if bool((alpha < 1.0).any()) else None


def seen_by(camera: Path | None, image: Path) -> Path:
    """Return the image as the camera file refers to it: upright, as commands read pictures whose cameras they write; or as
    stored, if only that is in proportion to the camera. A note says which if the EXIF orientation leaves it open."""
    from .. import load_camera
    from ..files.formats.views import resized
    from ..files.image import read_orientation, read_size
    from ..files.paths import StoredPath

    if camera is None or camera.suffix.lower() != ".json" or (orientation := read_orientation(image)) == 1:
        return image
    known, stored = load_camera(camera), StoredPath(image)
    upright, sideways = (resized(known, read_size(path)) is not None for path in (image, stored))
    if upright and sideways:
        print(
            f"edgegrad: {image}: read upright, as its EXIF orientation {orientation} says; if {camera} speaks of the pixels as "
            "they are stored, as COLMAP's cameras do, remove the orientation from a copy of the image",
            file=sys.stderr,
        )
    return stored if sideways and not upright else image


def read_coverage(path: Path, label: int | None = None) -> Tensor:
    """Return (H, W) as edgegrad.read_mask reads it. Raises what that raises, in words of the command line."""
    from .. import read_mask

    with _in_words_of_the_shell():
        return read_mask(path, label)


def read_labels(path: Path, count: int) -> list[Tensor]:
    """Return (H, W) for each of so many meshes, where an image of labels has its number, from 1. Raises what read_mask
    raises."""
    from .. import read_mask

    found = []
    for number in range(1, count + 1):
        try:
            found.append(read_mask(path, number))
        except ValueError as error:
            fix = "number the meshes in the order of --mesh, from 1, and leave out those that are not seen"
            raise ValueError(str(error).replace("choose one with label=", fix).replace(" for label=", "")) from error
    return found


def read_weight(path: Path) -> Tensor:
    """Return (H, W), how much a pixel counts. Raises what edgegrad.read_mask raises."""
    from ..files.mask import read_weight

    return read_weight(path)


def read_depth(args: argparse.Namespace, picture: Tensor) -> Tensor | None:
    """Return (H, W) from --depth and --depth-scale, for a picture (H, W, 3). Raises what edgegrad.read_depth raises, in words
    of the command line."""
    from .. import read_depth

    if args.depth is None:
        if args.depth_scale is not None:
            raise ValueError("--depth-scale: expected --depth with it, an image of distances, got none; name it")
        return None
    try:
        depth = read_depth(args.depth, args.depth_scale)
    except ValueError as error:
        raise ValueError(f"--depth-{error}" if str(error).startswith("scale:") else str(error)) from error
    check_size(depth, picture, args.depth, args.image)
    if not bool((depth > 0.0).any()):
        raise ValueError(
            f"{args.depth}: expected distances somewhere, got 0 in all pixels, which says that there is none"
        )
    return depth


def check_size(image: Tensor, picture: Tensor, path: Path, like: Path) -> None:
    """Check that an image has the picture's size. Raises ValueError."""
    if image.shape[:2] != picture.shape[:2]:
        raise ValueError(f"{path}: expected {_size(picture)} pixels like {like}, got {_size(image)}")


def _size(image: Tensor) -> str:
    return f"{image.shape[1]} × {image.shape[0]}"


def read_background(text: str | None, picture: Tensor) -> Tensor | None:
    """Return a colour (3,) from #rrggbb, or an image (H, W, 3)."""
    import torch

    from ..files.image import read_image, srgb_to_linear

    if text is None:
        return None
    if text.startswith("#") or not Path(text).suffix:
        try:
            return srgb_to_linear(
                torch.tensor(list(bytes.fromhex(text.removeprefix("#"))), dtype=torch.float32).reshape(3) / 255.0
            )
        except (ValueError, RuntimeError):
            raise ValueError(f"--background: expected #rrggbb or an image file, got {text!r}") from None
    image = read_image(text, channels=3)
    if image.shape != picture.shape:
        raise ValueError(f"{text}: expected {_size(picture)} pixels like the picture, got {_size(image)}; resize it")
    return image


def check_not_black(mask: Tensor, path: Path) -> None:
    """Check that a mask is not black. Raises ValueError."""
    if not bool((mask > 0.0).any()):
        raise ValueError(
            f"{path}: expected a mask, white on the object, got one that is black; is it the object's mask?"
        )


def read_pose(path: Path) -> Pose:
    """Read what fit-pose or track writes, or mesh to world 4 × 4 by rows as JSON, text or .npy. Raises ValueError or
    OSError."""
    import numpy as np

    from ..files.paths import check_readable
    from ..fit.placement import pose_from_matrix
    from ..fit.pose.result import pose_from_json

    try:
        file = check_readable(path, (".json", ".txt", ".npy"))
        if file.suffix.lower() == ".npy":
            return pose_from_matrix("mesh_to_world", np.load(file, allow_pickle=False))
        text = file.read_text(encoding="utf-8")
        if file.suffix.lower() == ".txt":
            return pose_from_matrix("mesh_to_world", np.loadtxt(text.replace(",", " ").splitlines(), ndmin=2))
        return pose_from_json(text)
    except ValueError as error:
        raise ValueError(str(error) if str(path) in str(error) else f"{path}: {error}") from error


def read_view(args: argparse.Namespace, scene: Scene, size: tuple[int, int] | None, pose_file: Path | None) -> Camera:
    """Return the camera of --camera; or that of the pose file, unless a view is described; or one that frames the mesh."""
    import torch

    from .. import load_camera
    from ..fit.pose.result import PoseFit
    from ..preview import framing

    described = any(value is not None for value in (args.fov, args.eye, args.target, args.up))
    camera, source = None, args.camera
    if args.camera is not None:
        if described:
            raise ValueError("--camera: expected none of --fov, --eye, --target, --up with it, got both; leave one out")
        by_size = args.camera.suffix.lower() in (".gltf", ".glb")  # which have none of their own
        camera = load_camera(args.camera, torch.float64, (size or (512, 512)) if by_size else None)
    elif pose_file is not None and not described:
        source = pose_file
        if _has_camera(pose_file):  # else a pose alone, written by hand
            camera = PoseFit.from_json(pose_file.read_text(encoding="utf-8")).camera
    if camera is None:
        fov, up = FOV if args.fov is None else args.fov, args.up or (0.0, 1.0, 0.0)
        return framing(scene, size or (512, 512), fov, args.eye, args.target, up)
    if size is None:
        return camera
    return fitting(camera, size, source)


def read_photo_view(
    args: argparse.Namespace, scene: Scene, photo: Path, picture: Tensor, pose_file: Path | None
) -> tuple[Camera, str]:
    """Return the camera of a photograph (H, W, 3), and in words what is assumed of it."""
    size = picture.shape[0], picture.shape[1]
    assumed = assume_fov(args, photo, size, pose_file)
    return read_view(args, scene, size, pose_file), assumed


def assume_fov(args: argparse.Namespace, photo: Path, size: tuple[int, int], pose_file: Path | None) -> str:
    """Set --fov from the photograph's EXIF data, or else to 40°, if neither --camera nor --fov nor the pose file has a focal
    length. Return in words what is assumed; empty if nothing is."""
    import math

    from ..files.focal import read_focal

    placed = any(value is not None for value in (args.eye, args.target, args.up))
    if (
        args.camera is not None
        or args.fov is not None
        or (pose_file is not None and not placed and _has_camera(pose_file))
    ):
        return ""
    focal = read_focal(photo) if photo.is_file() else None
    if focal is None:
        args.fov = FOV
        said = f"{FOV:g}° assumed, for {photo} does not say its focal length; distances follow from it"
    else:
        args.fov = 2.0 * math.degrees(math.atan(0.5 * size[0] / focal.pixels))
        said = f"{args.fov:.1f}° taken from the EXIF data of {photo} ({focal.words}), as if it were not cropped"
    return f"edgegrad: --fov: {said}; give --camera or --fov where it is known"


def _has_camera(pose_file: Path) -> bool:
    return pose_file.suffix.lower() == ".json" and '"camera"' in pose_file.read_text(encoding="utf-8")


def fitting(camera: Camera, size: tuple[int, int], source: Path) -> Camera:
    """Return the camera for a picture of that size. Raises ValueError that names its file, unless they are in proportion."""
    from ..files.formats.views import resized

    found = resized(camera, size)
    if found is None:
        (H, W), (h, w) = size, camera.size
        raise ValueError(
            f"{source}: expected a camera for {W} × {H} pixels or in proportion, got {w} × {h}; crop it likewise"
        )
    return found


def read_views(args: argparse.Namespace) -> tuple[list[Camera], list[Tensor], list[Tensor | None]]:
    """Return cameras of the images' sizes, images (H, W, 3), and alphas (H, W). Raises ValueError."""
    from .. import load_camera

    if len(args.camera) != len(args.images):
        raise ValueError(f"--camera: expected {len(args.images)}, one for each image, got {len(args.camera)}")
    args.images = [seen_by(path, image) for path, image in zip(args.camera, args.images, strict=True)]
    cameras, pictures, alphas = [], [], []
    for path, image in zip(args.camera, args.images, strict=True):
        picture, alpha = read_picture(image)
        cameras.append(fitting(load_camera(path), (picture.shape[0], picture.shape[1]), path))
        pictures.append(picture)
        alphas.append(alpha)
    return cameras, pictures, alphas


def read_options(args: argparse.Namespace, callback: Callable[[Any], Any] | None = None, **more: Any) -> FitOptions:
    """Return the options of a fit whose steps, seed and checkpoint the arguments say. Without a checkpoint, --resume begins
    anew and says so."""
    from ..fit import Checkpoint, FitOptions

    path = args.out / CHECKPOINT
    resume = args.resume and path.exists()
    if args.resume and not resume:
        print(f"edgegrad: --resume: there is no {path}; the fit begins anew", file=sys.stderr)
    checkpoint = Checkpoint(path, resume=resume)
    return FitOptions(steps=args.steps, seed=args.seed, callback=callback, checkpoint=checkpoint, **more)
