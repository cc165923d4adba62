"""fit_texture(): find the colours on a known shape."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

from ...camera.camera import Camera
from ...camera.poses import image_size
from ...check import check_positive
from ...optim.parameter import Parameter
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..losses import REGION
from ..modes import in_full_precision
from ..options import DESCENT_OPTIONS, FitOptions, Settings
from ..views import Images, views_of
from .fit_scene import fit_views
from .result import Fit
from .settings import DESCENT


@in_full_precision
def fit_texture(
    mesh: Mesh,
    images: Images,
    cameras: Camera | Sequence[Camera],
    size: int | tuple[int, int] = 512,
    *,
    lr: float = 0.05,
    background: Tensor | None = None,
    masks: Images | None = None,
    weights: Images | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    options: FitOptions | None = None,
) -> Fit:
    """Find the texture of a mesh from pictures of it.

    Parameters
    ----------
    mesh : Mesh
        With texture coordinates, as unwrap() makes them. Its texture, if it has one, is where the fit starts.
    images, cameras, weights, regularizer
        As of fit_scene().
    masks : Tensor or sequence of Tensor, optional
        (H, W) each, 1 on the mesh and 0 elsewhere. Outside of them pictures are compared over black, so they must show the
        whole mesh: what hides a part of it belongs into `weights`, as 0.
    size : int or (int, int), default 512
        Texels on a side, or (h, w).
    lr : float, default 0.05
        Learning rate, radiance per step.
    background : Tensor, optional
        Radiance behind the mesh, (C,) or (H, W, C); by default black.
    options : FitOptions, optional
        Of its defaults, `steps` is 500 and `spp` 16.

    Returns
    -------
    Fit
        `mesh` has the texture found, `mesh.texture`.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.

    Notes
    -----
    The texture is the sum of an image pyramid whose levels are fitted at once, so texels that no picture shows take the colours
    of their surroundings. Colours stay above 0.
    """
    settings = Settings.from_options(options, "fit_texture", DESCENT_OPTIONS)
    if settings.loss == REGION:
        raise ValueError(
            f"options.loss: expected one between render and picture, got {settings.loss!r}, which is for shapes and poses; give "
            '"l1" or "l2"'
        )
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; load one with load_mesh(path)")
    if mesh.uvs is None:
        raise ValueError("mesh: expected texture coordinates, got a mesh without; use unwrap(mesh)")
    h, w = image_size((size, size) if isinstance(size, int) else size)
    check_positive("lr", lr, least=0.0, most=1e30)
    views = views_of(cameras, images, masks, weights)
    pictures = [view.image for view in views if view.image is not None]
    if not pictures:
        raise ValueError("images: expected pictures to take the colours from, got none")
    C = pictures[0].shape[-1]
    shape = mesh.to("cpu").detach()
    if shape.texture is not None and shape.texture.shape[-1] != C:
        raise ValueError(
            f"images: expected {shape.texture.shape[-1]} channels like the mesh's texture, got {C}; read them with "
            f"read_image(path, channels={shape.texture.shape[-1]}), and give their alpha as masks"
        )
    first = (
        torch.full((h, w, C), 0.5, dtype=torch.float32) if shape.texture is None else resampled(shape.texture, (h, w))
    )
    behind = None if masks is not None else background

    def build(values: dict[str, Tensor]) -> tuple[Scene, list[Camera]]:
        total = sum((resampled(level, (h, w)) for level in values.values()), first)
        # The gradient ignores the clamp, so that a texel which went below 0 comes back.
        texture = total + (total.clamp(min=0.0) - total).detach()
        return Scene([shape.replace(texture=texture)], behind), [view.camera for view in views]

    sizes = [(h, w)]
    while min(sizes[-1]) > DESCENT.coarsest_texels:
        sizes.append((max(1, sizes[-1][0] // 2), max(1, sizes[-1][1] // 2)))
    levels = {
        f"level{k}": Parameter(lr / len(sizes), torch.zeros(*s, C, dtype=torch.float32)) for k, s in enumerate(sizes)
    }
    given = {"mesh": shape, "size": (h, w), "lr": lr, "background": behind}
    return fit_views(build, views, levels, settings, given, regularizer)


def resampled(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Resize (h, w, C) bilinearly."""
    if tuple(image.shape[:2]) == size:
        return image
    batch = image.movedim(-1, 0)[None]
    return F.interpolate(batch, size=size, mode="bilinear", align_corners=False, antialias=False)[0].movedim(0, -1)
