"""fit_texture(): the colours on a known shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_positive, check_positive_int
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..losses import REGION
from ..options import Parameter
from ..views import Images, views_of
from .fit_scene import fit_views, options_of
from .result import Fit

COARSEST = 4  # texels on a side


def fit_texture(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    images: Images,
    size: int | tuple[int, int] = 512,
    *,
    lr: float = 0.05,
    background: Tensor | None = None,
    masks: Images | None = None,
    weights: Images | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    **options: Any,
) -> Fit:
    """Finds the texture of a mesh from pictures of it.

    mesh        with texture coordinates, as unwrap() makes them; a texture that it has is where the fit starts
    size        texels: one number, or (h, w)
    lr          the learning rate, radiance a step
    background  behind the mesh, (C,) or (H, W, C)

    The rest is as for fit_scene(). The texture is the sum of an image pyramid, and the fit finds all its levels at once: what no
    picture shows takes the colours of its surroundings from the coarse ones. Colours stay above 0. The mesh found is
    `fit.mesh`, its texture `fit.mesh.texture`. Raises TypeError or ValueError that names the argument.
    """
    opts = options_of(options)
    if opts.loss == REGION:
        raise ValueError(
            f'loss: expected one between render and picture, got {opts.loss!r}, which is for shapes and poses; give "l1" or "l2"'
        )
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; load one with load_mesh(path)")
    if mesh.uvs is None:
        raise ValueError("mesh: expected texture coordinates, got a mesh without; use unwrap(mesh)")
    if not isinstance(size, int) and (not isinstance(size, (tuple, list)) or len(size) != 2):
        raise TypeError(f"size: expected an int or (h, w), got {size!r}")
    h, w = (size, size) if isinstance(size, int) else size
    for n in (h, w):
        check_positive_int("size", n)
    check_positive("lr", lr, least=0.0, most=1e30)
    views = views_of(cameras, images, masks, weights)
    pictures = [view.image for view in views if view.image is not None]
    if not pictures:
        raise ValueError("images: expected pictures to take the colours from, got none")
    C = pictures[0].shape[-1]
    shape = mesh.to("cpu").detach()
    first = torch.full((h, w, C), 0.5) if shape.texture is None else resampled(shape.texture, (h, w))
    behind = None if masks is not None else background

    def build(values: dict[str, Tensor]) -> tuple[Scene, list[Camera]]:
        total = sum((resampled(level, (h, w)) for level in values.values()), first)
        # Clamped, but for the gradient: a texel that went below 0 comes back.
        texture = total + (total.clamp(min=0.0) - total).detach()
        return Scene([shape.replace(texture=texture)], behind), [view.camera for view in views]

    sizes = [(h, w)]
    while min(sizes[-1]) > COARSEST:
        sizes.append((max(1, sizes[-1][0] // 2), max(1, sizes[-1][1] // 2)))
    levels = {f"level{k}": Parameter(lr / len(sizes), torch.zeros(*s, C)) for k, s in enumerate(sizes)}
    given = {"mesh": shape, "size": (h, w), "lr": lr, "background": behind}
    return fit_views(build, views, levels, opts, given, regularizer)


def resampled(image: Tensor, size: tuple[int, int]) -> Tensor:
    """(h, w, C) of another size, bilinear."""
    if tuple(image.shape[:2]) == size:
        return image
    batch = image.movedim(-1, 0)[None]
    return F.interpolate(batch, size=size, mode="bilinear", align_corners=False, antialias=False)[0].movedim(0, -1)
