"""render(): the image of a scene, differentiable.

The image is an estimate from samples, and so is the gradient, with samples of its own: both are unbiased, the gradient for
the derivative of the expected image.
"""

from __future__ import annotations

from torch import Tensor

from ._ops import render_image
from ._request import as_scene, make_request
from .camera import Camera
from .mesh import Mesh
from .scene import Scene


def render(
    scene: Scene | Mesh,
    camera: Camera,
    spp: int = 16,
    seed: int = 0,
    *,
    surface_samples: int | None = None,
    edge_samples: int | None = None,
    visibility: bool = True,
    filter: str = "box",
    grad_seed: int | None = None,
) -> Tensor:
    """The image (H, W, C) of a scene, or (B, H, W, C) for a batch of cameras: linear radiance, row 0 on top.

    spp              samples a pixel of the image
    seed             the same seed gives the same bits, image and gradient, at any number of threads; cameras of a batch
                     get samples of their own. With a constant seed, each step of an optimisation repeats the samples of
                     image and gradient, and their error does not average out: pass seed=step
    surface_samples  samples of the gradient inside faces, for each camera: an int in all, or None for ½ a unit of surface,
                     (area + longest side · 1 px) summed over the triangles in view; 4 where they are textured; up to 5 times
                     as many where the loss is as rough as noise, down to 1/16 where triangles are small and it changes
                     little over them, ⅛ to 1/64 where they are most likely occluded. Large textured triangles, and large
                     ones under a rough loss, take whole samples a pixel, at least one
    edge_samples     samples of the gradient at edges, for each camera: an int in all, or None for 24 a pixel of curve, 1/16
                     where it is most likely occluded; creases by the size of their jump, and few where all of one is visible.
                     Default samples of both kinds together take about as long as the image at most: plan() says where
                     that bound
    visibility       False leaves out what moves at silhouettes and other jumps; the gradient is then that of the shading alone
    filter           "box" (1 px wide), "tent" (2 px) or "gaussian" (σ ½ px, 3 px)
    grad_seed        seed of the gradient's samples; derived from `seed` when None. They also depend on the image by which
                     faces it hit, which says where to put them

    Differentiable once, in reverse, in every floating-point tensor of the scene and the camera; torch.vmap and torch.func's
    transforms in reverse mode work, one element of the batch at a time, all with the same seed. The image has the dtype of
    the colours and comes back on the scene's device. Raises TypeError or ValueError that names the argument, and MemoryError,
    before it allocates, with the figure and what to lower; so does its backward pass. A second derivative, or one in forward
    mode, raises RuntimeError.
    """
    request = make_request(
        scene, camera, spp, seed, surface_samples=surface_samples, edge_samples=edge_samples, visibility=visibility,
        filter=filter, grad_seed=grad_seed,
    )  # fmt: skip
    image = render_image(request, batched=camera.batch is not None)
    return image.to(as_scene(scene).meshes[0].verts.device)
