"""Requests for a render: records of tensors and numbers. Operators of torch take flat arguments of a few types. Here alone
records are packed into them and unpacked again, by the names of their fields.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple, get_type_hints

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..camera.convention_warnings import warn_if_behind
from ..camera.lens import MOST_COEFFICIENTS
from ..check import check_not_meta, check_positive_int, check_shape
from ..library import core
from ..sampling import Sampling, camera_seed, check_sampling, derived_seed, drawn_seed
from ..scene.mesh import Mesh
from ..scene.scene import Scene, as_scene
from .flat import Flat, flatten

FILTERS = ("box", "tent", "gaussian")


class PackedCamera(NamedTuple):
    """B cameras as the kernel reads them."""

    world_to_camera: Tensor  # (B, 4, 4) float64
    K: Tensor  # (B, 3, 3) float64
    distortion: Tensor  # (B, 8) float64, zeros after the coefficients that there are
    perspective: bool
    lens: str
    height: int
    width: int


class Channels(NamedTuple):
    """Channels of the image after its radiance, in this order (csrc/shading/attributes.h)."""

    alpha: bool  # 1 wherever a face is seen
    vertex_attributes: Tensor  # (B, V, n) float64, interpolated over the faces
    unit: int  # the first of three of these that are a direction, given the length 1 once interpolated; −1: none
    face_attributes: Tensor  # (F, m) float64, of whole faces
    barycentrics: bool  # 3 channels
    uv: bool  # 2 channels; all faces have texture coordinates


class ImageOptions(NamedTuple):
    spp: int
    filter: str
    seed: Tensor  # () int64: a tensor, so that torch.compile and torch.vmap may draw it

    def for_kernel(self, camera: int = 0) -> Any:
        """Return the kernel's options of the image of a camera of the batch."""
        return core.ImageOptions(self.spp, self.filter, camera_seed(int(self.seed), camera))


class GradientOptions(NamedTuple):
    surface_samples: int  # −1: the default
    edge_samples: int  # −1: the default
    grad_seed: Tensor  # () int64
    channels_vary: bool  # over a face; if not, moving it changes nothing inside
    visibility: bool  # whether what moves at silhouettes and other jumps counts
    discontinuity_spacing: float  # px between the lines along which discontinuities are looked for


class Request(NamedTuple):
    """All that an image and its gradient depend on."""

    scene: Flat
    camera: PackedCamera
    auxiliary: Channels
    image: ImageOptions
    gradient: GradientOptions

    def pack(self) -> tuple[Any, ...]:
        return (*self.scene, *self.camera, *self.auxiliary, *self.image, *self.gradient)

    @classmethod
    def unpack(cls, values: Sequence[Any]) -> Request:
        records, first = [], 0
        for record in RECORDS:
            end = first + len(record._fields)
            records.append(record(*values[first:end]))
            first = end
        return cls(*records)

    @property
    def cameras(self) -> int:
        return self.camera.world_to_camera.shape[0]

    @property
    def channels(self) -> int:
        return self.scene.background.shape[-1]

    def slot(self, name: str) -> Tensor:
        """Return the tensor of a gradient slot."""
        return getattr(self[_RECORD_OF[name]], name)


RECORDS: tuple[Any, ...] = (Flat, PackedCamera, Channels, ImageOptions, GradientOptions)
FIELDS = tuple(field for record in RECORDS for field in record._fields)
_TYPES = tuple(get_type_hints(record)[field] for record in RECORDS for field in record._fields)
_RECORD_OF = {field: place for place, record in enumerate(RECORDS) for field in record._fields}
IS_TENSOR = tuple(kind is Tensor for kind in _TYPES)
_NAMES = {Tensor: "Tensor", bool: "bool", int: "SymInt", float: "float", str: "str", list[float]: "float[]"}
# The arguments of the operators. A SymInt may stay symbolic under torch.compile, an int would compile once for each value.
SCHEMA = ", ".join(f"{_NAMES[kind]} {field}" for field, kind in zip(FIELDS, _TYPES, strict=True))

# The parameters that may have a gradient, from the kernel's table (csrc/accumulate/gradients.h), and their places among the
# packed values.
SLOTS: tuple[str, ...] = core.GRADIENT_SLOTS
POSITIONS = tuple(FIELDS.index(name) for name in SLOTS)
_LABELS = {"texels": "texture", "alphas": "alpha"}
PER_CAMERA = (*PackedCamera._fields, "vertex_attributes")  # slots with a row for each camera
MOVING = ("verts", *(name for name in SLOTS if name in PackedCamera._fields))  # slots that move the image
APPEARANCE = ("colors", "uvs", "texels", "vertex_attributes", "face_attributes")
DISCONTINUITY_SLOTS = (*MOVING, "uvs", "alphas")  # slots that move alpha edges and texel edges


def label(slot: str) -> str:
    """Return the user's name of a slot."""
    return _LABELS.get(slot, slot)


def tensors_of(packed: Sequence[Any]) -> list[Tensor]:
    return [value for value, is_tensor in zip(packed, IS_TENSOR, strict=True) if is_tensor]


def others_of(packed: Sequence[Any]) -> list[Any]:
    return [value for value, is_tensor in zip(packed, IS_TENSOR, strict=True) if not is_tensor]


def join(tensors: Sequence[Tensor], others: Sequence[Any]) -> list[Any]:
    """Return the packed values of tensors_of() and others_of()."""
    packed, t, o = [], 0, 0
    for is_tensor in IS_TENSOR:
        packed.append(tensors[t] if is_tensor else others[o])
        t, o = t + is_tensor, o + (not is_tensor)
    return packed


def required(request: Request) -> tuple[str, ...]:
    """Return the slots that a backward pass will be asked for: none under torch.no_grad()."""
    return tuple(name for name in SLOTS if torch.is_grad_enabled() and request.slot(name).requires_grad)


class WantedTerms(NamedTuple):
    """Which terms the backward pass runs: what the kernel is told, and what plan() tells."""

    motion: bool  # inside faces, of what moves them: vertices and camera
    appearance: bool  # inside faces, of colours, textures and texture coordinates
    boundary: bool  # at edges, of what moves them
    discontinuities: bool  # within faces: at alpha edges and texel edges

    @classmethod
    def from_request(cls, request: Request, wanted: Collection[str]) -> WantedTerms:
        options = request.gradient
        moves = any(name in wanted for name in MOVING)
        appearance = any(name in wanted for name in APPEARANCE)
        discontinuities = request.scene.has_discontinuities and any(name in wanted for name in DISCONTINUITY_SLOTS)
        return cls(
            moves and options.channels_vary,
            appearance,
            moves and options.visibility,
            discontinuities and options.visibility,
        )


# -- from what the user gives -------------------------------------------------------------------------------------------


def check_camera(camera: object) -> None:
    """Raise TypeError for what is no camera."""
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}; make one with Camera.look_at(…)")


def make_request(
    scene: Scene | Mesh,
    camera: Camera,
    spp: int = 16,
    seed: int | Tensor | None = None,
    *,
    filter: str = "box",
    visibility: bool = True,
    sampling: Sampling | None = None,
    generator: torch.Generator | None = None,
    all_uvs: bool = False,
) -> Request:
    """Return the arguments of render(), checked; and whether texture coordinates that nothing needs are taken along. Raises
    TypeError or ValueError."""
    scene = as_scene(scene)
    check_camera(camera)
    spp = check_positive_int("spp", spp, most=1 << 20)
    sampling = check_sampling(sampling)
    if not isinstance(visibility, bool):
        raise TypeError(f"visibility: expected True or False, got {type(visibility).__name__} ({visibility!r})")
    if filter not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {filter!r}")
    if scene.background is not None and scene.background.dim() == 3:
        check_shape("background", scene.background, (*camera.size, "C"), fix="give it the camera's size")
    _check_devices(scene, camera)
    image_seed = drawn_seed(seed, generator)
    grad_seed = derived_seed(image_seed) if sampling.seed is None else torch.tensor(sampling.seed, device="cpu")

    flat = flatten(scene, all_uvs)
    if torch.compiler.is_compiling():
        # Dynamo does not trace a function that is given one tensor twice; corners of vertex colours are the faces.
        flat = flat._replace(corners=flat.corners.clone())
    packed = pack_camera(camera)
    if packed.perspective and packed.lens in ("pinhole", "brown-conrady"):  # others see what lies there
        warn_if_behind(flat.verts, packed.world_to_camera)
    cameras, V, F = len(packed.K), len(flat.verts), len(flat.faces)
    return Request(
        flat,
        packed,
        Channels(False, flat.verts.new_empty((cameras, V, 0)), -1, flat.verts.new_empty((F, 0)), False, False),
        ImageOptions(spp, filter, image_seed),
        GradientOptions(
            -1 if sampling.surface is None else sampling.surface,
            -1 if sampling.edges is None else sampling.edges,
            grad_seed,
            _radiance_varies(scene),
            visibility,
            sampling.discontinuity_spacing,
        ),
    )


def pack_camera(camera: Camera) -> PackedCamera:
    world_to_camera = camera.world_to_camera.cpu().double().reshape(-1, 4, 4)
    K = camera.K.cpu().double().reshape(-1, 3, 3)
    distortion = camera.coefficients.cpu().double()
    distortion = torch.nn.functional.pad(distortion, (0, MOST_COEFFICIENTS - distortion.shape[-1])).reshape(
        -1, MOST_COEFFICIENTS
    )
    B = max(world_to_camera.shape[0], K.shape[0], distortion.shape[0])
    return PackedCamera(
        world_to_camera.expand(B, 4, 4).contiguous(),
        K.expand(B, 3, 3).contiguous(),
        distortion.expand(B, MOST_COEFFICIENTS).contiguous(),
        camera.projection != "orthographic",
        camera.lens,
        *camera.size,
    )


def _check_devices(scene: Scene, camera: Camera) -> None:
    """Tensors may lie on any device that holds numbers. Raises ValueError."""
    materials = [mesh.material for mesh in scene.meshes if mesh.material is not None]
    textures = [texture for material in materials for texture in material.textures.values()]
    for thing in (*scene.meshes, *materials, *textures, scene, *scene.lights, camera):
        # Not vars(), at which torch.compile stops in torch 2.9 and before. Each light is a dataclass, though Light is none.
        for field in dataclasses.fields(thing):  # pyright: ignore[reportArgumentType]
            if isinstance(value := getattr(thing, field.name), Tensor):
                check_not_meta(field.name, value)


def _radiance_varies(scene: Scene) -> bool:
    return any(
        m.colors is not None or m.corner_colors is not None or (m.texture is not None and m.filter != "nearest")
        for m in scene.meshes
    )
