"""A snapshot of a fit: what the live view shows at one moment."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..aovs import render_aovs
from ..camera.camera import Camera
from ..fit.contour_colors import draw_contour
from ..fit.descent.fit_scene import Progress
from ..fit.descent.result import Fit
from ..fit.pose.camera_result import CameraFit
from ..fit.pose.photo.overlay import overlay
from ..fit.pose.result import PoseFit, Step
from ..fit.pose.task import PoseTask
from ..fit.rig.result import RigFit
from ..fit.views import Images, Observation, area_mean, cameras_of, displayed, views_of
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from ..scene.tree import map_tensors

MAX_SIDE = 256  # pixels on the longer side of a picture
SPP = 8
CONTRAST = 4  # factor of the difference
BONE = (1.0, 0.55, 0.1)  # colour, sRGB


class Snapshot(NamedTuple):
    """The scene, cameras and pictures of a fit at one moment."""

    scene: Scene
    matrix: Tensor | None  # (4, 4) similarity by which all meshes of the scene are moved; None: identity
    cameras: list[Camera]
    targets: list[Tensor | None]  # (H, W, C) linear, one for each camera
    render: Callable[[int], Tensor]  # (h, w, C) by a camera's index, with up to MAX_SIDE pixels on a side
    bones: Tensor | None = None  # (K, 2, 3) ends of a rig's bones

    def panel(self, index: int) -> list[np.ndarray]:
        """Return target, render and difference (h, w, 3) uint8 of a camera; without a target the render alone."""
        with torch.no_grad():
            render = displayed(self.render(index))
            size, target = (render.shape[0], render.shape[1]), self.targets[index]
            shown = render if self.bones is None else with_bones(render, self.cameras[index].resized(size), self.bones)
            if target is None:
                return [as_bytes(shown)]
            target = displayed(area_mean(target.float(), size))
            return [as_bytes(picture) for picture in (target, shown, CONTRAST * (render - target).abs())]


Shown = PoseFit | CameraFit | RigFit | Progress | Fit


def snapshot_from_fit(fit: Shown) -> Snapshot:
    """Return the snapshot of what a fit's callback gets, or of a result. Raises TypeError for anything else, and for a pose
    from a file."""
    if isinstance(fit, CameraFit):  # the search moves the scene instead of the camera
        last = fit.searches[-1]
        cameras = [camera.detach() for camera in fit.cameras[-len(last.cameras) :]]
        return snapshot_from_fit(last)._replace(matrix=None, cameras=cameras)
    if isinstance(fit, PoseFit) and fit.task is not None and fit.history:
        return _snapshot_from_pose(fit.task, next(step for step in reversed(fit.history) if step.best))
    if isinstance(fit, RigFit):
        return snapshot_from_fit(fit.fit)._replace(bones=fit.bones)
    if isinstance(fit, Progress):
        return _snapshot(fit.scene, fit.cameras, fit.views)._replace(bones=fit.bones)
    if isinstance(fit, Fit):
        return _snapshot(fit.scene, fit.cameras, fit.views)
    raise TypeError(f"fit: expected what a fit gives its callback, or returns, got {type(fit).__name__}")


def snapshot_from_scene(
    scene: Mesh | Scene, cameras: Camera | Sequence[Camera] | None, images: Images | None, masks: Images | None
) -> Snapshot:
    """Return the snapshot of a user's own loop. Raises TypeError or ValueError that names the argument."""
    if not isinstance(scene, Mesh | Scene):
        raise TypeError(f"scene: expected a Scene or a Mesh, got {type(scene).__name__}")
    whole = Scene([scene]) if isinstance(scene, Mesh) else scene
    whole = map_tensors(whole, lambda tensor: tensor.detach().cpu().clone())  # the loop will change them
    if cameras is None:
        if images is not None or masks is not None:
            raise ValueError("cameras: expected with images and masks, got None; give the camera of each")
        views = []
    elif images is None and masks is None:
        views = [Observation(camera, None, None, None) for camera in cameras_of(cameras)]
    else:
        views = views_of(cameras, images, masks)
    return _snapshot(whole, [view.camera for view in views], views)


def _snapshot(scene: Scene, cameras: list[Camera], views: list[Observation]) -> Snapshot:
    def render(index: int) -> Tensor:
        view = views[index]
        small = view.resized(min(1.0, MAX_SIDE / max(view.camera.size)))
        size = small.camera.size
        behind = scene.background
        behind = area_mean(behind, size) if behind is not None and behind.dim() == 3 else behind
        name = (*view.aovs, "image")[0]
        camera = cameras[index].resized(size)
        found = render_aovs(scene.replace(background=behind), camera, [name], spp=SPP, seed=0)[name]
        if view.by_region:
            return draw_contour(small.shown, found)
        return view.measured[name].displayed(found) if name in view.measured else found

    return Snapshot(scene, None, cameras, [view.shown if view.aovs else None for view in views], render)


def _snapshot_from_pose(task: PoseTask, step: Step) -> Snapshot:
    def render(index: int) -> Tensor:
        one = dataclasses.replace(task, shots=[task.shots[index]])
        return overlay(one, MAX_SIDE, SPP, step.pose)[0][1]

    cameras = [task.lens(shot.camera, step.pose) for shot in task.shots]
    return Snapshot(task.scene, step.pose.matrix, cameras, [shot.target for shot in task.shots], render)


def with_bones(image: Tensor, camera: Camera, bones: Tensor) -> Tensor:
    """Draw bones (K, 2, 3) into a picture (h, w, 3), as curves where the lens distorts them."""
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


def as_bytes(image: Tensor) -> np.ndarray:
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()
