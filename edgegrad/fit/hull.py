"""The visual hull of silhouettes, an initial shape for a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from ..camera.camera import Camera
from ..check import check_int, check_positive_int
from ..scene.mesh import Mesh
from .remeshing import gpytoolbox, remeshed
from .views import Images, Observation, views_of

HULL_CELLS = 32  # on a side of the boxes in which the object is looked for
MIN_PIECE = 0.01  # of the largest piece's faces; smaller pieces are dropped


def visual_hull(
    masks: Images,
    cameras: Camera | Sequence[Camera],
    resolution: int = 96,
    faces: int | None = None,
) -> Mesh:
    """Return the largest body that has these silhouettes (Laurentini 1994), as a closed mesh.

    As the start of fit_shape() it has the object's holes, and its parts where some view shows them apart.

    Parameters
    ----------
    masks : Tensor or sequence of Tensor
        (H, W) each, 1 on the object, 0 elsewhere. Nothing is cut away beyond a side of an image that its mask touches, for the
        object may go on there.
    cameras : sequence of Camera
        At least two that look at the object from different sides.
    resolution : int, default 96
        Cells on the longest side of the box around the object; smaller details are lost.
    faces : int, optional
        About so many even triangles; few are best for the first level of fit_shape(). By default those of the cells.

    Raises
    ------
    TypeError, ValueError, ImportError
        An argument is wrong; the message names it. Or gpytoolbox is missing (`pip install 'edgegrad[fit]'`).

    Notes
    -----
    The surface is found by marching cubes at a mask of one half (Lorensen and Cline 1987). Pieces with less than 1 % of the
    faces of the largest piece are dropped.
    """
    check_int("resolution", resolution, 4, 512)
    if faces is not None:
        check_positive_int("faces", faces)
    views = views_of(cameras, None, masks)
    if len(views) < 2:
        raise ValueError(f"cameras: expected at least two, got {len(views)}; one silhouette does not bound a body")
    missing = [i for i, view in enumerate(views) if view.mask is None]
    if missing:
        raise ValueError(f"masks[{missing[0]}]: expected a mask, got None; leave that camera out")
    gpytoolbox("a visual hull")  # before the work
    low, high = _occupied(views, _occupied(views, _where_cameras_look(views)))
    cell = float((high - low).max()) / resolution
    count = ((high - low) / cell).ceil().long() + 3
    # One more cell on each side closes the surface.
    axes = [float(low[k]) + cell * (torch.arange(int(count[k])) - 1).double() for k in range(3)]
    inside = F.pad(_inside(views, axes)[1:-1, 1:-1, 1:-1], (1,) * 6)  # The surface is closed at the grid's border.
    found = _surface(inside, axes)
    return found if faces is None else remeshed(found, faces)


def _where_cameras_look(views: Sequence[Observation]) -> tuple[Tensor, Tensor]:
    """Return a cube around the point nearest to all optical axes, as large as what the cameras see there."""
    cameras = [view.camera for view in views]
    eye = torch.stack([camera.eye.double() for camera in cameras])
    axis = torch.stack([camera.world_to_camera[2, :3].double() for camera in cameras])
    # The point x nearest to lines through e along a solves Σ (I − a aᵀ)(x − e) = 0.
    across = torch.eye(3, dtype=torch.float64) - axis[:, :, None] * axis[:, None, :]
    total = across.sum(0)
    if float(torch.linalg.eigvalsh(total)[0]) < 1e-4 * len(views):
        raise ValueError("cameras: expected some that look in different directions, got parallel ones")
    middle = torch.linalg.solve(total, (across @ eye[:, :, None]).sum(0)[:, 0])
    depths = (axis * (middle - eye)).sum(1).abs().tolist()
    half = max(_half_width(camera, depth) for camera, depth in zip(cameras, depths, strict=True))
    return middle - half, middle + half


def _half_width(camera: Camera, depth: float) -> float:
    """Return half the width of what a camera sees at a depth."""
    if camera.projection not in ("perspective", "orthographic"):
        return depth
    span = max(camera.size[0] / float(camera.K[1, 1]), camera.size[1] / float(camera.K[0, 0]))
    return 0.5 * span * (depth if camera.projection == "perspective" else 1.0)


def _occupied(views: Sequence[Observation], box: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Return the part of the box that is not empty, and one more cell. Raises ValueError."""
    low, high = box
    step = (high - low) / HULL_CELLS
    axes = [low[k] + step[k] * (torch.arange(HULL_CELLS).double() + 0.5) for k in range(3)]
    # Masks are dilated by a cell, so that any pixel that a cell may cover counts.
    places = (_inside(views, axes, float(step.max())) > 0.0).nonzero()
    if not len(places):
        raise ValueError(
            "masks: expected silhouettes of one object, got some that have no body in common; look for cameras in other "
            "conventions, or turned images"
        )
    first, last = places.amin(0), places.amax(0) + 1
    return low + step * (first - 0.5).clamp(min=0), low + step * (last + 0.5).clamp(max=HULL_CELLS)


def _inside(views: Sequence[Observation], axes: Sequence[Tensor], reach: float = 0.0) -> Tensor:
    """Return the least mask (nx, ny, nz) at the points of a grid, zero where no camera sees. A `reach` in world units takes the
    largest mask within it for each camera."""
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    least, seen = torch.ones(len(points)), torch.zeros(len(points), dtype=torch.bool)
    for view in views:
        camera, mask = view.camera, view.mask
        assert mask is not None
        image = mask.movedim(-1, 0)[None]
        pose = camera.world_to_camera.double()
        depth = points @ pose[2, :3] + pose[2, 3]
        if reach > 0.0:
            near = depth[depth > 0].min() if camera.projection == "perspective" and bool((depth > 0).any()) else 1.0
            pixels = min(max(camera.size), int(reach * float(camera.K[0, 0]) / float(near)) + 1)
            image = F.max_pool2d(image, (2 * pixels + 1, 1), 1, (pixels, 0))
            image = F.max_pool2d(image, (1, 2 * pixels + 1), 1, (0, pixels))
        place = camera.project(points.to(camera.K.dtype)).double()
        H, W = camera.size
        valid = place.isfinite().all(-1)
        if camera.projection == "perspective":
            valid &= depth > 0
        unit = torch.where(valid[:, None], 2.0 * place / place.new_tensor([W, H]) - 1.0, 0.0).float()
        found = F.grid_sample(image, unit[None, None], align_corners=False, padding_mode="border")[0, 0, 0]
        found = torch.where((unit.abs() <= 1.0).all(-1), found, _beyond(mask, unit))
        least, seen = torch.where(valid, torch.minimum(least, found), least), seen | valid
    return (least * seen).reshape([len(axis) for axis in axes])


def _beyond(mask: Tensor, unit: Tensor) -> Tensor:
    """Return the mask (N,) at places outside of an image with corners at ±1: 1 beyond sides that the mask touches, where the
    object may go on, and 0 beyond the others."""
    touched = torch.stack([(side > 0.5).any() for side in (mask[:, 0], mask[:, -1], mask[0], mask[-1])])
    x, y = unit.unbind(-1)
    beyond = torch.stack([x < -1.0, x > 1.0, y < -1.0, y > 1.0])
    return (~beyond[~touched].any(0)).float()


def _surface(inside: Tensor, axes: Sequence[Tensor]) -> Mesh:
    nx, ny, nz = inside.shape
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    order = grid.permute(1, 2, 0, 3).reshape(-1, 3)  # gpytoolbox's order: x runs fastest, then z
    field = inside.permute(1, 2, 0).reshape(-1).double()
    found, faces = gpytoolbox("a visual hull").marching_cubes(field.numpy(), order.numpy(), nx, ny, nz, 0.5)
    if not len(faces):
        raise ValueError("masks: expected an object larger than a cell, got none; give a higher resolution")
    verts, triangles = torch.from_numpy(np.ascontiguousarray(found)), torch.from_numpy(faces.astype(np.int64))
    a, b, c = verts[triangles].unbind(1)
    if float((a * torch.linalg.cross(b, c)).sum()) < 0.0:  # six times the volume
        triangles = triangles.flip(1)
    return _without_crumbs(verts, triangles)


def _without_crumbs(verts: Tensor, faces: Tensor) -> Mesh:
    """Drop small pieces."""
    _, piece = gpytoolbox("a visual hull").connected_components(faces.int().numpy(), return_face_indices=True)
    label = torch.from_numpy(np.asarray(piece)).long()
    count = torch.bincount(label)
    faces = faces[count[label] >= MIN_PIECE * count.max()]
    used, index = faces.unique(return_inverse=True)
    return Mesh(verts[used].float(), index.reshape(-1, 3))
