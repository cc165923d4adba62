"""Refine an estimate by fit_pose, from the colour image alone."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import check_flag, check_positive
from ..fit.options import FitOptions
from ..fit.placement import angle
from ..fit.pose.fit_pose import fit_pose
from ..fit.pose.result import PoseFit
from .dataset import Dataset
from .files import Estimate

MIN_CROP = 16  # pixels of the crop on its longer side


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refine()."""

    estimate: Estimate  # with the pose found, or its own if `kept`; the time is that of the given one
    fit: PoseFit | None  # None if none could be made
    kept: bool  # whether the pose is the given one
    why: str  # the fit's reason, or why there is none
    degrees: float  # rotation between both poses
    distance: float  # mm between the mesh's origins in both
    seconds: float


def refine(
    dataset: Dataset,
    estimate: Estimate,
    *,
    margin: float = 0.5,
    unconverged: bool = False,
    options: FitOptions | None = None,
) -> Refined:
    """Fit the object's mesh, with its colours, to the image around the estimate.

    Of the poses that symmetries make equal, the one nearest to the estimate's is returned. If no fit can be made, since the
    object is outside the image, say, the pose is kept with the reason. Raises FileNotFoundError or ValueError that names what
    the data set lacks.

    Parameters
    ----------
    dataset, estimate : Dataset, Estimate
    margin : float, default 0.5
        Part of the image around the object that is used, in sizes of the object's box in the image.
    unconverged : bool, default False
        Whether the pose is taken also of a fit that did not converge. Otherwise the estimate keeps its own.
    options : FitOptions, optional
        As of fit_pose(); `max_size` is that of the part of the image.
    """
    check_positive("margin", margin, least=0.0, most=100.0)
    check_flag("unconverged", unconverged)
    began = time.perf_counter()
    frame, model = dataset.frame(estimate.scene_id, estimate.im_id), dataset.model(estimate.obj_id)
    camera, picture, mesh = frame.camera, frame.picture(), model.mesh

    def kept(why: str, fit: PoseFit | None = None) -> Refined:
        return Refined(estimate, fit, True, why, 0.0, 0.0, time.perf_counter() - began)

    box = _box(mesh.verts.double(), estimate.pose, camera, margin)
    if box is None:
        return kept("the image does not show the object where the estimate has it")
    top, left, height, width = box
    part = picture[top : top + height, left : left + width]
    if mesh.channels == 1:
        part = part.mean(-1, keepdim=True)
    try:
        fit = fit_pose(
            mesh, part, camera.crop(top, left, height, width), init=_orthonormal(estimate.pose), symmetries=model.symmetries,
            options=options,
        )  # fmt: skip
    except ValueError as error:
        return kept(f"no fit: {error}")
    if fit.reason != "converged" and not unconverged:
        return kept(fit.reason, fit)
    turned = math.degrees(angle(_orthonormal(estimate.pose)[:3, :3], fit.R))
    moved = float((fit.t - estimate.pose[:3, 3]).norm())
    return Refined(
        replace(estimate, pose=fit.matrix), fit, False, fit.reason, turned, moved, time.perf_counter() - began
    )  # fmt: skip


def _box(verts: Tensor, pose: Tensor, camera: Camera, margin: float) -> tuple[int, int, int, int] | None:
    """Return top, left, height and width of the part of the image around the object; None if it is outside."""
    q = verts @ pose[:3, :3].T + pose[:3, 3]
    if float(q[:, 2].min()) <= 0.0:
        return None
    xy = camera.project(q)
    low, high = xy.amin(0), xy.amax(0)
    H, W = camera.size
    limit = low.new_tensor([W, H])
    if bool((high <= 0).any() or (low >= limit).any()):
        return None
    border = margin * float((high - low).max()) + 0.5 * MIN_CROP
    (left, top), (right, bottom) = (
        (low - border).floor().clamp(min=0).int().tolist(), (high + border).ceil().minimum(limit).int().tolist(),
    )  # fmt: skip
    return top, left, bottom - top, right - left


def _orthonormal(pose: Tensor) -> Tensor:
    """Replace a rounded rotation by the nearest rotation matrix."""
    U, _, Vh = torch.linalg.svd(pose[:3, :3])
    found = pose.clone()
    found[:3, :3] = U @ Vh
    return found
