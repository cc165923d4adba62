"""Triangle meshes: vertices, faces, and their appearance."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..check import (
    as_tensor,
    check_choice,
    check_countable,
    check_fields,
    check_finite,
    check_float,
    check_indices,
    check_integer,
    check_shape,
)
from ..library import core
from .affine import Affine
from .material import LARGEST_UV, LOOKUPS, Material, Texture, checked_wrap
from .rows import vertex_normals
from .tree import map_tensors, moved

DEFAULT_RADIANCE = 0.7  # radiance, or base colour, of a mesh without colours, in every channel
FILTERS: tuple[str, ...] = core.TEXTURE_FILTERS  # linear, nearest
_SETTINGS = ("alpha_cutoff", "wrap", "filter", "material", "name")  # fields that are no tensors
_INDEXING = ("verts", "faces", "uv_faces", "normal_faces")  # what takes no type from the vertices
SMALLEST_MESH = 1e-38


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh whose tensors may all require gradients.

    At most one of colors, face_colors, corner_colors and texture gives the radiance (linear, any number of channels C); without
    any, the mesh is plain grey. Faces of zero area render nothing. Numbers reach up to 3.4e38, the range of float32, also in
    float64; uvs reach up to 1e9, because beyond that a double does not distinguish the texels of a large texture. The largest
    of the verts lies above 1e-38, unless all are zero. Raises TypeError for a wrong type, ValueError for a wrong shape, a wrong
    index or a value that is not finite or out of this range.

    Parameters
    ----------
    verts : (V, 3) float
        Positions, in the user's world units and axes.
    faces : (F, 3) int
        Vertex indices, from zero; both sides of a face are seen.
    colors : (V, C) float
        Colours of vertices, interpolated over the faces.
    face_colors : (F, C) float
        Colours of faces, constant over each.
    corner_colors : (F, 3, C) float
        Colours of corners of faces; they jump across edges where they differ.
    texture : (h, w, C) float
        Image on the faces: row 0 is on top, texel centres are at +0.5. It needs uvs.
    uvs : (T, 2) float
        Texture coordinates, v running up (as in OBJ), given with uv_faces.
    uv_faces : (F, 3) int
        Indices into uvs, apart from `faces`, so that vertices stay welded at seams.
    alpha : (h, w) float
        Another image on the faces, of any size, whatever gives the radiance. Rays pass through faces where it is below
        alpha_cutoff. It needs uvs.
    alpha_cutoff : float, default 0.5
    wrap : "repeat", "clamp" or "mirror", or a pair of these for u and v
        Continuation of both images beyond their borders; "clamp" repeats the texels at the border.
    filter : "linear", "nearest" or "mipmap", default "linear"
        "linear" interpolates between the centres of texels; "nearest" takes the texel that the point lies in. "mipmap", for a
        texture finer than the pixels, takes its means over squares of 2, 4, 8 … texels, as of eg.Texture. It takes 1.2 to 1.5
        times as long, and is not for screen_gradient(); alpha is then looked up as "linear".
    material : Material
        How it scatters light, and what it emits; the colours above are then base colours. None: it is not lit, and colours are
        radiance.
    normals : (N, 3) float
        Normals of any length, interpolated over the faces where a material is lit, and turned to the side of the face that is
        seen. Faces are flat without them.
    normal_faces : (F, 3) int, default `faces`
        Indices into normals.
    name : str
        Name in a file.
    """

    verts: Tensor
    faces: Tensor
    colors: Tensor | None = None
    face_colors: Tensor | None = None
    corner_colors: Tensor | None = None
    texture: Tensor | None = None
    uvs: Tensor | None = None
    uv_faces: Tensor | None = None
    alpha: Tensor | None = None
    alpha_cutoff: float = 0.5
    wrap: str | tuple[str, str] = "repeat"
    filter: str = "linear"
    material: Material | None = None
    normals: Tensor | None = None
    normal_faces: Tensor | None = None
    name: str | None = None

    def __post_init__(self) -> None:
        self._check_settings()
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name in _SETTINGS:
                continue
            if value is not None or field.name in ("verts", "faces"):
                like = self.verts if field.name not in _INDEXING else None
                object.__setattr__(
                    self, field.name, as_tensor(field.name, value, like=like, floating=field.name == "verts")
                )
        check_float("verts", self.verts)
        check_shape("verts", self.verts, ("V", 3))
        check_integer("faces", self.faces)
        some = self.faces.dim() == 2 and self.faces.shape[0] > 0
        check_shape(
            "faces", self.faces, ("F", 3), fix="triangulate polygons first" if some else "give at least one face"
        )
        V, F = self.verts.shape[0], self.faces.shape[0]

        kinds = [k for k in ("colors", "face_colors", "corner_colors", "texture") if getattr(self, k) is not None]
        if len(kinds) > 1:
            raise ValueError(f"{kinds[1]}: expected one kind of colour, got {' and '.join(kinds)}; keep one of them")
        shapes = {"colors": (V, "C"), "face_colors": (F, "C"), "corner_colors": (F, 3, "C"), "texture": ("h", "w", "C")}
        for kind in kinds:
            check_float(kind, getattr(self, kind))
            check_shape(kind, getattr(self, kind), shapes[kind])
        if self.alpha is not None:
            check_float("alpha", self.alpha)
            check_shape("alpha", self.alpha, ("h", "w"))
        user = "a texture" if self.texture is not None else "alpha" if self.alpha is not None else None
        user = user or ("uv_faces" if self.uv_faces is not None else "uvs" if self.uvs is not None else None)
        if user is not None:
            if self.uvs is None or self.uv_faces is None:
                missing = "uvs" if self.uvs is None else "uv_faces"
                raise ValueError(f"{missing}: expected with {user}, got None; pass uvs (T, 2) and uv_faces (F, 3)")
            check_float("uvs", self.uvs)
            check_shape("uvs", self.uvs, ("T", 2))
            check_integer("uv_faces", self.uv_faces)
            check_shape("uv_faces", self.uv_faces, (F, 3))

        self._check_lit(V, F)
        # First of all, for more rows than can be counted take as long to look at.
        check_countable("faces", self.faces, V, "verts")
        if self.uvs is not None and self.uv_faces is not None:
            check_countable("uv_faces", self.uv_faces, self.uvs.shape[0], "uvs")
        check_finite("verts", self.verts, smallest=SMALLEST_MESH if self.verts.dtype == torch.float64 else 0.0)
        check_indices("faces", self.faces, V, "verts")
        for kind in kinds + ["alpha"] * (self.alpha is not None):
            check_finite(kind, getattr(self, kind))
        if self.uvs is not None and self.uv_faces is not None:
            check_finite("uvs", self.uvs, largest=LARGEST_UV)
            check_indices("uv_faces", self.uv_faces, self.uvs.shape[0], "uvs")
        if self.normals is not None:
            check_finite("normals", self.normals)
            if self.normal_faces is not None:
                check_indices("normal_faces", self.normal_faces, self.normals.shape[0], "normals")

    def _check_lit(self, V: int, F: int) -> None:
        """Check the material and the normals, but not their numbers."""
        if self.normals is not None:
            check_float("normals", self.normals)
            check_shape("normals", self.normals, ("N", 3))
            if self.normal_faces is None:
                if len(self.normals) != V:
                    raise ValueError(
                        f"normal_faces: expected with {len(self.normals)} normals of {V} vertices, got None; pass normal_faces "
                        "(F, 3), or a normal for each vertex"
                    )
            else:
                check_integer("normal_faces", self.normal_faces)
                check_shape("normal_faces", self.normal_faces, (F, 3))
                check_countable("normal_faces", self.normal_faces, len(self.normals), "normals")
        elif self.normal_faces is not None:
            raise ValueError("normals: expected with normal_faces, got None; pass normals (N, 3)")
        if self.material is None:
            return
        if not isinstance(self.material, Material):
            raise TypeError(
                f"material: expected a Material, got {type(self.material).__name__}; eg.Material(…) makes one"
            )
        self.material.check_fits(V, F, self.uvs is not None)
        own, C = self._color_channels, self.material.channels
        if own not in (None, 1) and C not in (None, own):
            raise ValueError(f"material: expected {own} channels like the mesh's colours, got {C}")
        if self.material.alpha_mode == "OPAQUE" and self.alpha is not None:
            raise ValueError(
                'alpha: expected None with alpha_mode="OPAQUE", got an image; take "MASK", or leave it out'
            )

    def _check_settings(self) -> None:
        if self.name is not None and not isinstance(self.name, str):
            raise TypeError(f"name: expected a str or None, got {type(self.name).__name__}")
        if self.name is not None:  # torch.load(weights_only=True) refuses subclasses such as numpy.str_
            object.__setattr__(self, "name", str.__str__(self.name))
        if isinstance(self.alpha_cutoff, bool) or not isinstance(self.alpha_cutoff, (int, float)):
            raise TypeError(f"alpha_cutoff: expected a number, got {type(self.alpha_cutoff).__name__}")
        if not math.isfinite(self.alpha_cutoff):
            raise ValueError(f"alpha_cutoff: expected a finite number, got {self.alpha_cutoff}")
        object.__setattr__(self, "alpha_cutoff", float(self.alpha_cutoff))
        object.__setattr__(self, "wrap", checked_wrap(self.wrap))
        object.__setattr__(self, "filter", check_choice("filter", self.filter, LOOKUPS))

    @property
    def has_textures(self) -> bool:
        """Return whether its colours, or numbers of its material, are textures."""
        material = self.material
        values = () if material is None else (getattr(material, field.name) for field in dataclasses.fields(material))
        return self.texture is not None or any(isinstance(value, Texture) for value in values)

    @property
    def blends(self) -> bool:
        """Return whether what lies behind shows through where alpha is below 1."""
        return self.alpha is not None and self.material is not None and self.material.alpha_mode == "BLEND"

    @property
    def wraps(self) -> tuple[str, str]:
        """Return `wrap` of u and of v."""
        return (self.wrap, self.wrap) if isinstance(self.wrap, str) else self.wrap

    @property
    def channels(self) -> int | None:
        """Return C, or None for a plain mesh, which takes the channels of its scene."""
        own, of_material = self._color_channels, None if self.material is None else self.material.channels
        return own if of_material is None else of_material if own is None else max(own, of_material)

    @property
    def _color_channels(self) -> int | None:
        for value in (self.colors, self.face_colors, self.corner_colors, self.texture):
            if value is not None:
                return value.shape[-1]
        return None

    def replace(self, **fields: Any) -> Mesh:
        """Return this mesh with some tensors replaced: `mesh.replace(verts=v)` keeps faces and colours.

        Giving another kind of colour removes the present one, with texture coordinates that nothing else needs.
        """
        check_fields(self, fields)
        appearance = {"colors", "face_colors", "corner_colors", "texture"}
        if any(name in appearance and fields[name] is not None for name in fields):
            needs_uvs = fields.get("texture") is not None or fields.get("alpha", self.alpha) is not None
            needs_uvs = needs_uvs or fields.get("uvs") is not None
            gone = appearance | (set() if needs_uvs else {"uvs", "uv_faces"})
            fields = {**dict.fromkeys(gone - set(fields)), **fields}
        return dataclasses.replace(self, **fields)

    def vertex_normals(self) -> Tensor:
        """Return unit normals (V, 3) of the vertices, differentiable, for `mesh.replace(normals=mesh.vertex_normals())`.

        They are the mean of the incident faces' by area, on the side from which their vertices run counter-clockwise, and zero
        where there is no direction.
        """
        return vertex_normals(self.verts, self.faces)

    def transformed(self, R: Tensor | None = None, t: Tensor | None = None, scale: Tensor | float = 1.0) -> Mesh:
        """Return the mesh with vertices `scale · R v + t`, differentiable in all four.

        R (3, 3) is any matrix, by default the identity; t (3,) is in world units, by default zero; scale is a number or 0-d
        tensor. Normals are transformed, too. A mirror, R of negative determinant, keeps the faces' corners in their order, so
        it turns a mesh inside out. Raises TypeError or ValueError.
        """
        affine = Affine.from_arguments(R, t, scale, self.verts)
        fields = {} if self.normals is None else {"normals": affine.normals(self.normals)}
        return self.replace(verts=affine.points(self.verts), **fields)

    def to(self, *args: Any, **kwargs: Any) -> Mesh:
        """Return the mesh on a device; floating-point tensors also of a dtype, as `torch.Tensor.to`."""
        return moved(self, *args, **kwargs)

    def detach(self) -> Mesh:
        """Return the mesh cut from the autograd graph."""
        return map_tensors(self, Tensor.detach)

    def __repr__(self) -> str:
        kinds = [k for k in ("colors", "face_colors", "corner_colors", "texture") if getattr(self, k) is not None]
        look = f"{kinds[0]} {tuple(getattr(self, kinds[0]).shape)}" if kinds else "plain"
        look += f", alpha {tuple(self.alpha.shape)}" if self.alpha is not None else ""
        look += ", lit" if self.material is not None else ""
        name = "" if self.name is None else f"{self.name!r}, "
        return f"Mesh({name}{self.verts.shape[0]} vertices, {self.faces.shape[0]} faces, {look}, {self.verts.dtype})"
