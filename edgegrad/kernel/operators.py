"""The kernel's passes, whether they fit into memory, and the operators of torch that run them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ..check import check_finite
from ..library import core
from ..sampling import camera_seed
from ..scene.scene import Scene
from ..warnings import warn
from . import memory as memory
from .flat import Flat
from .request import PER_CAMERA, SCHEMA, SLOTS, PackedCamera, Request, WantedTerms, label
from .threads import threads

Profile = dict[str, float]


class HitBuffers(NamedTuple):
    """Hits of the image pass of B cameras, for the backward pass."""

    coverage: Tensor  # (B, H, W): the filtered share of a pixel where something is hit
    depth: Tensor  # (B, H, W) float32: nothing that samples hit lies farther away; infinite if one hit nothing
    hit: Tensor  # (B, H, W, 2) int32: the first and the last of the faces that were hit; -1: none
    seen: Tensor  # (B, F) uint8: 0, or the side, 1 or 2, from which a face was hit

    @classmethod
    def empty(cls, request: Request) -> HitBuffers:
        B, height, width = request.cameras, request.camera.height, request.camera.width
        flat = request.scene
        return cls(
            flat.colors.new_empty((B, height, width)),
            flat.colors.new_empty((B, height, width), dtype=torch.float32),
            flat.faces.new_empty((B, height, width, 2), dtype=torch.int32),
            flat.faces.new_empty((B, flat.faces.shape[0]), dtype=torch.uint8),
        )


# -- the kernel ---------------------------------------------------------------------------------------------------------


def kernel_scene(scene: Flat) -> Any:
    kind = core.SceneDouble if scene.colors.dtype == torch.float64 else core.SceneFloat
    background = scene.background if scene.background.dim() == 3 else scene.background[None, None]
    arrays = scene._replace(background=background)._asdict()
    arrays = {name: _array(value) if isinstance(value, Tensor) else value for name, value in arrays.items()}
    return kind(**arrays, threads=threads())


def kernel_camera(camera: PackedCamera, index: int = 0, by_distortion: bool = True) -> Any:
    """One camera of a batch. Without derivatives `by_distortion` the kernel takes a lens that distorts nothing for a pinhole."""
    arrays = {n: _array(v[index]) if isinstance(v, Tensor) else v for n, v in camera._asdict().items()}
    return core.Camera(**arrays, by_distortion=by_distortion)


def kernel_channels(request: Request, index: int = 0) -> Any:
    arrays = request.auxiliary._replace(vertex_attributes=request.auxiliary.vertex_attributes[index])._asdict()
    return core.Channels(
        **{name: _array(value) if isinstance(value, Tensor) else value for name, value in arrays.items()}
    )


def warn_of_ends(cameras: Sequence[Any]) -> None:
    """Once for a batch, of the lens that shows least."""
    ends = [camera.end for camera in cameras if camera.end is not None]
    if not ends:
        return
    angle = min(ends)
    radius = f"the radius {math.tan(angle):.4g} in normalised image coordinates, " if angle < math.pi / 2 else ""
    warn(
        "where a lens ends",
        f"distortion: the lens shows nothing beyond {radius}{math.degrees(angle):.4g}° from its axis, where it folds the image "
        "over or ends; what the image has there is background",
    )


def kernel_hits(hits: HitBuffers, index: int = 0) -> Any:
    kind = core.HitsDouble if hits.coverage.dtype == torch.float64 else core.HitsFloat
    return kind(**{name: part[index].numpy() for name, part in hits._asdict().items()})


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


def forward_kernel(request: Request) -> tuple[Tensor, HitBuffers, list[Profile]]:
    """image (B, H, W, C), what the backward pass takes from it, and what the kernel did for each camera. Raises MemoryError."""
    with image_memory(request):
        scene = kernel_scene(request.scene)
        B, height, width = request.cameras, request.camera.height, request.camera.width
        image = request.scene.colors.new_empty((B, height, width, request.channels))
        hits = HitBuffers.empty(request)
        cameras = [kernel_camera(request.camera, b, by_distortion=False) for b in range(B)]
        warn_of_ends(cameras)
        profiles = []
        for b in range(B):
            profiles.append(
                scene.forward(
                    camera=cameras[b],
                    channels=kernel_channels(request, b),
                    options=request.image.for_kernel(b),
                    threads=threads(),
                    image=image[b].numpy(),
                    hits=kernel_hits(hits, b),
                )
            )
        return image, hits, profiles


def backward_kernel(
    adjoint: Tensor,
    hits: HitBuffers,
    request: Request,
    wanted: Collection[str],
    *,
    dry: bool = False,
    lit: Scene | None = None,
    indirect: bool = False,
) -> tuple[dict[str, Tensor], list[Profile]]:
    """Return the gradients of the slots that are wanted, float64, and what the kernel did for each camera. `dry` only counts
    samples, as for a scene that is `lit`, whose textures the request does not hold, and whose surfaces light each other if
    `indirect`.

    `adjoint` is (B, H, W, C), or (H, W, C) for a single camera. Raises MemoryError.
    """
    with gradient_memory(adjoint, request, wanted):
        scene, image = kernel_scene(request.scene), request.image.for_kernel()
        # Sums are taken in double whatever the arrays hold. NumPy has its zeros from the system, torch would wake all threads.
        grads = {name: np.zeros(request.slot(name).shape) for name in SLOTS if name in wanted}
        images = adjoint.detach().contiguous()
        images = images if images.dim() == 4 else images[None]
        try:
            profiles = [
                scene.backward(
                    camera=kernel_camera(request.camera, b, "distortion" in wanted),
                    channels=kernel_channels(request, b),
                    image=image,
                    options=_gradient_options(request, wanted, b, dry, lit is not None, indirect),
                    threads=threads(),
                    adjoint=images[b].numpy(),
                    hits=kernel_hits(hits, b),
                    # Each camera has a gradient of its own.
                    gradients={n: g[b] if n in PER_CAMERA else g for n, g in grads.items()},
                    detailed=faces_with_textures(lit),
                )
                for b in range(request.cameras)
            ]
        except ValueError:
            # As the kernel does, but here with the index that the user knows.
            check_finite("the gradient of the image", adjoint)
            raise
        return {name: torch.from_numpy(grad) for name, grad in grads.items()}, profiles


def jvp_kernel(hits: HitBuffers, request: Request, tangents: Mapping[str, Tensor], directions: int) -> Tensor:
    """Derivatives (D, B, H, W, C) of the image in D directions, in the type of the image: `tangents` (D, …) by slot, zero
    where there is none. Raises MemoryError."""
    with derivatives_memory(request, tangents, directions):
        scene, image = kernel_scene(request.scene), request.image.for_kernel()
        given = {name: np.ascontiguousarray(t.detach().double().numpy()) for name, t in tangents.items()}
        adjoint = _channel_weights(request).expand(request.camera.height, request.camera.width, -1).contiguous()
        out = np.zeros((request.cameras, *adjoint.shape[:2], directions, request.channels))
        for b in range(request.cameras):
            scene.jvp(
                camera=kernel_camera(request.camera, b, "distortion" in tangents),
                channels=kernel_channels(request, b),
                image=image,
                options=_gradient_options(request, tangents, b),
                threads=threads(),
                adjoint=adjoint.numpy(),
                hits=kernel_hits(hits, b),
                tangents=[
                    {name: t[d, b] if name in PER_CAMERA else t[d] for name, t in given.items()}
                    for d in range(directions)
                ],
                image_dot=out[b],
            )
        return torch.from_numpy(out).permute(3, 0, 1, 2, 4).to(request.scene.colors.dtype).contiguous()


def _channel_weights(request: Request) -> Tensor:
    """Return how much each channel matters (C,) for where samples of a derivative of all of them go: as much as any other,
    whatever its unit."""
    weights = request.scene.colors.new_ones(request.channels)
    values = request.auxiliary.vertex_attributes.detach()
    first = request.scene.colors.shape[1] + request.auxiliary.alpha
    size = values.abs().mean((0, 1)).to(weights)
    weights[first : first + len(size)] = torch.where(size > 0, 1.0 / size, 1.0)
    return weights


def screen_gradient_kernel(adjoint: Tensor, hits: HitBuffers, request: Request) -> Tensor:
    """Return how the loss changes as what is seen in a pixel moves right and down: (B, H, W, 2). Raises MemoryError."""
    with derivatives_memory(request, ["verts"], 1):
        scene, image = kernel_scene(request.scene), request.image.for_kernel()
        out = np.zeros((*adjoint.shape[:3], 2))
        for b in range(request.cameras):
            scene.screen_gradient(
                camera=kernel_camera(request.camera, b, by_distortion=False),
                channels=kernel_channels(request, b),
                image=image,
                options=_gradient_options(request, ["verts"], b),
                threads=threads(),
                adjoint=adjoint[b].numpy(),
                hits=kernel_hits(hits, b),
                gradient=out[b],
            )
        return torch.from_numpy(out).to(adjoint.dtype)


def _gradient_options(
    request: Request,
    wanted: Collection[str],
    camera: int,
    dry: bool = False,
    lit: bool = False,
    indirect: bool = False,
) -> Any:
    options, terms = request.gradient, WantedTerms.from_request(request, wanted)
    return core.GradientOptions(
        seed=camera_seed(int(options.grad_seed), camera),
        surface_samples=options.surface_samples,
        edge_samples=options.edge_samples,
        interior_geometry=terms.motion,
        boundary=terms.boundary,
        discontinuities=terms.discontinuities,
        discontinuity_spacing=options.discontinuity_spacing,
        lit=lit,
        indirect=indirect,
        dry=dry,
    )


def faces_with_textures(lit: Scene | None) -> np.ndarray | None:
    """Return which faces have a texture (F,) uint8, or None if none has one or the scene is not lit."""
    textured = None if lit is None else lit.textured_faces
    return None if textured is None else textured.numpy()


# -- memory -------------------------------------------------------------------------------------------------------------


def _sides(camera: PackedCamera) -> int:
    """Return the largest number of pinholes that one of the cameras is made of."""
    if camera.lens not in ("fisheye", "panorama"):
        return 1
    return max(kernel_camera(camera, b).sides for b in range(len(camera.K)))


def pass_size(request: Request) -> Any:
    """Return the sizes of tensors with values on which the memory of the kernel depends."""
    flat, camera, auxiliary = request.scene, request.camera, request.auxiliary
    by_vertex = flat.corners is flat.faces or flat.corners.data_ptr() == flat.faces.data_ptr()
    jumps = not by_vertex or auxiliary.barycentrics or auxiliary.face_attributes.shape[-1] > 0
    return core.PassSize(
        verts=len(flat.verts),
        faces=len(flat.faces),
        colors=len(flat.colors),
        uvs=len(flat.uvs),
        texels=len(flat.texels),
        alphas=len(flat.alphas),
        pixels=camera.height * camera.width,
        radiance=flat.colors.shape[1],
        vertex_attributes=auxiliary.vertex_attributes.shape[-1],
        face_attributes=auxiliary.face_attributes.shape[-1],
        channels=request.channels,
        number=flat.colors.element_size(),
        textured=len(flat.textures) > 0,
        jumps=jumps,
        threads=threads(),
        sides=_sides(camera),
    )


def image_memory(request: Request) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if the image does not fit."""
    needs = core.image_bytes(pass_size(request), request.cameras)
    return memory.room("render", needs, lambda: lower(request))


def gradient_memory(adjoint: Tensor, request: Request, wanted: Collection[str]) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if the gradients do not fit."""
    terms, options = WantedTerms.from_request(request, wanted), request.gradient
    needs = {}
    for name in SLOTS:
        if name in wanted:
            tensor = request.slot(name)  # in double, and then in the tensor's own type
            needs[f"{label(name)} gradient"] = (8 + tensor.element_size() % 8) * tensor.numel()
    needs["gradient by the image"] = adjoint.numel() * adjoint.element_size() * (not adjoint.is_contiguous())
    needs |= core.gradient_bytes(
        pass_size(request),
        motion=terms.motion,
        boundary=terms.boundary,
        discontinuities=terms.discontinuities,
        wanted=list(wanted),
        surface_samples=options.surface_samples,
        edge_samples=options.edge_samples,
    )
    return memory.room("backward pass", needs, lambda: lower(request) + ", or let fewer tensors require a gradient")


def derivatives_memory(request: Request, wanted: Collection[str], directions: int) -> AbstractContextManager[None]:
    """Raises MemoryError before its block if derivatives in so many directions do not fit."""
    terms, options, size = WantedTerms.from_request(request, wanted), request.gradient, pass_size(request)
    width = directions * request.channels
    needs = core.gradient_bytes(
        size,
        motion=terms.motion,
        boundary=terms.boundary,
        discontinuities=terms.discontinuities,
        wanted=[],
        surface_samples=0,
        edge_samples=0,
    )
    needs["derivatives"] = 2 * 8 * request.cameras * request.camera.height * request.camera.width * width
    samples = max(options.surface_samples, options.edge_samples)
    needs["samples in pixels"] = core.pixel_row_bytes(size, samples=samples, width=width)
    needs["tangents"] = sum(8 * directions * request.slot(name).numel() for name in wanted)
    return memory.room("jvp", needs, lambda: lower(request) + ", or ask for fewer directions at a time")


def lower(request: Request) -> str:
    camera = request.camera
    return (
        f"the camera's size ({camera.width} × {camera.height} pixels), its batch ({request.cameras}), "
        f"the channels ({request.channels}) or the faces ({len(request.scene.faces):,})"
    )


# -- operators ----------------------------------------------------------------------------------------------------------

torch.library.define("edgegrad::render", f"({SCHEMA}) -> (Tensor, Tensor, Tensor, Tensor, Tensor)")
torch.library.define(
    "edgegrad::render_backward",
    f"(Tensor adjoint, Tensor coverage, Tensor depth, Tensor hit, Tensor seen, {SCHEMA}, bool[] wanted) -> ("
    + ", ".join("Tensor" for _ in SLOTS)
    + ")",
)


# Which face is seen through the centre of each pixel, (B, H, W) int32; −1: none.
torch.library.define("edgegrad::faces_at_centers", f"({SCHEMA}) -> Tensor")
torch.library.define(
    "edgegrad::render_jvp",
    f"(Tensor coverage, Tensor depth, Tensor hit, Tensor seen, {SCHEMA}, Tensor?[] tangents, SymInt directions) -> Tensor",
)


@torch.library.impl("edgegrad::render", "CPU")
def _render_cpu(*args: Any) -> tuple[Tensor, ...]:
    image, hits, _ = forward_kernel(Request.unpack(args))
    return image, *hits


@torch.library.register_fake("edgegrad::render")
def _render_fake(*args: Any) -> tuple[Tensor, ...]:
    request = Request.unpack(args)
    size = request.cameras, request.camera.height, request.camera.width, request.channels
    return request.scene.colors.new_empty(size), *HitBuffers.empty(request)


@torch.library.impl("edgegrad::faces_at_centers", "CPU")
def _faces_at_centers_cpu(*args: Any) -> Tensor:
    request = Request.unpack(args)
    with image_memory(request):
        scene = kernel_scene(request.scene)
        faces = _faces_at_centers_fake(*args)
        for b in range(request.cameras):
            scene.faces_at_centers(
                camera=kernel_camera(request.camera, b, by_distortion=False),
                channels=kernel_channels(request, b),
                threads=threads(),
                face=faces[b].numpy(),
            )
        return faces


@torch.library.register_fake("edgegrad::faces_at_centers")
def _faces_at_centers_fake(*args: Any) -> Tensor:
    request = Request.unpack(args)
    return request.scene.faces.new_empty(request.cameras, request.camera.height, request.camera.width)


def _arguments(args: Sequence[Any]) -> tuple[Tensor, HitBuffers, Request, list[bool]]:
    """Return the arguments of edgegrad::render_backward: adjoint, hits, request, and which gradients are wanted."""
    adjoint, coverage, depth, hit, seen, *packed, wanted = args
    return adjoint, HitBuffers(coverage, depth, hit, seen), Request.unpack(packed), wanted


@torch.library.impl("edgegrad::render_backward", "CPU")
def _render_backward_cpu(*args: Any) -> tuple[Tensor, ...]:
    adjoint, hits, request, flags = _arguments(args)
    wanted = [name for name, want in zip(SLOTS, flags, strict=True) if want]
    grads, _ = backward_kernel(adjoint, hits, request, wanted)
    return tuple(grads[name].to(request.slot(name).dtype) if name in grads else _nothing(adjoint) for name in SLOTS)


@torch.library.register_fake("edgegrad::render_backward")
def _render_backward_fake(*args: Any) -> tuple[Tensor, ...]:
    adjoint, _, request, flags = _arguments(args)
    return tuple(
        torch.empty_like(request.slot(name)) if want else _nothing(adjoint)
        for name, want in zip(SLOTS, flags, strict=True)
    )


@torch.library.impl("edgegrad::render_jvp", "CPU")
def _render_jvp_cpu(*args: Any) -> Tensor:
    coverage, depth, hit, seen, *packed, tangents, directions = args
    given = {name: tangent for name, tangent in zip(SLOTS, tangents, strict=True) if tangent is not None}
    return jvp_kernel(HitBuffers(coverage, depth, hit, seen), Request.unpack(packed), given, directions)


@torch.library.register_fake("edgegrad::render_jvp")
def _render_jvp_fake(*args: Any) -> Tensor:
    _, _, _, _, *packed, _, directions = args
    request = Request.unpack(packed)
    size = directions, request.cameras, request.camera.height, request.camera.width, request.channels
    return request.scene.colors.new_empty(size)


def _nothing(adjoint: Tensor) -> Tensor:
    """Return an empty tensor: the gradient of an operator that is not wanted."""
    return adjoint.new_empty(0, dtype=torch.float32)
