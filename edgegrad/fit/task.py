"""What fit_pose compares, on each level of an image pyramid, and how a step moves the pose."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from .._check import as_tensor, check_finite, check_float, check_shape
from ..aovs import render_aovs
from ..camera import Camera
from ..mesh import Mesh
from ..scene import Scene
from .result import Pose

COARSEST = 24  # pixels across the object where the fit begins: 15 % of its size is then a few pixels
SMALLEST = 12  # pixels on the shorter side of the coarsest level
BLURS = (1.5, 1.0)  # standard deviation in pixels on the coarsest levels; none on the finer ones
MOST_SPP = 256  # samples a pixel on coarse levels

# A step has 8 entries: a rotation vector about the centre and a shift, both along the camera's axes, and logarithms of
# scale and focal length. The first of each:
TURN, SHIFT, GROW, ZOOM = 0, 3, 6, 7


class Level(NamedTuple):
    """The task at one resolution."""

    camera: Camera
    target: Tensor  # (h, w, C), blurred
    background: Tensor | None  # (C,) or (h, w, C), not blurred: that comes after the render
    blur: float  # pixels
    coarseness: float  # size of a pixel, relative to the finest level's
    spp: int
    free: list[int]  # entries of a step that are sought


@dataclass(frozen=True)
class PoseTask:
    """What is compared, and how a pose moves. Geometry is float64."""

    scene: Scene
    aovs: tuple[str, ...]  # what is compared, one after the other: "image", "alpha" or both
    target: Tensor  # (H, W, C) the same of the picture
    background: Tensor | None  # (C,) or (H, W, C) of the picture; None with a mask
    camera: Camera
    center: Tensor  # (3,) of the bounding box, in the mesh's units
    size: float  # its diagonal at the start, world units
    free: list[int]  # entries of a step that are sought

    @staticmethod
    def of(
        mesh: Mesh | Scene, target: Tensor, camera: Camera, mask: Tensor | None, background: Tensor | float | None,
        start: Pose, fit_scale: bool, fit_focal: bool,
    ) -> PoseTask:  # fmt: skip
        """Raises TypeError or ValueError."""
        if not isinstance(mesh, Mesh | Scene):
            raise TypeError(
                f"mesh: expected a Mesh or a Scene, got {type(mesh).__name__}; load one with load_mesh(path)"
            )
        if not isinstance(camera, Camera):
            raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}; make one with Camera.look_at(…)")
        if camera.batch is not None:
            raise ValueError(f"camera: expected one camera, got {camera.batch}; fit one picture at a time")
        # Copies, for autograd does not keep tensors that were made in torch.inference_mode().
        scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu", copy=True)
        picture = _image("target", target, camera.size)
        plain = all(part.channels is None for part in scene.meshes)
        C = picture.shape[-1] if plain else scene.channels
        if picture.shape[-1] != C:
            raise ValueError(
                f"target: expected {C} channels like the mesh's colours, got {picture.shape[-1]}; "
                "read it with read_image(path, channels=3), or give its alpha as the mask"
            )
        if mask is not None:
            if background is not None:
                raise ValueError("background: expected None with a mask, got both; the mask leaves no background")
            shape = _image("mask", mask, camera.size)
            check_shape("mask", shape, (*camera.size, 1))
            aovs = ("alpha",) if plain else ("image", "alpha")
            picture = shape if plain else torch.cat([picture * shape, shape], -1)
            behind = None
        else:
            aovs = ("image",)
            behind = _background(background if background is not None else scene.background, picture)

        double = [part.replace(verts=part.verts.detach().double()) for part in scene.meshes]
        low, high = torch.cat([part.verts for part in double]).aminmax(dim=0)
        size = float((high - low).norm() * start.scale)
        if size == 0.0:
            raise ValueError(
                "mesh: expected vertices apart from one another, got all in one place; check the file's units"
            )
        # One picture tells size from distance only together, and a parallel projection shows no distance at all.
        depth = camera.projection != "orthographic" and not fit_scale
        if fit_scale and fit_focal and camera.projection == "orthographic":
            raise ValueError("fit_focal: expected False with fit_scale and an orthographic camera, where both are one")
        free = [0, 1, 2, 3, 4] + [5] * depth + [GROW] * fit_scale + [ZOOM] * fit_focal
        return PoseTask(
            scene.replace(meshes=double, background=None),
            aovs,
            picture,
            behind,
            camera.to("cpu", torch.float64, copy=True),
            (low + high) / 2,
            size,
            free,
        )

    def pyramid(self, start: Pose, max_size: int, spp: int) -> list[Level]:
        """From coarse to fine. Raises ValueError when the object is behind the camera."""
        H, W = self.camera.size
        finest = min(1.0, max_size / max(H, W))
        view = self.camera.world_to_camera
        depth = float((view[:3, :3] @ (start.matrix[:3, :3] @ self.center + start.t) + view[:3, 3])[2])
        perspective = self.camera.projection != "orthographic"
        if perspective and depth <= 0:
            raise ValueError(f"init: expected the object in front of the camera, got its centre at depth {depth:.3g}")
        focal = float(torch.linalg.det(self.camera.K[:2, :2]).abs().sqrt())
        across = finest * focal * self.size / (depth if perspective else 1.0)  # pixels
        halvings = round(math.log2(max(1.0, min(across / COARSEST, finest * min(H, W) / SMALLEST))))
        factors = [finest / 2**n for n in range(halvings, -1, -1)]
        factors += [finest] * (len(BLURS) + 1 - len(factors))
        blurs = [*BLURS, *[0.0] * (len(factors) - len(BLURS))]
        # Perspective shows in fine detail only: on a blurred level the focal length would run away.
        blind = [entry for entry in self.free if entry != ZOOM]
        levels = []
        for factor, blur in zip(factors, blurs, strict=True):
            coarseness = finest / factor
            samples = max(spp, min(MOST_SPP, round(spp * coarseness**2)))
            levels.append(self.level(factor, blur, coarseness, samples, blind if blur else self.free))
        return levels

    def level(self, factor: float, blur: float, coarseness: float, spp: int, free: list[int]) -> Level:
        """The task with the picture's sides multiplied by `factor`."""
        H, W = self.camera.size
        size = max(1, round(H * factor)), max(1, round(W * factor))
        target = _blurred(_resized(self.target, size), blur)
        behind = self.background
        if behind is not None and behind.dim() == 3:
            behind = _resized(behind, size)
        return Level(self.camera.resized(size), target, behind, blur, coarseness, spp, free)

    def moved(self, pose: Pose, free: list[int], p: Tensor) -> Pose:
        """The pose after a step whose entries `free` are p, the others zero; differentiable in p."""
        step = p.new_zeros(8).index_put((torch.tensor(free),), p)
        view = self.camera.world_to_camera
        R = torch.linalg.matrix_exp(_skew(view[:3, :3].T @ step[TURN:SHIFT])) @ pose.R
        center = (
            view[:3, :3] @ (pose.scale * (pose.R @ self.center) + pose.t) + view[:3, 3] + self.size * step[SHIFT:GROW]
        )
        scale, zoom = pose.scale * step[GROW].exp(), step[ZOOM].exp()
        if ZOOM in free and self.camera.projection != "orthographic":
            # A longer lens enlarges the object. Undone by distance, or by scale where that is sought, what is left of
            # the zoom is the change of perspective, and the entries of the step hardly disturb one another.
            if GROW in free:
                scale = scale / zoom
            else:
                center = torch.cat([center[:2], center[2:] * zoom])
        t = view[:3, :3].T @ (center - view[:3, 3]) - scale * (R @ self.center)
        return Pose(R, t, scale, pose.focal * zoom)

    def image(self, level: Level, pose: Pose, spp: int, seed: int) -> Tensor:
        """The render (h, w, C), blurred like the picture, differentiable in the pose."""
        scene = self.scene.transformed(pose.R, pose.t, pose.scale).replace(background=level.background)
        camera = level.camera
        if ZOOM in self.free:
            camera = camera.replace(K=zoomed(camera.K, pose.focal))
        channels = render_aovs(scene, camera, self.aovs, spp=spp, seed=seed)
        return _blurred(torch.cat([channels[name] for name in self.aovs], -1), level.blur)


def _image(name: str, value: Tensor, size: tuple[int, int]) -> Tensor:
    """(H, W, C) float32 on the CPU. Raises TypeError or ValueError."""
    image = as_tensor(name, value).detach().cpu()
    image = image[..., None] if image.dim() == 2 else image
    image = image.float() if image.dtype == torch.bool else image
    check_float(name, image)
    check_shape(name, image, (*size, "C"), fix="the camera must have the picture's size: camera.resized((H, W))")
    check_finite(name, image)
    return image.float()


def _background(value: Tensor | float | None, picture: Tensor) -> Tensor:
    """(C,) or (H, W, C). Raises TypeError or ValueError."""
    H, W, C = picture.shape
    if value is None:
        border = [picture[0], picture[-1], picture[1:-1, 0], picture[1:-1, -1]]
        return torch.cat(border).median(dim=0).values
    behind = as_tensor("background", value, like=picture).detach().cpu()
    if behind.dim() == 0:
        behind = behind.expand(C)
    check_float("background", behind)
    check_shape("background", behind, (C,), (H, W, C), fix="it needs the picture's size and channels")
    check_finite("background", behind)
    return behind.float()


def zoomed(K: Tensor, factor: Tensor) -> Tensor:
    """K with its focal lengths multiplied; the principal point stays."""
    lens = torch.zeros_like(K)
    lens[:2, :2] = K[:2, :2].detach()
    return K + (factor - 1.0) * lens


def _skew(w: Tensor) -> Tensor:
    """The matrix of w × · , whose exponential is the rotation by |w| radians about w."""
    zero = torch.zeros_like(w[0])
    return torch.stack([zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero]).reshape(3, 3)


def _resized(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Means over the new pixels' areas, which is what a render of that size with the box filter estimates."""
    return F.interpolate(image.movedim(-1, 0)[None], size=size, mode="area")[0].movedim(0, -1)


def _blurred(image: Tensor, sigma: float) -> Tensor:
    """Gaussian blur by `sigma` pixels; the border's pixels are repeated outwards."""
    if sigma == 0.0:
        return image
    radius = math.ceil(3.0 * sigma)
    kernel = torch.exp(-0.5 * (torch.arange(-radius, radius + 1).to(image) / sigma) ** 2)
    kernel = kernel / kernel.sum()
    rows = F.pad(image.movedim(-1, 0)[:, None], (radius, radius, radius, radius), mode="replicate")
    rows = F.conv2d(F.conv2d(rows, kernel.reshape(1, 1, -1, 1)), kernel.reshape(1, 1, 1, -1))
    return rows[:, 0].movedim(0, -1)
