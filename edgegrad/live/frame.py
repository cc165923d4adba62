"""What a live view shows at one moment, whichever fit it comes from."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..aovs import render_aovs
from ..camera.camera import Camera
from ..files.image import linear_to_srgb
from ..fit import Calibration, CameraFit, Fit, PoseFit, Progress, RigFit
from ..fit.pose.photo.overlay import overlay
from ..fit.pose.result import Step
from ..fit.pose.task import PoseTask
from ..fit.sides import outlined
from ..fit.views import Images, View, area_mean, cameras_of, views_of
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from ..scene.tree import map_tensors

LARGEST = 256  # pixels on the longer side of a picture
SPP = 8
CONTRAST = 4  # of the difference
BONE = (1.0, 0.55, 0.1)  # colour, sRGB


class Frame(NamedTuple):
    scene: Scene
    matrix: Tensor | None  # (4, 4), a similarity that places all meshes of the scene; None: they are where they are
    cameras: list[Camera]
    targets: list[Tensor | None]  # (H, W, C) linear, one for each camera
    render: Callable[[int], Tensor]  # (h, w, C) as that camera sees it, of up to LARGEST pixels
    bones: Tensor | None = None  # (K, 2, 3) ends of the bones of what bends

    def panel(self, index: int) -> list[np.ndarray]:
        """target, render and difference (h, w, 3) of a camera, uint8; without a target the render alone."""
        with torch.no_grad():
            render = displayed(self.render(index))
            size, target = (render.shape[0], render.shape[1]), self.targets[index]
            shown = render if self.bones is None else with_bones(render, self.cameras[index].resized(size), self.bones)
            if target is None:
                return [as_bytes(shown)]
            target = displayed(area_mean(target.float(), size))
            return [as_bytes(picture) for picture in (target, shown, CONTRAST * (render - target).abs())]


Shown = PoseFit | CameraFit | Calibration | RigFit | Progress | Fit


def frame_of(fit: Shown) -> Frame:
    """Of what a fit's callback gets, or a fit returns. Raises TypeError for something else, and for a pose from a file."""
    if isinstance(fit, Calibration):
        return frame_of(fit.fits[-1])
    if isinstance(fit, CameraFit):  # whose search moves the scene before a camera at rest
        return frame_of(fit.search)._replace(matrix=None, cameras=[camera.detach() for camera in fit.cameras])
    if isinstance(fit, PoseFit) and fit.task is not None and fit.history:
        return _frame_of_pose(fit.task, next(step for step in reversed(fit.history) if step.best))
    if isinstance(fit, RigFit):
        return frame_of(fit.fit)._replace(bones=fit.bones)
    if isinstance(fit, Progress):
        return _frame(fit.scene, fit.cameras, fit.views)._replace(bones=fit.bones)
    if isinstance(fit, Fit):
        return _frame(fit.scene, fit.cameras, fit.views)
    raise TypeError(f"fit: expected what a fit gives its callback, or returns, got {type(fit).__name__}")


def frame_of_scene(
    scene: Mesh | Scene, cameras: Camera | Sequence[Camera] | None, images: Images | None, masks: Images | None
) -> Frame:
    """Of what a loop of the user's has. Raises TypeError or ValueError that names the argument."""
    if not isinstance(scene, Mesh | Scene):
        raise TypeError(f"scene: expected a Scene or a Mesh, got {type(scene).__name__}")
    whole = Scene([scene]) if isinstance(scene, Mesh) else scene
    whole = map_tensors(whole, lambda tensor: tensor.detach().cpu().clone())  # the loop goes on to change them
    if cameras is None:
        if images is not None or masks is not None:
            raise ValueError("cameras: expected with images and masks, got None; give the camera of each")
        views = []
    elif images is None and masks is None:
        views = [View(camera, None, None, None) for camera in cameras_of(cameras)]
    else:
        views = views_of(cameras, images, masks)
    return _frame(whole, [view.camera for view in views], views)


def _frame(scene: Scene, cameras: list[Camera], views: list[View]) -> Frame:
    def render(index: int) -> Tensor:
        view = views[index]
        small = view.resized(min(1.0, LARGEST / max(view.camera.size)))
        size = small.camera.size
        behind = scene.background
        behind = area_mean(behind, size) if behind is not None and behind.dim() == 3 else behind
        name = (*view.aovs, "image")[0]
        camera = cameras[index].resized(size)
        found = render_aovs(scene.replace(background=behind), camera, [name], spp=SPP, seed=0)[name]
        if view.outlined:
            return outlined(small.shown, found)
        return view.measured[name].displayed(found) if name in view.measured else found

    return Frame(scene, None, cameras, [view.shown if view.aovs else None for view in views], render)


def _frame_of_pose(task: PoseTask, step: Step) -> Frame:
    def render(index: int) -> Tensor:
        one = dataclasses.replace(task, shots=[task.shots[index]])
        factor = min(1.0, LARGEST / max(one.shots[0].camera.size))
        return overlay(one, one.level(factor, blur=0.0, coarseness=1.0, spp=SPP, dofs=[]), step.pose)[0]

    cameras = [task.lens(shot.camera, step.pose) for shot in task.shots]
    return Frame(task.scene, step.pose.matrix, cameras, [shot.target for shot in task.shots], render)


def with_bones(image: Tensor, camera: Camera, bones: Tensor) -> Tensor:
    """A picture (h, w, 3) with bones (K, 2, 3) drawn into it, as curves where the lens bends them."""
    t = torch.linspace(0.0, 1.0, 2 * max(camera.size), dtype=bones.dtype)[:, None]
    points = (bones[:, None, 0] + t * (bones[:, None, 1] - bones[:, None, 0])).reshape(-1, 3)
    pixels = camera.detach().project(points.to(camera.K.dtype))
    inside = (
        torch.isfinite(pixels).all(-1) & (pixels >= 0).all(-1) & (pixels < pixels.new_tensor(camera.size[::-1])).all(-1)
    )
    x, y = pixels[inside].long().unbind(-1)
    drawn = image.clone()
    drawn[y, x] = image.new_tensor(BONE)
    return drawn


def displayed(image: Tensor) -> Tensor:
    """(H, W, 3) sRGB in 0 … 1; of other than three channels the first."""
    colors = image[..., :3] if image.shape[-1] >= 3 else image[..., :1].expand(-1, -1, 3)
    return linear_to_srgb(colors.detach().clamp(0.0, 1.0))


def as_bytes(image: Tensor) -> np.ndarray:
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
