"""Textures of glTF files as materials refer to them: image, sampler, and texture coordinates with their transform."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .context import opened
from .gltf import entry
from .gltf_arrays import Arrays, content
from .part import FormatError

# glTF has these codes for settings of samplers.
WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
NEAREST, LINEAR = 9728, 9729
MIN_FILTERS: dict[int | None, str] = {
    None: "mipmap",
    NEAREST: "linear",
    LINEAR: "linear",
    9984: "mipmap",
    9985: "mipmap",
    9986: "mipmap",
    9987: "mipmap",
}


class TextureTransform(NamedTuple):
    """The set and transform of a texture's coordinates (KHR_texture_transform)."""

    set: int = 0  # of texture coordinates
    offset: tuple[float, ...] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, ...] = (1.0, 1.0)

    @classmethod
    def from_json(cls, reference: dict[str, Any]) -> TextureTransform:
        given = reference.get("extensions", {}).get("KHR_texture_transform", {})
        offset, scale = (tuple(map(float, given.get(k, d))) for k, d in (("offset", (0, 0)), ("scale", (1, 1))))
        if len(offset) != 2 or len(scale) != 2:
            raise FormatError(
                f"expected two numbers for offset and scale of a texture, got {offset} and {scale}; repair it"
            )
        own = int(given.get("texCoord", reference.get("texCoord", 0)))
        return cls(own, offset, float(given.get("rotation", 0.0)), scale)

    def moved(self, uvs: np.ndarray) -> np.ndarray:
        """Return offset + R (scale · uv), (N, 2) float32, v running up, from coordinates of the set, v running down."""
        moved = uvs
        if self != TextureTransform(self.set):
            # Counter-clockwise as it is seen, v running down: so the extension's text and its example have it, and viewers; the
            # matrix in its text, read by columns, turns the other way.
            c, s = math.cos(self.rotation), math.sin(self.rotation)
            with np.errstate(over="ignore", invalid="ignore"):
                u, v = (uvs[:, k].astype(np.float64) * self.scale[k] for k in (0, 1))
                moved = np.stack([c * u + s * v + self.offset[0], c * v - s * u + self.offset[1]], 1)
        return np.stack([moved[:, 0], 1.0 - moved[:, 1]], 1).astype(np.float32)


class Images:
    """The images of a file, each opened once. Methods raise FormatError or FileNotFoundError, which name the image."""

    def __init__(self, arrays: Arrays) -> None:
        self.arrays = arrays
        self.known: dict[int, Any] = {}

    def get(self, texture: int) -> tuple[str, Any]:
        """Return the name and the Pillow image of a texture by its number."""
        given = entry(self.arrays.tree, "textures", texture)
        extensions = given.get("extensions", {})
        source = extensions.get("EXT_texture_webp", {}).get("source", given.get("source"))
        if source is None:
            name = str(given.get("name", texture))[:60]
            held = f"none but in the extension {', '.join(sorted(extensions))}" if extensions else "none"
            raise FormatError(
                f"expected a source, which is an image, in the texture {name!r}, got {held}; save it as PNG or JPEG"
            )
        described = entry(self.arrays.tree, "images", source)
        uri = described.get("uri", "data:")
        name = str(described.get("name") or (f"image {source}" if uri.startswith("data:") else uri))[:60]
        if source not in self.known:
            held = self.arrays.view(described["bufferView"]) if "bufferView" in described else None
            self.known[source] = opened(name, content(uri, self.arrays.folder) if held is None else bytes(held))
        return name, self.known[source]


class Lookup(NamedTuple):
    """A texture as a material refers to it."""

    name: str
    image: Any  # of Pillow
    transform: TextureTransform
    wrap: tuple[str, str]
    near: str  # the filter of a Mesh, that where texels are larger than pixels
    filter: str  # that of a Texture, which has mipmaps too

    @classmethod
    def from_reference(cls, images: Images, reference: dict[str, Any]) -> Lookup:
        tree, index = images.arrays.tree, reference["index"]
        name, image = images.get(index)
        return cls(name, image, TextureTransform.from_json(reference), *_sampler(tree, tree["textures"][index], name))


def _sampler(tree: dict[str, Any], texture: dict[str, Any], name: str) -> tuple[tuple[str, str], str, str]:
    """Return wraps, and the filters for magnification and minification, by default a mipmap."""
    given = entry(tree, "samplers", texture["sampler"]) if "sampler" in texture else {}
    wraps, near, far = [given.get(k, 10497) for k in ("wrapS", "wrapT")], given.get("magFilter"), given.get("minFilter")
    if any(w not in WRAPS for w in wraps) or near not in (None, NEAREST, LINEAR) or far not in MIN_FILTERS:
        raise FormatError(
            f"expected a sampler of glTF 2.0 for the texture {name!r}, got wraps {wraps}, magFilter {near} and minFilter {far}; "
            "export it again"
        )
    wrap = WRAPS[wraps[0]], WRAPS[wraps[1]]
    return (wrap, "nearest", "nearest") if near == NEAREST else (wrap, "linear", MIN_FILTERS[far])
