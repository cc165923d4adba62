"""check_shader(): whether a shader shades each point by itself."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .hits import Hits
from .samples import primary_hits


def check_shader(scene: Scene | Mesh, camera: Camera, shader: Callable[[Hits], Tensor], spp: int = 4) -> None:
    """Check that a shader gives each point a radiance that does not depend on the other points it is given.

    It shades the hits of an image, and half of them again in another order.

    Parameters
    ----------
    scene, camera, shader
        As of render(), with one camera.
    spp : int, default 4
        Samples per pixel.

    Raises
    ------
    ValueError
        Values differ: the shader mixes points, or draws random numbers.
    TypeError
        The shader is no function, or returns no tensor.
    """
    if not callable(shader):
        raise TypeError(f"shader: expected a function of Hits, got {type(shader).__name__}")
    hits = primary_hits(scene, camera, spp, seed=0).hits
    order = torch.randperm(len(hits), generator=torch.Generator().manual_seed(0))[: (len(hits) + 1) // 2]
    with torch.no_grad():
        radiance, again = shader(hits), shader(hits._subset(order.to(hits.face.device)))
    for found, count in ((radiance, len(hits)), (again, len(order))):
        if not isinstance(found, Tensor):
            raise TypeError(f"shader: expected a tensor ({count}, C), got {type(found).__name__}")
        if found.dim() != 2 or len(found) != count:
            raise ValueError(f"shader: expected a row for each hit, ({count}, C), got shape {tuple(found.shape)}")
    expected, scale = radiance[order.to(radiance.device)], float(radiance.abs().max()) if radiance.numel() else 0.0
    if not torch.allclose(again, expected, rtol=1e-4, atol=1e-5 * scale):
        raise ValueError(
            "shader: expected a function of each point by itself, got other values for half of the points in another order; "
            "leave out what mixes points (batch norm, means, sorting) and what is drawn at random"
        )
