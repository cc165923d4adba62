"""Materials: how surfaces scatter light and what they emit, as numbers, numbers of vertices, or textures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..check import as_tensor, check_fields, check_finite, check_float, check_indices, check_integer, check_shape
from ..library import core
from .rows import areas, unit

WRAPS: tuple[str, ...] = core.WRAPS  # repeat, clamp, mirror
LOOKUPS = ("linear", "nearest", "mipmap")
ALPHA_MODES = ("OPAQUE", "MASK", "BLEND")
LARGEST_UV = 1e9


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on the faces of a mesh, whose tensors may all require gradients.

    image     (h, w, K) float   row 0 on top, texel centres at +0.5
    uvs       (T, 2) float      texture coordinates of its own, v running up; those of the mesh when None
    uv_faces  (F, 3) int        indices into uvs; given with uvs
    wrap      what lies beyond the rim: "repeat", "clamp" or "mirror", or a pair of these for u and v
    filter    "linear" between texel centres; "nearest", the texel that the point lies in; "mipmap", means over squares of 2, 4,
              8 … texels, so that neighbouring pixels are about a texel apart, linear between two such levels (Williams 1983).
              Beyond the rim "clamp" goes on with the rim of such means, as GPUs do: where many texels fall on a pixel, with a
              mean of the border and of what lies within, at last of the whole image
    factor    a number or (K,)  what the image is multiplied by, as glTF has it

    Raises TypeError or ValueError that names the argument.
    """

    image: Tensor
    uvs: Tensor | None = None
    uv_faces: Tensor | None = None
    wrap: str | tuple[str, str] = "repeat"
    filter: str = "linear"
    factor: Tensor | float | None = None

    def __post_init__(self) -> None:
        self._keep("image", as_tensor("image", self.image, floating=True))
        check_float("image", self.image)
        check_shape("image", self.image, ("h", "w", "K"))
        check_finite("image", self.image)
        if (self.uvs is None) != (self.uv_faces is None):
            missing = "uvs" if self.uvs is None else "uv_faces"
            raise ValueError(f"{missing}: expected both uvs and uv_faces, or none of them, got None; pass it too")
        if self.uvs is not None and self.uv_faces is not None:
            self._keep("uvs", as_tensor("uvs", self.uvs, floating=True))
            check_float("uvs", self.uvs)
            check_shape("uvs", self.uvs, ("T", 2))
            check_finite("uvs", self.uvs, largest=LARGEST_UV)
            self._keep("uv_faces", as_tensor("uv_faces", self.uv_faces))
            check_integer("uv_faces", self.uv_faces)
            check_shape("uv_faces", self.uv_faces, ("F", 3))
            check_indices("uv_faces", self.uv_faces, len(self.uvs), "uvs")
        if isinstance(self.wrap, list):
            self._keep("wrap", tuple(self.wrap))
        pair = (self.wrap, self.wrap) if isinstance(self.wrap, str) else self.wrap
        if not isinstance(pair, tuple) or len(pair) != 2 or any(w not in WRAPS for w in pair):
            raise ValueError(
                f"wrap: expected one of {', '.join(WRAPS)}, or a pair of them for u and v, got {self.wrap!r}"
            )
        if self.filter not in LOOKUPS:
            raise ValueError(f"filter: expected one of {', '.join(LOOKUPS)}, got {self.filter!r}")
        if self.factor is not None:
            factor = numbers("factor", self.factor)
            self._keep("factor", factor)
            check_shape("factor", factor, (), (self.image.shape[2],), fix="a number, or one a channel of the image")

    def _keep(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    @property
    def wraps(self) -> tuple[str, str]:
        """`wrap` of u and of v."""
        return (self.wrap, self.wrap) if isinstance(self.wrap, str) else self.wrap

    def replace(self, **fields: Any) -> Texture:
        """This texture with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def __repr__(self) -> str:
        factor = "" if self.factor is None else f", factor {_short(self.factor)}"
        own = "" if self.uvs is None else f", {len(self.uvs)} uvs"
        return f"Texture({tuple(self.image.shape)}, {self.filter}, {' '.join(self.wraps)}{factor}{own})"


Parameter = Tensor | Texture


@dataclass(frozen=True, eq=False)
class Material:
    """How the surface of a mesh scatters light, and what it emits. All tensors may require gradients.

    Each of the first four is a number, a constant (C,) or 0-d tensor, a tensor (V, C) or (V, 1) of the mesh's vertices, or a
    Texture; those of metallic and roughness have one channel.

    base_color    times the colours or the texture of the mesh: the share of light that is scattered. Alone where the mesh has
                  none; None: 1
    metallic      0 … 1, and
    roughness     0 … 1: see below
    emission      radiance of its own, W/(sr m²) or whatever unit the lights have; a mesh with emission is a light
    normal_map    Texture (h, w, 3) of linear numbers in [0, 1], of which 2 n − 1 is the normal in the tangent frame of its uvs,
                  as in glTF: red along u, green along v (upwards), blue along the normal. Of a mesh with normals, the frames at
                  the corners of faces are MikkTSpace's. Where it is grey, of a length below 1/128 after all, which 8 bits do not
                  tell from zero, the normal is not bent and has no derivative by the map: start an optimisation at (½, ½, 1)
    normal_scale  multiplies the first two of these
    two_sided     False: seen from behind (vertices clockwise), faces are black and emit nothing
    alpha_mode    "MASK": the mesh's alpha, if it has one, cuts out where it is below its cutoff. "OPAQUE": it must have none.
                  "BLEND": what lies behind shows by 1 − alpha, for up to 8 such surfaces in a row, in the order of their depth;
                  they cast shadows where alpha is at least ½. There are gradients inside faces, by alpha too, and
                  of what moves before and behind such surfaces; none of borders of nearest texels of its alpha and behind it

    metallic and roughness both None: a Lambertian surface, f = base / π. Else the metallic-roughness model of glTF 2.0 (appendix
    B): a Lambertian base under microfacets with the GGX distribution, α = roughness² (Walter et al. 2007), Smith's masking with
    correlated heights (Heitz 2014; glTF's own text has it uncorrelated), and Schlick's Fresnel term from
    F0 = 0.04 + (base − 0.04) · metallic. One of the two left out is metallic = 0, or roughness = 1. α counts as 1e-4 where it is
    less, for a mirror has no density. As in glTF, what the layer reflects and what it takes from the base go by different half
    vectors, so a white dielectric returns more than came at grazing angles (1.14 at 75°, roughness 0.3). Numbers outside of
    0 … 1 are not refused, for an optimisation may pass there.

    Raises TypeError or ValueError that names the argument.
    """

    base_color: Tensor | Texture | float | None = None
    metallic: Tensor | Texture | float | None = None
    roughness: Tensor | Texture | float | None = None
    emission: Tensor | Texture | float | None = None
    normal_map: Texture | None = None
    normal_scale: Tensor | float = 1.0
    two_sided: bool = True
    alpha_mode: str = "MASK"

    def __post_init__(self) -> None:
        for name in ("base_color", "metallic", "roughness", "emission"):
            value = getattr(self, name)
            if value is None or isinstance(value, Texture):
                continue
            value = numbers(name, value)
            object.__setattr__(self, name, value)
            if value.dim() > 2 or 0 in value.shape:
                raise ValueError(
                    f"{name}: expected a number, (C,), (V, C) or a Texture, got shape {tuple(value.shape)}; "
                    "an image is eg.Texture(image)"
                )
        for name in ("metallic", "roughness"):
            value = getattr(self, name)
            if (n := _channels(value)) not in (None, 1):
                fix = "take one of them, such as image[..., 2:3]"
                if isinstance(value, Tensor) and value.dim() == 1:
                    fix = "of vertices give (V, 1), as x[:, None]"
                raise ValueError(f"{name}: expected one channel, got {n}; {fix}")
        if self.normal_map is not None:
            if not isinstance(self.normal_map, Texture):
                raise TypeError(f"normal_map: expected a Texture, got {type(self.normal_map).__name__}")
            check_shape("normal_map", self.normal_map.image, ("h", "w", 3))
        scale = numbers("normal_scale", self.normal_scale)
        check_shape("normal_scale", scale, (), (1,))
        object.__setattr__(self, "normal_scale", scale if scale.dim() == 0 else scale.reshape(()))
        if not isinstance(self.two_sided, bool):
            raise TypeError(f"two_sided: expected True or False, got {type(self.two_sided).__name__}")
        if self.alpha_mode not in ALPHA_MODES:
            raise ValueError(f"alpha_mode: expected one of {', '.join(ALPHA_MODES)}, got {self.alpha_mode!r}")

    @property
    def channels(self) -> int | None:
        """C, or None where all is grey."""
        counts = (_channels(self.base_color), _channels(self.emission))
        return next((count for count in counts if count not in (None, 1)), None)

    @property
    def is_glossy(self) -> bool:
        """Whether it follows the metallic-roughness model, not Lambert's law."""
        return self.metallic is not None or self.roughness is not None

    @property
    def textures(self) -> dict[str, Texture]:
        """By the names of the fields."""
        fields = ("base_color", "metallic", "roughness", "emission", "normal_map")
        return {name: t for name in fields if isinstance(t := getattr(self, name), Texture)}

    def check_fits(self, V: int, F: int, has_uvs: bool) -> None:
        """A mesh of V vertices and F faces. Raises ValueError."""
        C = self.channels
        for name in ("base_color", "metallic", "roughness", "emission"):
            value = getattr(self, name)
            if isinstance(value, Tensor) and value.dim() == 2:
                check_shape(f"material.{name}", value, (V, "C"), fix="a row for each vertex; a constant is (C,)")
            if name in ("base_color", "emission") and (n := _channels(value)) not in (None, 1, C):
                raise ValueError(f"material.{name}: expected {C} channels like base_color, got {n}")
        for name, texture in self.textures.items():
            if texture.uv_faces is None:
                if not has_uvs:
                    raise ValueError(
                        f"material.{name}: expected texture coordinates, got none; give the mesh, or the Texture, uvs (T, 2) and "
                        "uv_faces (F, 3)"
                    )
            elif len(texture.uv_faces) != F:
                raise ValueError(
                    f"material.{name}: expected uv_faces with a row for each of {F} faces, got {len(texture.uv_faces)}"
                )

    def replace(self, **fields: Any) -> Material:
        """This material with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return f"Material({', '.join(f'{name}={_short(v)}' for name, v in given.items() if v is not None)})"


def _short(value: Any) -> str:
    """Few numbers as they are, many by their shape."""
    if not isinstance(value, Tensor):
        return repr(value)
    return str(value.detach().tolist()) if value.numel() <= 4 else f"tensor {tuple(value.shape)}"


def _channels(value: Any) -> int | None:
    if isinstance(value, Texture):
        return value.image.shape[2]
    return value.shape[-1] if isinstance(value, Tensor) and value.dim() else None


def numbers(name: str, value: object) -> Tensor:
    """A number, sequence or tensor as a finite tensor of floating point: Python's own numbers are double, as they are. Raises
    TypeError or ValueError."""
    if not isinstance(value, Tensor):
        value = as_tensor(name, value, like=torch.empty(0, dtype=torch.float64, device="cpu"))
    tensor = as_tensor(name, value, floating=True)
    if not tensor.is_floating_point():
        tensor = tensor.to(torch.get_default_dtype())
    check_float(name, tensor)
    check_finite(name, tensor)
    return tensor


def vertex_normals(verts: Tensor, faces: Tensor) -> Tensor:
    """(V, 3) unit normals of vertices, differentiable: the mean of the incident faces' by area, on the side from which their
    vertices run counter-clockwise. Zero where there is no direction.

    verts  (V, 3) float
    faces  (F, 3) int

    For `Mesh(…, normals=eg.vertex_normals(verts, faces))`. Raises TypeError or ValueError that names the argument.
    """
    verts = as_tensor("verts", verts, floating=True)
    check_float("verts", verts)
    check_shape("verts", verts, ("V", 3))
    faces = as_tensor("faces", faces).to(verts.device)
    check_integer("faces", faces)
    check_shape("faces", faces, ("F", 3))
    check_indices("faces", faces, len(verts), "verts")
    area, index = areas(verts[faces.long()]), faces.long().reshape(-1)
    total = torch.zeros_like(verts, dtype=area.dtype).index_add(0, index, area.repeat_interleave(3, 0))
    return unit(total).to(verts.dtype)
