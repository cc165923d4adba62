"""render(): the image of a scene, differentiable. An autograd.Function over two operators of the kernel.

The image is an estimate from samples, and so is the gradient, with samples of its own: both are unbiased, the gradient for
the derivative of the expected image.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from . import _memory as memory
from ._check import as_int, check_finite, check_not_meta, check_positive_int, check_shape
from ._kernel import core
from .camera import Camera
from .mesh import Mesh
from .scene import Flat, Scene, flatten, vertex_spacing

FILTERS = ("box", "tent", "gaussian")


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
    arguments = render_arguments(
        scene, camera, spp, seed, surface_samples=surface_samples, edge_samples=edge_samples, visibility=visibility,
        filter=filter, grad_seed=grad_seed,
    )  # fmt: skip
    function = _Render if torch.compiler.is_compiling() else _RenderEager
    image, *_ = function.apply(camera.batch is not None, *arguments)
    return image.to(as_scene(scene).meshes[0].verts.device)


def render_arguments(
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
) -> tuple[Any, ...]:
    """The arguments of render(), checked, as those of the operators. Raises TypeError or ValueError."""
    scene = as_scene(scene)
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}; make one with Camera.look_at(…)")
    spp = check_positive_int("spp", spp, most=1 << 20)
    seed = _check_seed("seed", seed)
    grad_seed = _derived_seed(seed) if grad_seed is None else _check_seed("grad_seed", grad_seed)
    counts = [
        -1 if n is None else check_positive_int(name, n, most=1 << 40)
        for name, n in (("surface_samples", surface_samples), ("edge_samples", edge_samples))
    ]
    if not isinstance(visibility, bool):
        raise TypeError(f"visibility: expected True or False, got {type(visibility).__name__} ({visibility!r})")
    if filter not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {filter!r}")
    if scene.background is not None and scene.background.dim() == 3:
        check_shape("background", scene.background, (*camera.size, "C"), fix="give it the camera's size")

    _check_devices(scene, camera)

    flat = flatten(scene)
    if torch.compiler.is_compiling():
        # Dynamo does not trace a function that is given one tensor twice; corners of vertex colours are the faces.
        flat = flat._replace(corners=flat.corners.clone())
    world_to_camera = camera.world_to_camera.cpu().double().reshape(-1, 4, 4)
    K = camera.K.cpu().double().reshape(-1, 3, 3)
    B = max(world_to_camera.shape[0], K.shape[0])
    return (
        *flat,
        world_to_camera.expand(B, 4, 4).contiguous(),
        K.expand(B, 3, 3).contiguous(),
        camera.projection == "perspective", *camera.size, spp, filter, seed, vertex_spacing(scene),
        *counts, grad_seed, radiance_varies(scene), visibility,
    )  # fmt: skip


def as_scene(scene: Scene | Mesh) -> Scene:
    """Raises TypeError."""
    if isinstance(scene, Mesh):
        return Scene([scene])
    if not isinstance(scene, Scene):
        raise TypeError(f"scene: expected a Scene or a Mesh, got {type(scene).__name__}")
    return scene


def _check_devices(scene: Scene, camera: Camera) -> None:
    """Tensors may lie on any device that holds numbers. Raises ValueError."""
    fields = [*(field for mesh in scene.meshes for field in vars(mesh).items()), ("background", scene.background)]
    for name, value in [*fields, *vars(camera).items()]:
        if isinstance(value, Tensor):
            check_not_meta(name, value)


def radiance_varies(scene: Scene) -> bool:
    """Whether the radiance varies over a face; if not, moving it changes nothing inside."""
    return any(m.colors is not None or m.corner_colors is not None or m.texture is not None for m in scene.meshes)


def _check_seed(name: str, seed: object) -> int:
    number = as_int(name, seed)
    if not 0 <= number < 2**63:
        raise ValueError(f"{name}: expected an int from 0 to 2⁶³ − 1, got {number}")
    return number


def _derived_seed(seed: int, stream: int = 1) -> int:
    """Another seed for each stream: multiplication by an odd number is a bijection, so no two seeds meet."""
    return (seed * 0x5851F42D4C957F2D + stream * 0x14057B7EF767814F) & (2**63 - 1)


# -- operators -------------------------------------------------------------------------------------------------------

_SCENE = (
    "Tensor verts, Tensor faces, Tensor corners, Tensor colors, Tensor uvs, Tensor texels, Tensor textures, "
    "Tensor face_texture, Tensor background, Tensor world_to_camera, Tensor K"
)
_IMAGE = "bool perspective, int height, int width, int spp, str filter, int seed, float[] spacing"
_GRADIENT = "int surface_samples, int edge_samples, int grad_seed, bool interior_geometry, bool boundary"

torch.library.define("edgegrad::render", f"({_SCENE}, {_IMAGE}) -> (Tensor, Tensor, Tensor, Tensor, Tensor)")
torch.library.define(
    "edgegrad::render_backward",
    f"(Tensor adjoint, Tensor coverage, Tensor depth, Tensor hit, Tensor seen, {_SCENE}, {_IMAGE}, {_GRADIENT}, bool[] wanted)"
    " -> (Tensor, Tensor, Tensor, Tensor, Tensor, Tensor, Tensor)",
)


def _kernel_scene(flat: Flat, spacing: Sequence[float]):
    kind = core.SceneDouble if flat.colors.dtype == torch.float64 else core.SceneFloat
    background = flat.background if flat.background.dim() == 3 else flat.background[None, None]
    arrays = [t.detach().contiguous().numpy() for t in (*flat[:-1], background)]
    return kind(*arrays, list(spacing), torch.get_num_threads())


def _kernel_camera(world_to_camera: Tensor, K: Tensor, perspective: bool, height: int, width: int):
    return core.Camera(
        world_to_camera.detach().contiguous().numpy(), K.detach().contiguous().numpy(), perspective, width, height
    )


Profile = dict[str, float]


class View(NamedTuple):
    """What the image pass leaves to the backward pass, for B cameras."""

    coverage: Tensor  # (B, H, W): the filtered share of a pixel where something is hit
    depth: Tensor  # (B, H, W) float32: nothing that samples hit lies farther away; infinite if one hit nothing
    hit: Tensor  # (B, H, W, 2) int32: the first and the last of the faces that were hit; -1: none
    seen: Tensor  # (B, F) uint8: 0, or the side, 1 or 2, from which a face was hit


def forward_kernel(*args: Any) -> tuple[Tensor, View, list[Profile]]:
    """image (B, H, W, C), what the backward pass takes from it, and what the kernel did for each camera. Raises MemoryError."""
    with image_room(*args):
        return _forward_kernel(*args)


def _forward_kernel(*args: Any) -> tuple[Tensor, View, list[Profile]]:
    flat, (world_to_camera, K) = Flat(*args[:9]), args[9:11]
    perspective, height, width, spp, filter, seed, spacing = args[11:18]
    scene = _kernel_scene(flat, spacing)
    B, C = world_to_camera.shape[0], flat.background.shape[-1]
    image = flat.colors.new_empty((B, height, width, C))
    view = _empty_view(flat, B, height, width)
    profiles = []
    for b in range(B):
        camera = _kernel_camera(world_to_camera[b], K[b], perspective, height, width)
        camera_seed = seed if b == 0 else _derived_seed(seed, b + 1)
        outputs = image[b].numpy(), *(part[b].numpy() for part in view)
        profiles.append(scene.forward(camera, spp, filter, camera_seed, torch.get_num_threads(), *outputs))
    return image, view, profiles


def _empty_view(flat: Flat, B: int, height: int, width: int) -> View:
    return View(
        flat.colors.new_empty((B, height, width)),
        flat.colors.new_empty((B, height, width), dtype=torch.float32),
        flat.faces.new_empty((B, height, width, 2), dtype=torch.int32),
        flat.faces.new_empty((B, flat.faces.shape[0]), dtype=torch.uint8),
    )


@torch.library.impl("edgegrad::render", "CPU")
def _render_cpu(*args: Any) -> tuple[Tensor, ...]:
    image, view, _ = forward_kernel(*args)
    return image, *view


@torch.library.register_fake("edgegrad::render")
def _render_fake(*args: Any) -> tuple[Tensor, ...]:
    flat, world_to_camera, height, width = Flat(*args[:9]), args[9], args[12], args[13]
    B, C = world_to_camera.shape[0], flat.background.shape[-1]
    return flat.colors.new_empty((B, height, width, C)), *_empty_view(flat, B, height, width)


# The differentiable arguments, in the order of the gradients that render_backward returns.
DIFFERENTIABLE = (0, 3, 4, 5, 8, 9, 10)
DIFFERENTIABLE_NAMES = ("verts", "colors", "uvs", "texture", "background", "world_to_camera", "K")


def requires_grad(arguments: Sequence[Any]) -> list[bool]:
    """For each of `DIFFERENTIABLE` whether a backward pass will be asked for it: not at all under torch.no_grad()."""
    return [torch.is_grad_enabled() and arguments[i].requires_grad for i in DIFFERENTIABLE]


class Work(NamedTuple):
    """Which terms the backward pass runs: what the kernel is told, and what plan() tells."""

    motion: bool  # inside faces, of what moves them: vertices and camera
    appearance: bool  # inside faces, of colours, textures and texture coordinates
    boundary: bool  # at edges, of what moves them


def backward_work(interior_geometry: bool, boundary: bool, wanted: Sequence[bool]) -> Work:
    """From what render_backward is given."""
    verts, colors, uvs, texels, _, world_to_camera, K = wanted
    moves = verts or world_to_camera or K
    return Work(moves and interior_geometry, colors or uvs or texels, moves and boundary)


def image_room(*args: Any) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if the image does not fit. Takes the arguments of the operator."""
    flat, (B, height, width) = Flat(*args[:9]), (args[9].shape[0], *args[12:14])
    V, F, C, word = flat.verts.shape[0], flat.faces.shape[0], flat.background.shape[-1], flat.colors.element_size()
    needs = {
        "image": B * height * width * C * word,
        "coverage": B * height * width * word,
        "depth": B * height * width * 4,
        "faces hit": B * height * width * 8,
        "faces seen": B * F,
        "vertices in view": 24 * V,
    }
    return memory.room("render", needs, {"ray structure": memory.ray_structure(F, V)}, lambda: _lower(args))


def gradient_room(adjoint: Tensor, *args: Any) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if the gradients do not fit. Takes the arguments of the operator."""
    flat, (height, width), (surface_samples, edge_samples), wanted = Flat(*args[:9]), args[12:14], args[18:20], args[23]
    work = backward_work(*args[21:])
    V, F, C, many = flat.verts.shape[0], flat.faces.shape[0], flat.background.shape[-1], 1 << 62
    needs = {
        # In double, and then in the tensor's own type.
        f"{name} gradient": (8 + args[i].element_size() % 8) * args[i].numel() * want
        for name, i, want in zip(DIFFERENTIABLE_NAMES, DIFFERENTIABLE, wanted, strict=True)
    }
    needs["gradient by the image"] = adjoint.numel() * adjoint.element_size() * (not adjoint.is_contiguous())
    if any(work):
        needs["view"] = memory.view(height, width, V, work.motion or work.boundary)
    if work.motion or work.appearance:
        needs["faces in view"] = memory.surface_measure(
            F, V, height * width, flat.textures.shape[0] > 0, C * flat.colors.element_size(), work.motion
        )
        needs["controls"] = memory.rows(F, F, 3, 2, V) * work.motion
        needs["surface samples"] = surface_rows(many if surface_samples < 0 else surface_samples, args)
    if work.boundary:
        # Where all attributes are indexed like the vertices, curves are silhouettes: a quarter of a mesh that is tangled.
        jumps = flat.corners.data_ptr() != flat.faces.data_ptr()
        needs["edges in view"] = memory.edge_measure(F) + memory.curves_on_lines(memory.edges(F) // (1 if jumps else 4))
        needs["creases"] = memory.creases(V, height * width) * jumps
        needs["edge samples"] = memory.rows(many if edge_samples < 0 else edge_samples, memory.edges(F), 4, 3, V)
    kept = {"ray structure": memory.ray_structure(F, V), "topology": memory.topology(F) * work.boundary}
    return memory.room("backward pass", needs, kept, lambda: _lower(args) + ", or let fewer tensors require a gradient")


def surface_rows(samples: int, args: Sequence[Any]) -> int:
    """Bytes of what samples inside faces leave to be added up."""
    flat, wanted = Flat(*args[:9]), args[23]
    _, colors, uvs, texels, *_ = wanted
    F, C = flat.faces.shape[0], flat.background.shape[-1]
    total = memory.rows(samples, F, 3, 3, flat.verts.shape[0]) * backward_work(*args[21:]).motion
    # A face has a texture or colours: a run of samples leaves rows of one kind.
    if colors:
        total += memory.rows(samples, F, 3, C, flat.colors.shape[0])
    elif uvs:
        total += memory.rows(samples, F, 3, 2, flat.uvs.shape[0])
    return total + memory.rows(samples, None, 4, C, flat.texels.shape[0]) * texels


def _lower(args: Sequence[Any]) -> str:
    flat, (B, height, width) = Flat(*args[:9]), (len(args[9]), *args[12:14])
    return (
        f"the camera's size ({width} × {height} pixels), its batch ({B}), the channels ({flat.background.shape[-1]}) "
        f"or the faces ({len(flat.faces):,})"
    )


def backward_kernel(
    adjoint: Tensor, view: View, *args: Any, dry: bool = False
) -> tuple[list[Tensor | None], list[Profile]]:
    """The gradients of what is wanted, float64, and what the kernel did for each camera. `dry` only counts samples.

    `adjoint` is (B, H, W, C), or (H, W, C) for a single camera. Raises MemoryError.
    """
    with gradient_room(adjoint, *args):
        return _backward_kernel(adjoint, view, *args, dry=dry)


def _backward_kernel(adjoint: Tensor, view: View, *args: Any, dry: bool) -> tuple[list[Tensor | None], list[Profile]]:
    flat, (world_to_camera, K) = Flat(*args[:9]), args[9:11]
    perspective, height, width, spp, filter, _, spacing = args[11:18]
    surface_samples, edge_samples, grad_seed, interior_geometry, boundary, wanted = args[18:]
    work = backward_work(interior_geometry, boundary, wanted)
    scene = _kernel_scene(flat, spacing)
    # Sums are taken in double whatever the arrays hold. NumPy has its zeros from the system, torch would wake all threads.
    grads = [
        torch.from_numpy(np.zeros(args[i].shape)) if want else None
        for i, want in zip(DIFFERENTIABLE, wanted, strict=True)
    ]
    verts, colors, uvs, texels, background, gw2c, gK = (None if g is None else g.numpy() for g in grads)
    if background is not None and background.ndim == 1:
        background = background[None, None]
    adjoint = adjoint.detach().contiguous()
    images = adjoint if adjoint.dim() == 4 else adjoint[None]
    try:
        profiles = [
            scene.backward(
                _kernel_camera(world_to_camera[b], K[b], perspective, height, width),
                spp, surface_samples, edge_samples, filter, grad_seed if b == 0 else _derived_seed(grad_seed, b + 1),
                torch.get_num_threads(), work.motion, work.boundary, dry, images[b].numpy(),
                *(part[b].numpy() for part in view), verts, colors, uvs, texels, background,
                None if gw2c is None else gw2c[b], None if gK is None else gK[b],
            )
            for b in range(world_to_camera.shape[0])
        ]  # fmt: skip
    except ValueError:
        check_finite(
            "the gradient of the image", adjoint
        )  # as the kernel does, but here with the index that the user knows
        raise
    return grads, profiles


@torch.library.impl("edgegrad::render_backward", "CPU")
def _render_backward_cpu(*args: Any) -> tuple[Tensor, ...]:
    adjoint, coverage, depth, hit, seen, *inputs = args
    return tuple(
        adjoint.new_empty(0, dtype=torch.float32) if g is None else g.to(inputs[i].dtype)
        for i, g in zip(
            DIFFERENTIABLE, backward_kernel(adjoint, View(coverage, depth, hit, seen), *inputs)[0], strict=True
        )
    )


@torch.library.register_fake("edgegrad::render_backward")
def _render_backward_fake(
    adjoint: Tensor, coverage: Tensor, depth: Tensor, hit: Tensor, seen: Tensor, *args: Any
) -> tuple[Tensor, ...]:
    return tuple(
        torch.empty_like(args[i]) if want else adjoint.new_empty(0, dtype=torch.float32)
        for i, want in zip(DIFFERENTIABLE, args[-1], strict=True)
    )


FIRST_ORDER = (
    "second derivatives of a rendered image are not available (its gradient is an estimate whose own derivative is not "
    "computed); for curvature use Gauss-Newton, JᵀJ from backward passes over the image, as edgegrad.fit.fit_pose does"
)
REVERSE = (
    "forward-mode derivatives (jvp, jacfwd, hessian) of a rendered image are not available; "
    "use reverse mode: backward(), torch.func.grad, vjp or jacrev"
)


class _Render(torch.autograd.Function):
    """edgegrad::render, differentiated by edgegrad::render_backward. The image of a single camera loses its batch axis."""

    @staticmethod
    def forward(batched: bool, *args: Any) -> tuple[Tensor, ...]:
        image, *view = torch.ops.edgegrad.render(*args[:18])
        return image if batched else image.squeeze(0), *view

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        _, *view = output
        ctx.mark_non_differentiable(*view)
        ctx.save_for_backward(*view, *inputs[1:12])
        ctx.options = inputs[12:]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        coverage, depth, hit, seen, *tensors = ctx.saved_tensors
        wanted = [ctx.needs_input_grad[1 + i] for i in DIFFERENTIABLE]
        arguments = (grad_outputs[0], coverage, depth, hit, seen, *tensors, *ctx.options)
        if torch.compiler.is_compiling():  # which refuses second derivatives itself
            grads = torch.ops.edgegrad.render_backward(*arguments, wanted)
        else:
            grads = _RenderBackward.apply(*arguments, *wanted)
        out: list[Tensor | None] = [None] * (1 + len(tensors) + len(ctx.options))
        for i, want, grad in zip(DIFFERENTIABLE, wanted, grads, strict=True):
            if want:
                out[1 + i] = grad
        return tuple(out)


class _RenderEager(_Render):
    """_Render with what torch.compile does not trace: inference tensors, and the transforms of torch.func."""

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        # A tensor that was made in torch.inference_mode() cannot be kept for later, but a copy of it can.
        later = not torch.is_inference_mode_enabled()
        kept = (a.clone() if later and isinstance(a, Tensor) and a.is_inference() else a for a in inputs)
        _Render.setup_context(ctx, tuple(kept), output)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return _one_by_one(_RenderEager, info.batch_size, in_dims, args)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(REVERSE)


class _RenderBackward(torch.autograd.Function):
    """edgegrad::render_backward. A function of its own, so that whoever asks for its derivative hears that there is none:
    once_differentiable takes it for zero where the adjoint is a constant, as it is for a loss linear in the image."""

    @staticmethod
    def forward(*args: Any) -> tuple[Tensor, ...]:
        many = len(DIFFERENTIABLE)
        return torch.ops.edgegrad.render_backward(*args[:-many], list(args[-many:]))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, ...]) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
        return _one_by_one(_RenderBackward, info.batch_size, in_dims, args)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise RuntimeError(FIRST_ORDER)


def _one_by_one(
    function: type[torch.autograd.Function], count: int, in_dims: tuple[int | None, ...], args: tuple[Any, ...]
) -> tuple[tuple[Tensor, ...], tuple[int, ...]]:
    """torch.vmap of a function with several outputs: call by call. What is no tensor has no batch axis."""
    results = [
        function.apply(*(a.select(dim, i) if isinstance(dim, int) else a for a, dim in zip(args, in_dims, strict=True)))
        for i in range(count)
    ]
    outputs = tuple(torch.stack(parts) for parts in zip(*results, strict=True))
    return outputs, (0,) * len(outputs)
