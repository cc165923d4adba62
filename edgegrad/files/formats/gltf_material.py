"""Appearance of glTF primitives, unlit and lit."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...scene.material import Material, Texture
from .context import LoadContext, linear_colors
from .gltf import GLOSS, MATT, entry
from .gltf_arrays import Geometry
from .gltf_texture import Images, Lookup, TextureTransform
from .part import FormatError

WHITE = (1.0, 1.0, 1.0)
RAMP = torch.tensor([[0.0, 1.0]])  # alpha that is looked up where it is known


class Primitive(NamedTuple):
    """A primitive of a file."""

    geometry: Geometry
    positions: np.ndarray  # (N, 3)
    triangles: np.ndarray  # (F, 3)
    images: Images
    context: LoadContext

    @classmethod
    def from_geometry(cls, geometry: Geometry, images: Images, context: LoadContext) -> Primitive:
        positions = geometry.attribute("POSITION")
        if positions is None:
            raise FormatError("expected the attribute POSITION, got none; export it again")
        return cls(geometry, positions, geometry.triangles(), images, context)

    @property
    def given(self) -> dict[str, Any]:
        return self.geometry.given

    @property
    def material(self) -> dict[str, Any]:
        """Return the material's JSON; without one, that of glTF: white, and a rough metal where it is lit."""
        return entry(self.geometry.arrays.tree, "materials", self.given["material"]) if "material" in self.given else {}

    @property
    def base(self) -> dict[str, Any]:
        return self.material.get("pbrMetallicRoughness", {})

    @property
    def factor(self) -> tuple[float, ...]:
        """Return the factor of the base colour, which trimesh has in 8 bit only."""
        return tuple(float(f) for f in self.base.get("baseColorFactor", WHITE)[:3])

    def lookup(self, field: str, within: dict[str, Any] | None = None) -> Lookup | None:
        reference = (self.material if within is None else within).get(field)
        return None if reference is None else Lookup.from_reference(self.images, reference)

    def colors(self) -> Tensor | None:
        values = self.geometry.attribute("COLOR_0")
        return None if values is None else linear_colors("vertex", values, srgb=False)

    def opacities(self) -> Tensor | None:
        """Return the fourth number (N,) float32 of the vertices' colours, if there is one. Raises FormatError."""
        values = self.geometry.attribute("COLOR_0")
        if values is None or values.shape[1] < 4:
            return None
        alpha = values[:, 3]
        good = (alpha >= 0.0) & (alpha <= 1.0)
        if not good.all():
            bad = int(np.argwhere(~good)[0, 0])
            raise FormatError(f"expected alpha of COLOR_0 from 0 to 1, got {alpha[bad]} at vertex {bad}; repair it")
        return torch.from_numpy(np.array(alpha)).float()

    def uvs(self, place: TextureTransform, needed_by: str | None = None) -> np.ndarray | None:
        """Return texture coordinates (N, 2) float32, v running up. Raises FormatError where something needs missing ones."""
        own = self.geometry.attribute(f"TEXCOORD_{place.set}")
        if own is None and needed_by is not None:
            raise FormatError(
                f"expected texture coordinates TEXCOORD_{place.set} for the texture of {needed_by}, got none; unwrap the mesh"
            )
        if own is not None and own.shape != (len(self.positions), 2):
            got = f"shape {own.shape}"
            raise FormatError(f"expected TEXCOORD_{place.set} for {len(self.positions)} vertices, got {got}; repair it")
        return None if own is None else place.moved(own)


def appearance(
    primitive: Primitive, known: dict[object, tuple[Material, dict[str, TextureTransform]]]
) -> dict[str, object]:
    """Return the fields of a part that determine its appearance. Raises FormatError. `known` caches materials by their
    numbers."""
    options, material, colors = primitive.context.options, primitive.material, primitive.colors()
    found: dict[str, object] = {"uvs": primitive.uvs(TextureTransform()), "colors": colors}
    lit = options.lit and not ("KHR_materials_unlit" in material.get("extensions", {}) and options.materials)
    if lit:
        found["normals"] = primitive.geometry.attribute("NORMAL")
    if not options.materials:
        return {**found, "material": known.setdefault(None, (Material(), {}))[0] if lit else None}
    if "material" not in primitive.given and not lit:
        return found
    if GLOSS in material.get("extensions", {}):
        if primitive.base:
            primitive.context.unread.note(GLOSS, "shown in the metallic-roughness material beside it")
        else:
            raise FormatError("expected a metallic-roughness material, got specular-glossiness alone; convert it")
    texture = primitive.lookup("baseColorTexture", primitive.base)
    place = TextureTransform() if texture is None else texture.transform
    if texture is not None:
        found |= {"uvs": primitive.uvs(place, "base_color"), "wrap": texture.wrap, "filter": texture.near}
    alpha_mask = _alpha(primitive, texture)
    if lit:
        # An alpha mask by vertices takes the mesh's own coordinates.
        return {**found, **alpha_mask, **_lit(primitive, None if "uvs" in alpha_mask else place, known)}
    return {**found, **alpha_mask, **_unlit(primitive, texture, colors)}


def _alpha(primitive: Primitive, texture: Lookup | None) -> dict[str, object]:
    """Return what masks or blends the part: the texture's alpha, or that of the vertices, times the factor's."""
    material, context = primitive.material, primitive.context
    mode, cutoff = material.get("alphaMode", "OPAQUE"), float(material.get("alphaCutoff", 0.5))
    if mode not in ("OPAQUE", "MASK", "BLEND"):
        raise FormatError(f"expected alphaMode OPAQUE, MASK or BLEND, got {mode!r}; export it again")
    blended = mode == "BLEND" and context.options.lit
    if mode != "MASK" and not blended:
        return {}
    opacity = float((*primitive.base.get("baseColorFactor", ()), 1.0, 1.0, 1.0, 1.0)[3])
    of_vertices = primitive.opacities()
    if of_vertices is not None and float(of_vertices.min()) == float(of_vertices.max()):
        opacity, of_vertices = opacity * float(of_vertices[0]), None
    own = None if texture is None else context.textures.alpha(texture.image, opacity)
    everywhere = blended and own is None and of_vertices is None
    if everywhere or (opacity < cutoff and not blended):  # the same, or cut out, whatever else there is
        uvs = np.zeros((len(primitive.positions), 2), np.float32)
        return {"cutoff": cutoff, "alpha": torch.full((1, 1), opacity), "uvs": uvs}
    if of_vertices is None:
        return {"cutoff": cutoff, "alpha": own}
    if texture is not None and (own is not None or not context.options.lit):
        raise FormatError(
            f"expected the texture {texture.name!r} or the alpha of COLOR_0 to cut out, got both; bake the alpha into the texture"
        )
    # Linear over a face, as the texture coordinates by which a ramp of two texels is looked up.
    u = 0.25 + 0.5 * opacity * of_vertices
    uvs = torch.stack([u, torch.full_like(u, 0.5)], 1).numpy()
    return {"cutoff": cutoff, "alpha": RAMP, "uvs": uvs, "wrap": ("clamp", "clamp"), "filter": "linear"}


def _unlit(primitive: Primitive, texture: Lookup | None, colors: Tensor | None) -> dict[str, object]:
    """Return texture, factor and vertex colours multiplied, as radiance."""
    factor = primitive.factor
    if texture is None:
        if colors is not None:
            return {"colors": colors * colors.new_tensor(factor)}
        return {"face_colors": torch.tensor(factor, dtype=torch.float32).repeat(len(primitive.triangles), 1)}
    if colors is not None:
        if not bool((colors == colors[0]).all()):
            lit = "" if primitive.context.options.lit else "lit=True, which multiplies them, or "
            raise FormatError(
                f"expected the texture {texture.name!r} or vertex colours that differ, got both, of which an unlit mesh has one; "
                f"load it with {lit}materials=False, which leaves out the texture, or bake one into the other"
            )
        factor = tuple((colors[0] * colors.new_tensor(factor)).tolist())
    return {"colors": None, "texture": primitive.context.textures.get(texture.name, texture.image, factor)}


def _lit(
    primitive: Primitive,
    shared: TextureTransform | None,
    known: dict[object, tuple[Material, dict[str, TextureTransform]]],
) -> dict[str, object]:
    """Return the material, and the texture coordinates of its textures whose transform differs from the mesh's own."""
    key = primitive.given.get("material", -1)
    if key not in known:
        try:
            known[key] = _material(primitive)
        except ValueError as error:
            raise FormatError(f"material {str(primitive.material.get('name', key))[:60]!r}: {error}") from error
    material, places = known[key]
    uvs = {name: primitive.uvs(own, name) for name, own in places.items()}
    if material.normal_map is not None and "TANGENT" in primitive.given["attributes"]:
        primitive.context.unread.note("TANGENT", "frames of normal maps follow from texture coordinates")
    return {"material": material, "material_uvs": {name: uvs[name] for name in uvs if places[name] != shared}}


def _material(primitive: Primitive) -> tuple[Material, dict[str, TextureTransform]]:
    """Return the material, and the transforms of its textures."""
    given, base, context = primitive.material, primitive.base, primitive.context
    extensions = given.get("extensions", {})
    matt = extensions.get(MATT, {}).get("specularFactor") == 0 and base.get("metallicFactor") == 0
    if MATT in extensions and not matt:
        context.unread.note(MATT)
    places: dict[str, TextureTransform] = {}

    def textured(name: str, lookup: Lookup, image: Tensor, factor: Tensor | float | None = None) -> Texture:
        places[name] = lookup.transform
        one = factor is None or bool((torch.as_tensor(factor) == 1.0).all())
        return Texture(image, wrap=lookup.wrap, filter=lookup.filter, factor=None if one else factor)

    def colored(name: str, factor: Tensor, lookup: Lookup | None) -> Tensor | Texture:
        return (
            factor
            if lookup is None
            else textured(name, lookup, context.textures.get(lookup.name, lookup.image), factor)
        )

    fields: dict[str, Any] = {"two_sided": bool(given.get("doubleSided", False))}
    fields["alpha_mode"] = str(given.get("alphaMode", "OPAQUE"))
    fields["base_color"] = colored(
        "base_color", torch.tensor(primitive.factor), primitive.lookup("baseColorTexture", base)
    )
    both = primitive.lookup("metallicRoughnessTexture", base)
    for name, channel in () if matt else (("roughness", slice(1, 2)), ("metallic", slice(2, 3))):
        fields[name] = factor = float(base.get(f"{name}Factor", 1.0))
        if both is not None and factor != 0.0:
            fields[name] = textured(name, both, context.textures.data(both.name, both.image, channel), factor)
    strength = float(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
    emission = strength * torch.tensor([float(f) for f in given.get("emissiveFactor", (0.0, 0.0, 0.0))])
    if bool((emission != 0).any()):
        fields["emission"] = colored("emission", emission, primitive.lookup("emissiveTexture"))
    bent = primitive.lookup("normalTexture")
    if bent is not None:
        fields["normal_map"] = textured("normal_map", bent, context.textures.data(bent.name, bent.image))
        fields["normal_scale"] = float(given["normalTexture"].get("scale", 1.0))
    if "occlusionTexture" in given:
        context.unread.note("occlusionTexture", "left out, for shadows are computed")
    return Material(**fields), places
