"""Textures of glTF files as materials refer to them: image, sampler, and texture coordinates with their transform."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from .part import Fault
from .source import Source, no_image

# What a glTF calls its samplers' settings.
WRAPS = {33071: "clamp", 33648: "mirror", 10497: "repeat"}
NEAREST, LINEAR = 9728, 9729
FARTHER: dict[int | None, str] = {
    None: "mipmap",
    NEAREST: "linear",
    LINEAR: "linear",
    9984: "mipmap",
    9985: "mipmap",
    9986: "mipmap",
    9987: "mipmap",
}


class Place(NamedTuple):
    """How a texture lies on a primitive (KHR_texture_transform)."""

    set: int = 0  # of texture coordinates
    offset: tuple[float, ...] = (0.0, 0.0)
    rotation: float = 0.0
    scale: tuple[float, ...] = (1.0, 1.0)

    @classmethod
    def of(cls, reference: dict[str, Any]) -> Place:
        given = reference.get("extensions", {}).get("KHR_texture_transform", {})
        offset, scale = (tuple(map(float, given.get(k, d))) for k, d in (("offset", (0, 0)), ("scale", (1, 1))))
        if len(offset) != 2 or len(scale) != 2:
            raise Fault(f"expected two numbers for offset and scale of a texture, got {offset} and {scale}; repair it")
        own = int(given.get("texCoord", reference.get("texCoord", 0)))
        return cls(own, offset, float(given.get("rotation", 0.0)), scale)

    def moved(self, uvs: np.ndarray) -> np.ndarray:
        """(N, 2) float32, v running up, from those of the set, v running down: offset + R (scale · uv)."""
        moved = uvs
        if self != Place(self.set):
            # Counter-clockwise as it is seen, v running down: so the extension's text and its example have it, and viewers; the
            # matrix in its text, read by columns, turns the other way.
            c, s = math.cos(self.rotation), math.sin(self.rotation)
            with np.errstate(over="ignore", invalid="ignore"):
                u, v = (uvs[:, k].astype(np.float64) * self.scale[k] for k in (0, 1))
                moved = np.stack([c * u + s * v + self.offset[0], c * v - s * u + self.offset[1]], 1)
        return np.stack([moved[:, 0], 1.0 - moved[:, 1]], 1).astype(np.float32)


class Lookup(NamedTuple):
    """A texture as a material refers to it."""

    name: str
    image: Any  # of Pillow
    place: Place
    wrap: tuple[str, str]
    near: str  # the filter of a Mesh, that where texels are larger than pixels
    filter: str  # that of a Texture, which has mipmaps too

    @classmethod
    def of(
        cls, tree: dict[str, Any], field: str, reference: dict[str, Any], raw: dict[str, Any], source: Source
    ) -> Lookup:
        """A texture by the field of the material that refers to it. Raises Fault or FileNotFoundError."""
        texture = tree["textures"][reference["index"]]
        described = tree["images"][texture.get("source", 0)]
        name = str(described.get("name") or described.get("uri") or field)[:60]
        image = getattr(raw["visual"].material, field)
        if image is None:
            raise source.folder.failures.get(described.get("uri", ""), no_image(name))
        return cls(name, image, Place.of(reference), *_sampler(tree, texture, name))


def _sampler(tree: dict[str, Any], texture: dict[str, Any], name: str) -> tuple[tuple[str, str], str, str]:
    """Wraps, and the filters near and far. Where a file leaves the latter open, it is a mipmap."""
    given = tree["samplers"][texture["sampler"]] if "sampler" in texture else {}
    wraps, near, far = [given.get(k, 10497) for k in ("wrapS", "wrapT")], given.get("magFilter"), given.get("minFilter")
    if any(w not in WRAPS for w in wraps) or near not in (None, NEAREST, LINEAR) or far not in FARTHER:
        raise Fault(
            f"expected a sampler of glTF 2.0 for the texture {name!r}, got wraps {wraps}, magFilter {near} and minFilter {far}; "
            "export it again"
        )
    wrap = WRAPS[wraps[0]], WRAPS[wraps[1]]
    return (wrap, "nearest", "nearest") if near == NEAREST else (wrap, "linear", FARTHER[far])


def coordinates(raw: dict[str, Any], which: int) -> np.ndarray | None:
    """(N, 2) texture coordinates of a set, v running down; None where there are none."""
    values = raw.get("vertex_attributes", {}).get(f"_TEXCOORD_{which}")
    if values is None:
        return None
    values = np.asarray(values)
    if values.shape != (len(raw["vertices"]), 2):
        raise Fault(
            f"expected TEXCOORD_{which} for {len(raw['vertices'])} vertices, got shape {values.shape}; repair it"
        )
    return values / np.float32(np.iinfo(values.dtype).max) if values.dtype.kind in "iu" else values
