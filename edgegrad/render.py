"""render(): the image of a scene, differentiable.

The image is an estimate from samples, and so is the gradient, with samples of its own: both are unbiased, the gradient for
the derivative of the expected image.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, overload

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
from .light.radiance import Lighting, check_unlit
from .light.unused_options import warn_of_unused
from .sampling import SHADING, RenderOptions, Sampling, check_options, check_sampling, drawn_seed, without_shading
from .scene.mesh import Mesh
from .scene.scene import Scene, as_scene
from .scene.tree import map_tensors, savable, tensors_in
from .shader import Shader, render_shaded

if TYPE_CHECKING:
    from typing_extensions import Unpack


def render(
    scene: Scene | Mesh,
    camera: Camera,
    spp: int = 16,
    seed: int | None = None,
    *,
    shader: Shader | None = None,
    filter: str = "box",
    visibility: bool = True,
    shadows: bool = True,
    bounces: int = 1,
    sampling: Sampling | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Render a scene: an image of linear radiance, differentiable in every tensor of the scene and the camera.

    Parameters
    ----------
    scene : Scene or Mesh
        With a light, or a mesh that has a material, it is lit; else colours and textures are the radiance.
    camera : Camera
        One camera, or a batch of B cameras.
    spp : int, default 16
        Samples per pixel. Four times as many at least halve the noise of the image, and that of the gradient.
    seed : int, optional
        The same seed gives the same bits, at any number of threads. By default torch's generator draws one, so that errors
        average out over the steps of a loop, and torch.manual_seed() makes it repeatable.
    shader : callable, optional
        Function of Hits that returns the radiance (N, C) of N points, in place of colours, textures, materials and lights.
        Each point is shaded by itself. Discontinuities within faces are declared by hits.where(), hits.floor() or textures.
    filter : {"box", "tent", "gaussian"}, default "box"
        Pixel filter: 1 px wide, 2 px wide, or of σ = ½ px cut off at 3 px.
    visibility : bool, default True
        False leaves out what moves at silhouettes and other discontinuities: the gradient is then that of the shading alone.
    shadows : bool, default True
        False lets light pass through all surfaces. Lit scenes only.
    bounces : int, default 1
        Largest number of times that light is scattered on a path, 1 … 64; 1 is direct light. Lit scenes only.
    sampling : Sampling, optional
        Sample counts of the gradient and of lights, instead of those that follow from `spp`.
    generator : torch.Generator, optional
        Draws the seed instead of torch's default generator.

    Returns
    -------
    Tensor
        (H, W, C), or (B, H, W, C) for a batch of cameras; row 0 on top, on the scene's device, in the dtype of the colours (lit
        scenes: of the vertices).

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.
    MemoryError
        The image, or later its gradient, does not fit into memory.
    RuntimeError
        A second derivative is asked for: the image is differentiable once, in reverse and in forward mode.
    """
    scene = as_scene(scene)
    if shader is not None or scene.is_shaded:
        scene, camera = savable(scene), savable(camera)
    sampling = check_sampling(sampling)
    request = make_request(
        scene, camera, spp, seed, filter=filter, visibility=visibility, sampling=sampling, generator=generator
    )
    lighting = Lighting.from_options(shadows, bounces, sampling)
    warn_of_unused(scene, shader is not None, lighting, sampling)
    if shader is not None:
        return render_shaded(scene, camera, shader, request, sampling.creases)
    if scene.is_shaded:
        return lit_image(lighting, scene, camera, request, sampling.creases)
    image = render_image(request, batched=camera.batch is not None)
    return image.to(scene.meshes[0].verts.device)


SAMPLES_OF_SMALL_IMAGE = 1 << 22  # samples of an image, up to which one thread an image is better than all of them


def render_batch(
    pairs: Sequence[tuple[Scene | Mesh, Camera]],
    spp: int = 16,
    seed: int | Sequence[int] | None = None,
    **options: Unpack[RenderOptions],
) -> Tensor | list[Tensor]:
    """Render different scenes, each before a camera of its own.

    Images and gradients have the bits of render() for one pair after the other. Small images that are neither lit nor shaded
    take one thread each: as many are rendered, and differentiated, in parallel as there are threads.

    Parameters
    ----------
    pairs : sequence of (Scene or Mesh, Camera)
        No camera is a batch.
    spp : int, default 16
        Samples per pixel.
    seed : int or sequence of int, optional
        One of all pairs, or one of each; by default torch's generator draws one for each.
    **options
        Other arguments of render().

    Returns
    -------
    Tensor or list of Tensor
        (B, H, W, C), or a list of (H, W, C) where sizes or dtypes differ.

    Raises
    ------
    TypeError, ValueError
        What render() raises, with the number of the pair.
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
    together = not set(SHADING) & set(options)
    plain = without_shading(options)
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
                request = make_request(*pair, spp, own, **plain)
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
    scene: Scene | Mesh, camera: Camera, tangents: Mapping[Tensor, Tensor], spp: int = 16, seed: int | None = None,
    *, aovs: None = None, **options: Unpack[RenderOptions],
) -> tuple[Tensor, Tensor]: ...  # fmt: skip
@overload
def jvp(
    scene: Scene | Mesh, camera: Camera, tangents: Mapping[Tensor, Tensor], spp: int = 16, seed: int | None = None,
    *, aovs: Sequence[str], **options: Unpack[RenderOptions],
) -> tuple[dict[str, Tensor], dict[str, Tensor]]: ...  # fmt: skip
def jvp(
    scene: Scene | Mesh,
    camera: Camera,
    tangents: Mapping[Tensor, Tensor],
    spp: int = 16,
    seed: int | None = None,
    *,
    aovs: Sequence[str] | None = None,
    **options: Unpack[RenderOptions],
) -> Any:
    """Render an image together with its derivatives in D directions (forward mode).

    All directions share the samples of one pass, which go by area and length alone, for no adjoint says where they matter. The
    first call in a process takes some seconds, in which torch loads its rules of forward mode. It is torch.func.jvp of render()
    under torch.vmap; what it returns is not in the graph.

    Parameters
    ----------
    scene, camera, spp, seed
        As of render().
    tangents : mapping of Tensor to Tensor
        For tensors that the scene or the camera holds, their derivatives (D, *shape): `{mesh.verts: dv, camera.K: dK}`.
        Those of all other tensors are zero.
    aovs : sequence of str, optional
        Channels, but for ids, as of render_aovs(): then both results are dicts of these.
    **options
        Other arguments of render().

    Returns
    -------
    image : Tensor or dict
        (H, W, C), or (B, H, W, C) for a batch of cameras.
    image_dot : Tensor or dict
        (D, H, W, C), or (D, B, H, W, C).

    Raises
    ------
    TypeError, ValueError
        What render() raises.
    """
    check_options("jvp", options, without=() if aovs is None else ("shader",))
    seed = int(drawn_seed(seed, options.pop("generator", None)))
    make_request(scene, camera, spp, seed, **without_shading(options))  # checks them
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

    of_channels: dict[str, Any] = dict(options)

    def image(*values: Tensor) -> Any:
        moved = dict(zip(map(id, leaves), values, strict=True))

        def replaced(tensor: Tensor) -> Tensor:
            return moved.get(id(tensor), tensor)

        there = map_tensors(scene, replaced), map_tensors(camera, replaced)
        if aovs is not None:
            return render_aovs(*there, aovs, spp, seed, **of_channels)
        return render(*there, spp, seed, **options)

    def direction(*values: Tensor) -> Any:
        return torch.func.jvp(image, tuple(leaves), values)

    with torch.no_grad():
        out_dims: Any = (None, 0)  # the image does not depend on the direction
        primal, image_dot = torch.func.vmap(direction, out_dims=out_dims)(*values)
        return tree_map(torch.Tensor.detach, (primal, image_dot))


def screen_gradient(
    scene: Scene | Mesh,
    camera: Camera,
    adjoint: Tensor,
    spp: int = 16,
    seed: int | None = None,
    **options: Unpack[RenderOptions],
) -> Tensor:
    """Compute how a loss changes as what is seen in each pixel moves in the image: content should go against it.

    Parameters
    ----------
    scene, camera, spp, seed
        As of render(); the scene is not lit.
    adjoint : Tensor
        ∂loss/∂image, of the image's shape.
    **options
        Other arguments of render(), but for `shader`, `shadows` and `bounces`.

    Returns
    -------
    Tensor
        (H, W, 2), or (B, H, W, 2): derivatives by motion to the right and down, per pixel. Their sum is the derivative for moving
        everything together; what the background does is not in it.

    Raises
    ------
    TypeError, ValueError
        What render() raises.
    """
    check_unlit("screen_gradient", as_scene(scene), "detach the materials, or take the gradient of render()")
    check_options("screen_gradient", options, without=SHADING)
    request = make_request(scene, camera, spp, seed, **without_shading(options))
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
