"""render(): the image of a scene, differentiable.

The image is an estimate from samples, and so is the gradient, with samples of its own: both are unbiased, the gradient for
the derivative of the expected image.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, overload

import torch
from torch import Tensor
from torch.utils._pytree import tree_map

from .aovs import IDS, check_aovs, render_aovs
from .camera.camera import Camera
from .check import as_int, as_tensor, check_finite, check_float, check_not_meta, check_shape, values_visible
from .kernel.autograd import render_image
from .kernel.batch import render_images
from .kernel.operators import forward_kernel, screen_gradient_kernel
from .kernel.request import Request, check_camera, make_request
from .light.lit_operator import lit_image
from .light.radiance import LIGHTING, Lighting, check_unlit
from .light.unused_options import warn_of_unused
from .scene.mesh import Mesh
from .scene.scene import Scene, as_scene
from .scene.tree import map_tensors, savable, tensors_in
from .shader import Shader, render_shaded

SHADING = ("shader", "creases", "check_shader", *LIGHTING)  # the options of shaders and of lit scenes


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
    shader: Shader | None = None,
    creases: bool | str = "auto",
    check_shader: bool = False,
    step_spacing: float = 1.0,
    shadows: bool = True,
    light_samples: int = 1,
    bounces: int = 1,
) -> Tensor:
    """The image (H, W, C) of a scene, or (B, H, W, C) for a batch of cameras: linear radiance, row 0 on top.

    spp              samples a pixel of the image. In lit scenes and around shaders they find what covers a pixel; a face in it is
                     shaded at one of each 16 of them, under lights with an extent at up to a quarter of them, where a border
                     runs through at up to 8 times as many: for less noise of shading at the same time render a larger
                     image, and average
    seed             the same seed gives the same bits, image and gradient, at any number of threads; cameras of a batch
                     get samples of their own. With a constant seed, each step of an optimisation repeats the samples of
                     image and gradient, and their error does not average out: pass seed=step
    surface_samples  samples of the gradient inside faces, for each camera: an int in all, or None for ½ a unit of surface,
                     (area + longest side · 1 px) summed over the triangles in view; 4 where they are textured; up to 5 times
                     as many where the loss is as rough as noise, down to 1/16 where triangles are small and it changes
                     little over them, ⅛ to 1/64 where they are most likely occluded. Large textured triangles, and large
                     ones under a rough loss, take whole samples a pixel, at least one. In lit scenes ½ a unit, and one a pixel
                     of textured triangles that are no slivers
    edge_samples     samples of the gradient on curves, for each camera: an int in all on silhouettes, borders, creases, lines
                     where faces pass through each other and the lens boundary, and as many on the borders of the shadows of
                     each light; or None for 24 a pixel of curve, 6 in lit scenes, 1/16 where it is most likely occluded;
                     creases by the size of their jump, and few where all of one is visible. Default samples of both kinds
                     together take about as long as the image at most: plan() says where that bound holds
    visibility       False leaves out what moves at silhouettes and other jumps; the gradient is then that of the shading alone
    filter           "box" (1 px wide), "tent" (2 px) or "gaussian" (σ ½ px, 3 px)
    grad_seed        seed of the gradient's samples; derived from `seed` when None. They also depend on the image by which
                     faces it hit, which says where to put them
    shader           a function or module of Hits that gives the radiance (N, C) of N points, in place of the meshes' colours
                     and textures: any PyTorch, as long as each point is by itself. It is asked once for each face in a
                     pixel, and for each 16 samples, in parts of some 131,072 points. Where it jumps within a face, that has a
                     gradient if it says so by hits.where(), hits.floor() or a nearest lookup. Meshes that blend are composed
                     with what it gives behind them, where such jumps have no gradient
    creases          at which edges between two visible faces the shader may jump: "auto", where a property of the hits
                     jumps that it asked for (normals; texture coordinates at seams; attributes of interpolate(); all
                     edges if it asked for `face` or `barycentrics`); True, at all; False, at none
    check_shader     asks the shader twice, the second time with half of the points in another order, and compares
    step_spacing     px between the lines along which steps within faces are looked for: those that a shader declares, of which
                     two borders that lie closer may be missed; alpha edges, and borders of nearest texels.
                     Closer lines cost more and err less
    shadows          of lit scenes: False lets light pass through everything
    light_samples    of lit scenes: points drawn of each light that has an extent, for each point that is shaded. Of a face in a
                     pixel at most a quarter of its samples are, or 4 if spp is below 16; in images of glossy surfaces under an
                     Environment all are, with fewer points of lights each and no fewer in all
    bounces          of lit scenes without a shader: how often light is scattered on its way, at most, 1 … 64; 1: direct light. A
                     path goes on from each point that is shaded, as the material there scatters, and draws one point of
                     each light wherever it comes to; from the third bounce on it may end early (Russian roulette). Colours
                     of meshes without a material light nothing. Everything has its gradient, but for what moves in scenes of
                     which one mesh blends, and for texture coordinates of nearest textures: there it is refused, unless
                     visibility=False

    A scene with a light, or with a mesh that has a material, is lit: see Scene and Material. Its image has the dtype of the
    vertices.

    Differentiable once, in reverse and in forward mode, in every floating-point tensor of the scene and the camera; torch.vmap
    and torch.func's transforms work, one element of the batch at a time, all with the same seed; tangents of one image
    (torch.func.jacfwd) in one pass. The image has the dtype of
    the colours and comes back on the scene's device. Raises TypeError or ValueError that names the argument, and MemoryError,
    before it allocates, with the figure and what to lower; so does its backward pass. A second derivative raises
    RuntimeError. Warns of options of lit scenes and of shaders that have no effect on the image.
    """
    scene = as_scene(scene)
    if shader is not None or scene.is_shaded:
        scene, camera = savable(scene), savable(camera)
    request = make_request(
        scene, camera, spp, seed, surface_samples=surface_samples, edge_samples=edge_samples, visibility=visibility,
        filter=filter, grad_seed=grad_seed, step_spacing=step_spacing,
    )  # fmt: skip
    lighting = Lighting.from_options(shadows, light_samples, bounces)
    shading = {"creases": creases, "check_shader": check_shader, **lighting.options}
    warn_of_unused(scene, shader is not None, shading)
    if shader is None and scene.is_shaded:
        return lit_image(lighting, scene, camera, request, creases)
    if shader is not None:
        return render_shaded(scene, camera, shader, request, creases, check_shader)
    image = render_image(request, batched=camera.batch is not None)
    return image.to(scene.meshes[0].verts.device)


SAMPLES_OF_SMALL_IMAGE = 1 << 22  # samples of an image, up to which one thread an image is better than all of them


def render_batch(
    pairs: Sequence[tuple[Scene | Mesh, Camera]], spp: int = 16, seed: int | Sequence[int] = 0, **options: Any
) -> Tensor | list[Tensor]:
    """The images of different scenes, each before a camera of its own: (B, H, W, C), or a list of (H, W, C) where these differ.

    pairs    scenes, or meshes, with cameras, none of which is a batch
    seed     of all, or one of each

    The other arguments are those of render(). Images and gradients have the bits of render() for one pair after the other. If
    all images are small and neither lit nor shaded, each takes one thread, and as many are rendered, and differentiated, in
    parallel as there are threads, the first while later scenes are still read; in reverse mode, once. Otherwise, so with one
    lit scene among them, they come one after the other, each with all threads.

    Raises what render() raises, with the number of the pair.
    """
    check_options("render_batch", options)
    if isinstance(pairs, (Scene, Mesh)) or not isinstance(pairs, Sequence):
        raise TypeError(f"pairs: expected a list of pairs (scene, camera), got {type(pairs).__name__}; use list(pairs)")
    if not pairs:
        raise ValueError("pairs: expected at least one pair (scene, camera), got none")
    each_its_own = isinstance(seed, Sequence) or (isinstance(seed, Tensor) and seed.dim() > 0)
    seeds: list[Any] = list(seed) if each_its_own else [seed] * len(pairs)  # pyright: ignore[reportArgumentType]
    if len(seeds) != len(pairs):
        raise ValueError(f"seed: expected one, or {len(pairs)}, one of each pair, got {len(seeds)}")
    together = not any(name in SHADING for name in options)
    scenes: list[tuple[Scene, Camera]] = []
    for k, pair in enumerate(pairs):
        if not isinstance(pair, Sequence) or len(pair) != 2:
            raise TypeError(f"pairs[{k}]: expected (scene, camera), got {type(pair).__name__}")
        with _of_pair(k):
            scene, camera = as_scene(pair[0]), pair[1]
            check_camera(camera)
            if camera.batch is not None:
                raise ValueError(
                    f"camera: expected one camera, got a batch of {camera.batch}; give camera[i] one by one"
                )
            together = together and not scene.is_shaded and _is_small(camera, as_int("spp", spp))
        scenes.append((scene, camera))

    def requests() -> Iterator[Request]:
        for k, (pair, own) in enumerate(zip(scenes, seeds, strict=True)):
            with _of_pair(k):
                request = make_request(*pair, spp, own, **options)
            yield request

    images: list[Tensor] = []
    if together:
        found = render_images(requests(), len(scenes))
        images = [image.to(scene.meshes[0].verts.device) for image, (scene, _) in zip(found, scenes, strict=True)]
    else:
        for k, (pair, own) in enumerate(zip(scenes, seeds, strict=True)):
            with _of_pair(k):
                images.append(render(*pair, spp, own, **options))
    equal = all(image.shape == images[0].shape and image.dtype == images[0].dtype for image in images)
    return torch.stack(images) if equal else images


@contextmanager
def _of_pair(k: int) -> Iterator[None]:
    """Errors of arguments get the pair's number; a shader's own kinds stay as they are."""
    try:
        yield
    except (TypeError, ValueError) as error:
        if type(error) in (TypeError, ValueError):
            raise type(error)(f"pairs[{k}]: {error}") from error
        raise


def _is_small(camera: Camera, spp: int) -> bool:
    """And without a lens that may fold, of which a warning would have to find the caller's line."""
    height, width = camera.size
    known = values_visible(camera.coefficients)
    return height * width * spp <= SAMPLES_OF_SMALL_IMAGE and known and not bool(camera.coefficients.any())


@overload
def jvp(
    scene: Scene | Mesh, camera: Camera, tangents: Mapping[Tensor, Tensor], spp: int = 16, seed: int = 0,
    *, aovs: None = None, **options: Any,
) -> tuple[Tensor, Tensor]: ...  # fmt: skip
@overload
def jvp(
    scene: Scene | Mesh, camera: Camera, tangents: Mapping[Tensor, Tensor], spp: int = 16, seed: int = 0,
    *, aovs: Sequence[str], **options: Any,
) -> tuple[dict[str, Tensor], dict[str, Tensor]]: ...  # fmt: skip
def jvp(
    scene: Scene | Mesh,
    camera: Camera,
    tangents: Mapping[Tensor, Tensor],
    spp: int = 16,
    seed: int = 0,
    *,
    aovs: Sequence[str] | None = None,
    **options: Any,
) -> Any:
    """The image, and its derivatives in D directions: (D, H, W, C), or (D, B, H, W, C) for a batch of cameras.

    tangents   for tensors of the scene or the camera, the very ones that these hold, their derivatives (D, *shape) in each
               direction: `{mesh.verts: dv, camera.K: dK}`; those of all others are zero
    aovs       names of channels, but for ids, as render_aovs() has them: then both are dicts of these

    All directions share the samples of one pass. The other arguments are those of render(); samples go by area and length
    alone, for no adjoint says where samples matter. The first call in a process takes some seconds, in
    which torch loads its own rules of forward mode. The same as torch.func.jvp of render(), under torch.vmap; what it returns is
    not in the graph. Raises what render() raises.
    """
    check_options("jvp", options)
    own = {n: v for n, v in options.items() if n not in SHADING}
    make_request(scene, camera, spp, seed, **own)  # checks them
    scene = as_scene(scene)
    for name in check_aovs(aovs) if aovs is not None else ():
        if name in IDS:
            raise ValueError(f"aovs: expected channels with derivatives, got {name!r}; ask render_aovs() for ids")
    if not isinstance(tangents, Mapping) or not tangents:
        raise TypeError(
            "tangents: expected a mapping of tensors of the scene and the camera to their tangents, got "
            f"{type(tangents).__name__ if not isinstance(tangents, Mapping) else 'an empty one'}"
        )
    owned = {id(tensor) for thing in (scene, camera) for tensor in tensors_in(thing)}
    leaves, values = [], []
    for leaf, tangent in tangents.items():
        if not isinstance(leaf, Tensor) or id(leaf) not in owned or not leaf.is_floating_point():
            got = f"a tensor of shape {tuple(leaf.shape)}" if isinstance(leaf, Tensor) else type(leaf).__name__
            raise ValueError(
                f"tangents: expected floating-point tensors that the scene or the camera holds as keys, got {got}; "
                "give mesh.verts of the mesh itself, say"
            )
        value = as_tensor("tangents", tangent, like=leaf, floating=True).detach()
        check_not_meta("tangents", value)
        fix = "the first axis counts directions: tangent[None] is one"
        check_shape("tangents", value, ("D", *leaf.shape), fix=fix)
        leaves.append(leaf)
        values.append(value.to(leaf))
        check_finite("tangents", values[-1])
    counts = sorted({len(value) for value in values})
    if len(counts) > 1:
        raise ValueError(f"tangents: expected as many directions of all, got {counts}")

    def image(*values: Tensor) -> Any:
        moved = dict(zip(map(id, leaves), values, strict=True))

        def replaced(tensor: Tensor) -> Tensor:
            return moved.get(id(tensor), tensor)

        there = map_tensors(scene, replaced), map_tensors(camera, replaced)
        if aovs is not None:
            return render_aovs(*there, aovs, spp, seed, **options)
        return render(*there, spp, seed, **options)

    def direction(*values: Tensor) -> Any:
        return torch.func.jvp(image, tuple(leaves), values)

    with torch.no_grad():
        out_dims: Any = (None, 0)  # the image does not depend on the direction
        primal, image_dot = torch.func.vmap(direction, out_dims=out_dims)(*values)
        return tree_map(torch.Tensor.detach, (primal, image_dot))


def screen_gradient(
    scene: Scene | Mesh, camera: Camera, adjoint: Tensor, spp: int = 16, seed: int = 0, **options: Any
) -> Tensor:
    """How a loss changes as what is seen in each pixel moves in the image: (H, W, 2), or (B, H, W, 2), right and down, per pixel.

    adjoint   ∂loss/∂image, of the image's shape

    It shows where content should go: against it. Its sum is the derivative for moving everything together; what the background
    does is not in it. The other arguments are those of render(). Raises what render() raises.
    """
    check_unlit("screen_gradient", as_scene(scene), "detach the materials, or take the gradient of render()")
    check_options("screen_gradient", options, without=SHADING)
    request = make_request(scene, camera, spp, seed, **options)
    adjoint = as_tensor("adjoint", adjoint, floating=True).detach()
    check_float("adjoint", adjoint)
    shape = (*camera.size, request.channels)
    fix = "it is the derivative of the loss by the image: give it the image's shape"
    check_shape("adjoint", adjoint, shape if camera.batch is None else (request.cameras, *shape), fix=fix)
    check_finite("adjoint", adjoint)
    _, hits, _ = forward_kernel(request)
    images = adjoint.to(request.scene.colors).reshape(request.cameras, *shape).contiguous()
    gradient = screen_gradient_kernel(images, hits, request)
    return (gradient if camera.batch is not None else gradient[0]).to(adjoint.device)


def check_options(function: str, options: Mapping[str, Any], without: Sequence[str] = ()) -> None:
    """Raise TypeError if a `function` that takes the options of render(), but for those `without`, was given others."""
    known = [
        n for n, p in inspect.signature(render).parameters.items() if p.kind is p.KEYWORD_ONLY and n not in without
    ]
    if unknown := [name for name in options if name not in known]:
        raise TypeError(f"{function}: expected only the options {', '.join(known)}, got {unknown[0]!r}")
