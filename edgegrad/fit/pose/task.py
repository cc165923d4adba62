"""The task of a pose search: pictures on each level of an image pyramid, and how a step moves the pose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_shape
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..by_camera import numbered
from ..options import MIN_PICTURE_SIDE
from ..placement import Pose
from ..region import VISIBLE
from ..views import check_without_alpha, has_levels, views_of, white_level
from .inputs import ArgumentNames, without_colors

BACKGROUND_BRIGHTNESS = 0.25  # brightness of the picture behind a render, where the background is unknown
# A border is clutter when more than 0.3 of it is further from its median than 0.1 of the range.
UNIFORM_BORDER = (0.1, 0.3)

# A step has these entries, and a constant for the first of each: a rotation vector about the centre and a shift, both along
# the first camera's axes, logarithms of scale and focal length, the principal point in widths of the image, and distortion.
ROTATION, TRANSLATION, SCALE, FOCAL_LENGTH, PRINCIPAL, DISTORTION = 0, 3, 6, 7, 8, 10
STEP_SIZE = 18
STEP_PARTS = {
    "rotation": range(ROTATION, TRANSLATION), "shift": range(TRANSLATION, SCALE), "scale": range(SCALE, FOCAL_LENGTH),
    "focal": range(FOCAL_LENGTH, PRINCIPAL), "principal": range(PRINCIPAL, DISTORTION),
    "distortion": range(DISTORTION, STEP_SIZE),
}  # fmt: skip


class Unknowns(NamedTuple):
    """Numbers that are sought in addition to the pose."""

    scale: bool = False
    focal: bool = False
    principal: bool = False
    distortion: int = 0  # number of coefficients


class TargetView(NamedTuple):
    """One picture at one resolution."""

    camera: Camera
    target: Tensor  # (h, w, C), blurred
    background: Tensor | None  # (C,) or (h, w, C), not blurred: that comes after the render
    weight: Tensor | None  # (h, w, 1)


@dataclass(frozen=True)
class PoseTask:
    """Pictures that are compared with renders, and how a pose moves. Geometry is float64."""

    scene: Scene
    aovs: tuple[str, ...]  # what is compared, in order: "image", "alpha" or both
    shots: list[TargetView]  # whole pictures
    clutter: bool  # The background is unknown: where the object is not seen, nothing is compared.
    colorless: bool  # The meshes have no colours, and no mask shows them: pictures show them grey.
    center: Tensor  # (3,) of the bounding box, in the mesh's units
    size: float  # diagonal of the bounding box at the start, world units
    dofs: list[int]  # sought entries of a step
    names: ArgumentNames
    white: float = 1.0  # radiance in the given pictures of what is 1 here

    @staticmethod
    def from_arguments(
        mesh: Mesh | Scene, images: Any, cameras: Any, masks: Any, weights: Any, lens: Unknowns, scale: float,
        names: ArgumentNames,
    ) -> PoseTask:  # fmt: skip
        """Check a fit's arguments; `scale` is the mesh's at the start. Raises TypeError or ValueError."""
        if not isinstance(mesh, Mesh | Scene):
            raise TypeError(
                f"{names.mesh}: expected a Mesh or a Scene, got {type(mesh).__name__}; load one with load_mesh(path)"
            )
        # Autograd does not keep tensors that were made in torch.inference_mode(), so they are copied.
        scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu", copy=True)
        scene = without_colors(scene) if images is None else scene
        plain = all(part.channels is None for part in scene.meshes)
        masked = masks is not None
        views = views_of(cameras, images, masks, weights, names=(names.images, names.masks))
        levels, pixels = True, list[Tensor]()
        for k, view in enumerate(views):
            name = numbered(names.masks if images is None else names.images, k, len(views))
            for missing, given, each in ((view.image, images, names.images), (view.mask, masks, names.masks)):
                if (missing is None) != (given is None):
                    raise ValueError(
                        f"{numbered(each, k, len(views))}: expected one for all cameras or for none, got None for this one"
                    )
            if min(view.camera.size) < MIN_PICTURE_SIDE:
                raise ValueError(
                    f"{name}: expected a picture of {MIN_PICTURE_SIDE} × {MIN_PICTURE_SIDE} pixels or more, got "
                    f"{view.camera.size[1]} × {view.camera.size[0]}; take a larger one"
                )
            if (image := view.image) is None:
                continue
            levels = levels and has_levels(image if view.sure is None else image[view.sure[..., 0] > 0.0])
            pixels.append(image.flatten(0, 1) if view.mask is None else image[view.mask[..., 0] > 0.0])
            if plain and not masked:
                check_without_alpha(name, image)
            if not plain and image.shape[-1] != (C := scene.channels):
                raise ValueError(
                    f"{name}: expected {C} channels like the mesh's colours, got {image.shape[-1]}; "
                    f"read it with read_image(path, channels={C}), or give its alpha as the mask"
                )
        # Radiance may have any unit.
        white = 1.0 if levels or (plain and masked) else white_level(torch.cat(pixels))
        most = max((float(view.weight.max()) for view in views if view.weight is not None), default=1.0)
        shots, clutter = [], False
        for view in views:
            image, target, behind = None if view.image is None else view.image / white, view.mask, None
            if target is None:
                assert image is not None and view.image is not None
                target, behind = image, background_of(scene.background, view.image) / white
                # Unknown colours cannot be compared.
                clutter = clutter or plain or (scene.background is None and is_clutter(image))
            elif image is not None and not plain:
                target = torch.cat([image, target], -1)
            weight = None if view.weight is None else view.weight / most
            shots.append(TargetView(view.camera.to(torch.float64), target, behind, weight))
        if clutter:
            shots = [shot._replace(background=None) for shot in shots]
        if colorless := plain and not masked:
            grey = torch.full((1, shots[0].target.shape[-1]), 0.5, dtype=torch.float32)
            meshes = [part.replace(colors=grey.repeat(len(part.verts), 1)) for part in scene.meshes]
            scene = scene.replace(meshes=meshes)
        aovs = ("image", "alpha") if clutter or (masked and not plain) else ("image",)
        aovs = ("alpha",) if masked and plain else aovs

        double = [part.replace(verts=part.verts.detach().double()) for part in scene.meshes]
        low, high = torch.cat([part.verts for part in double]).aminmax(dim=0)
        size = float((high - low).norm() * scale)
        if size == 0.0:
            raise ValueError(
                f"{names.mesh}: expected vertices apart from one another, got all in one place; check the file's units"
            )
        # One picture shows the ratio of size and distance only, and a parallel projection no distance at all.
        orthographic = all(shot.camera.projection == "orthographic" for shot in shots)
        depth = len(shots) > 1 or (not orthographic and not lens.scale)
        if lens.scale and lens.focal and orthographic:
            raise ValueError("focal: expected False with scale and an orthographic camera, where both are one")
        dofs = [0, 1, 2, 3, 4] + [5] * depth + [SCALE] * lens.scale + [FOCAL_LENGTH] * lens.focal
        dofs += [PRINCIPAL, PRINCIPAL + 1] * lens.principal + list(range(DISTORTION, DISTORTION + lens.distortion))
        # Pixels brighter than white, as of a light source or a defect, say nothing of the range of the others.
        seen = torch.cat([shot.target.flatten(0, 1) for shot in shots]).clamp(max=1.0)
        if bool((seen.amax(0) == seen.amin(0)).all()):
            given = names.masks if masked else names.images
            raise ValueError(
                f"{given}: expected a picture of the object, got the same in every pixel; "
                "was it read or rendered right?"
            )
        if masked and (most := max(int((shot.target[..., -1] > 0.0).sum()) for shot in shots)) < VISIBLE:
            raise ValueError(
                f"{names.masks}: expected the object in {VISIBLE} pixels or more, got it in {most}; is it the object's mask?"
            )
        bare = scene.replace(meshes=double, background=None)
        return PoseTask(bare, aovs, shots, clutter, colorless, (low + high) / 2, size, dofs, names, white)

    def between(self, one: Pose, other: Pose) -> float:
        """Return the distance of the object's centres at two poses, relative to its size."""
        return float((self.center_at(one) - self.center_at(other)).norm()) / self.size

    def center_at(self, pose: Pose) -> Tensor:
        return pose.scale * (pose.R @ self.center) + pose.t

    def lens(self, camera: Camera, pose: Pose) -> Camera:
        """Return the camera with what was found of its lens."""
        if FOCAL_LENGTH not in self.dofs and PRINCIPAL not in self.dofs and DISTORTION not in self.dofs:
            return camera
        K = zoomed(camera.K, pose.focal.to(camera.K))
        if PRINCIPAL in self.dofs:
            across = torch.zeros_like(K)
            across[0, 2] = across[1, 2] = camera.size[1]
            K = K + across * torch.cat([pose.principal, pose.principal.new_zeros(1)]).to(K)[:, None]
        fields: dict[str, Any] = {"K": K}
        if DISTORTION in self.dofs:
            change = pose.distortion[: self.dofs[-1] + 1 - DISTORTION].to(K)
            given = camera.distortion
            if given is not None and len(given) > len(change):
                change = torch.cat([change, change.new_zeros(len(given) - len(change))])
            fields["distortion"] = change if given is None else change + F.pad(given, (0, len(change) - len(given)))
        return camera.replace(**fields)


def is_clutter(picture: Tensor) -> bool:
    """Return whether the border of a picture (H, W, C) has many colours, so that none of them is the background."""
    border = _border(picture)
    extent = (picture.amax((0, 1)) - picture.amin((0, 1))).clamp(min=1e-30)
    off = ((border - border.median(dim=0).values).abs() / extent).amax(1)
    return float((off > UNIFORM_BORDER[0]).float().mean()) > UNIFORM_BORDER[1]


def _border(picture: Tensor) -> Tensor:
    return torch.cat([picture[0], picture[-1], picture[1:-1, 0], picture[1:-1, -1]])


def background_of(behind: Tensor | None, picture: Tensor) -> Tensor:
    """Return a scene's background (C,) or (H, W, C), or else the median colour of the picture's border. Raises ValueError."""
    if behind is None:
        return _border(picture).median(dim=0).values
    shapes = picture.shape[-1:], picture.shape
    check_shape("background", behind, *shapes, fix="it needs the picture's size and channels")
    return behind.detach().float()


def scaled(size: tuple[int, int], factor: float) -> tuple[int, int]:
    """Return the size of a picture whose sides are multiplied by a factor, at least one pixel."""
    return max(1, round(size[0] * factor)), max(1, round(size[1] * factor))


def focal_of(camera: Camera) -> float:
    """Return the focal length in pixels, the geometric mean of both axes."""
    return float(torch.linalg.det(camera.K[:2, :2].double()).abs().sqrt())


def zoomed(K: Tensor, factor: Tensor) -> Tensor:
    """Return K with its focal lengths multiplied; the principal point stays."""
    lens = torch.zeros_like(K)
    lens[:2, :2] = K[:2, :2].detach()
    return K + (factor - 1.0) * lens
