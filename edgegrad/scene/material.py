"""Materials: how surfaces scatter light and what they emit, as numbers, numbers of vertices, or textures."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..check import as_index, as_real, as_tensor, check_choice, check_fields, check_finite, check_float, check_shape
from ..library import core

WRAPS: tuple[str, ...] = core.WRAPS  # repeat, clamp, mirror
LOOKUPS = ("linear", "nearest", "mipmap")
ALPHA_MODES = ("OPAQUE", "MASK", "BLEND")
LARGEST_UV = 1e9


@dataclass(frozen=True, eq=False)
class Texture:
    """An image on the faces of a mesh, whose tensors may all require gradients. Raises TypeError or ValueError that names the
    argument.

    Parameters
    ----------
    image : (h, w, K) float
        Row 0 is on top, texel centres are at +0.5.
    uvs : (T, 2) float, default those of the mesh
        Texture coordinates of its own, v running up.
    uv_faces : (F, 3) int
        Indices into uvs; given with uvs.
    wrap : "repeat", "clamp" or "mirror", or a pair of these for u and v
        Continuation beyond the border of the image.
    filter : "linear", "nearest" or "mipmap", default "linear"
        "linear" interpolates between texel centres; "nearest" takes the texel that the point lies in. "mipmap" takes means over
        squares of 2, 4, 8 … texels, so that neighbouring pixels are about a texel apart, linear between two such levels
        (Williams 1983). "clamp" then continues with the border of such means, as GPUs do: where many texels fall on a pixel,
        with a mean of the border and of what lies within, at last of the whole image.
    factor : float or (K,)
        Factor of the image, as glTF has it.
    """

    image: Tensor
    uvs: Tensor | None = None
    uv_faces: Tensor | None = None
    wrap: str | tuple[str, str] = "repeat"
    filter: str = "linear"
    factor: Tensor | float | None = None

    def __post_init__(self) -> None:
        self._keep("image", as_real("image", self.image, ("h", "w", "K")))
        if (self.uvs is None) != (self.uv_faces is None):
            missing = "uvs" if self.uvs is None else "uv_faces"
            raise ValueError(f"{missing}: expected both uvs and uv_faces, or none of them, got None; pass it too")
        if self.uvs is not None and self.uv_faces is not None:
            self._keep("uvs", as_real("uvs", self.uvs, ("T", 2), largest=LARGEST_UV))
            self._keep("uv_faces", as_index("uv_faces", self.uv_faces, ("F", 3), len(self.uvs), "uvs"))
        self._keep("wrap", checked_wrap(self.wrap))
        self._keep("filter", check_choice("filter", self.filter, LOOKUPS))
        if self.factor is not None:
            factor = numbers("factor", self.factor)
            self._keep("factor", factor)
            check_shape("factor", factor, (), (self.image.shape[2],), fix="a number, or one a channel of the image")

    def _keep(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    @property
    def wraps(self) -> tuple[str, str]:
        """Return `wrap` of u and of v."""
        return (self.wrap, self.wrap) if isinstance(self.wrap, str) else self.wrap

    def replace(self, **fields: Any) -> Texture:
        """Return this texture with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def __repr__(self) -> str:
        factor = "" if self.factor is None else f", factor {_short(self.factor)}"
        own = "" if self.uvs is None else f", {len(self.uvs)} uvs"
        return f"Texture({tuple(self.image.shape)}, {self.filter}, {' '.join(self.wraps)}{factor}{own})"


def checked_wrap(wrap: str | tuple[str, str] | list[str]) -> str | tuple[str, str]:
    """Return a wrap, or a pair of these, as plain str. Raises ValueError."""
    pair = (wrap, wrap) if isinstance(wrap, str) else tuple(wrap) if isinstance(wrap, list) else wrap
    if not isinstance(pair, tuple) or len(pair) != 2 or any(w not in WRAPS for w in pair):
        raise ValueError(f"wrap: expected one of {', '.join(WRAPS)}, or a pair of them for u and v, got {wrap!r}")
    u, v = (WRAPS[WRAPS.index(w)] for w in pair)
    return u if isinstance(wrap, str) else (u, v)


Parameter = Tensor | Texture


@dataclass(frozen=True, eq=False)
class Material:
    """How the surface of a mesh scatters light, and what it emits. All tensors may require gradients.

    Each of the first four is a number, a constant (C,) or 0-d tensor, a tensor (V, C) or (V, 1) of the mesh's vertices, or a
    Texture; metallic and roughness have one channel.

    With metallic and roughness both None the surface is Lambertian, f = base / π. Else it follows the metallic-roughness model
    of glTF 2.0 (appendix B): a Lambertian base under microfacets with the GGX distribution, α = roughness² (Walter et al.
    2007), Smith's masking with correlated heights (Heitz 2014; glTF's own text has it uncorrelated), and Schlick's Fresnel term
    from F0 = 0.04 + (base − 0.04) · metallic. If one of the two is left out, metallic is 0, or roughness is 1. α is at least
    1e-4, because a mirror has no pdf. As in glTF, what the layer reflects and what it takes from the base follow different half
    vectors, so a white dielectric returns more than came at grazing angles (1.14 at 75°, roughness 0.3). Numbers outside of 0 …
    1 are not refused, because an optimisation may pass there. Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    base_color : default 1
        Share of light that is scattered: a factor of the colours or the texture of the mesh, and alone where the mesh has none.
    metallic, roughness : 0 … 1
        Parameters of the microfacet model; see above.
    emission
        Radiance of its own, W/(sr m²) or whatever unit the lights have. A mesh with emission is a light.
    normal_map : Texture (h, w, 3)
        Linear numbers in [0, 1]; 2 n − 1 is the normal in the tangent frame of the texture's uvs, as in glTF: red along u,
        green along v (upwards), blue along the normal. Of a mesh with normals, the frames at the corners of faces are
        MikkTSpace's. Where 2 n − 1 is shorter than 1/128, which 8 bits do not distinguish from zero, the normal is not bent and
        has no derivative by the map: start an optimisation at (½, ½, 1).
    normal_scale : float, default 1
        Factor of the first two of these.
    two_sided : bool, default True
        False: seen from behind (vertices clockwise), faces are black and emit nothing.
    alpha_mode : "MASK", "OPAQUE" or "BLEND", default "MASK"
        "MASK" lets rays pass where the mesh's alpha, if it has one, is below its cutoff. "OPAQUE" forbids alpha. "BLEND" shows
        what lies behind by 1 − alpha, for up to 8 such surfaces in a row, in the order of their depth; they cast shadows where
        alpha is at least ½. There are gradients inside faces, by alpha, too, and of what moves before and behind such surfaces;
        there are none of borders of nearest texels of its alpha, nor of those behind it.
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
        object.__setattr__(self, "alpha_mode", check_choice("alpha_mode", self.alpha_mode, ALPHA_MODES))

    @property
    def channels(self) -> int | None:
        """Return C, or None where all is grey."""
        counts = (_channels(self.base_color), _channels(self.emission))
        return next((count for count in counts if count not in (None, 1)), None)

    @property
    def is_glossy(self) -> bool:
        """Return whether it follows the metallic-roughness model instead of Lambert's law."""
        return self.metallic is not None or self.roughness is not None

    @property
    def textures(self) -> dict[str, Texture]:
        """Return the textures by the names of the fields."""
        fields = ("base_color", "metallic", "roughness", "emission", "normal_map")
        return {name: t for name in fields if isinstance(t := getattr(self, name), Texture)}

    def check_fits(self, V: int, F: int, has_uvs: bool) -> None:
        """Raise ValueError unless the material suits a mesh of V vertices and F faces."""
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
        """Return this material with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)

    def __repr__(self) -> str:
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return f"Material({', '.join(f'{name}={_short(v)}' for name, v in given.items() if v is not None)})"


def _short(value: Any) -> str:
    """Return few numbers as they are, many by their shape."""
    if not isinstance(value, Tensor):
        return repr(value)
    return str(value.detach().tolist()) if value.numel() <= 4 else f"tensor {tuple(value.shape)}"


def _channels(value: Any) -> int | None:
    if isinstance(value, Texture):
        return value.image.shape[2]
    return value.shape[-1] if isinstance(value, Tensor) and value.dim() else None


def numbers(name: str, value: object) -> Tensor:
    """Return a number, sequence or tensor as a finite tensor of floating point; Python's own numbers become double. Raises
    TypeError or ValueError."""
    if not isinstance(value, Tensor):
        value = as_tensor(name, value, like=torch.empty(0, dtype=torch.float64, device="cpu"))
    tensor = as_tensor(name, value, floating=True)
    if not tensor.is_floating_point():
        tensor = tensor.to(torch.get_default_dtype())
    check_float(name, tensor)
    check_finite(name, tensor)
    return tensor
