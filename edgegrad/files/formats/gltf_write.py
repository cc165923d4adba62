"""Appearance of a mesh in the terms of glTF: its material, textures, and attributes of vertices."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from ...scene.appearance import coordinates
from ...scene.material import Material, Texture
from ...scene.mesh import DEFAULT_RADIANCE, Mesh
from ..image import to_bytes
from .gltf import MATT, UNLIT
from .gltf_texture import LINEAR, NEAREST, WRAPS

FILTERS = {"linear": (LINEAR, LINEAR), "nearest": (NEAREST, NEAREST), "mipmap": (LINEAR, 9987)}  # near and far
UNEVEN = 1e-3  # lengths that differ by so little are rounded
WRAP_CODES = {name: code for code, name in WRAPS.items()}


class GltfAppearance:
    """The appearance of a mesh in the terms of glTF. With `unlit`, a mesh without a material is marked as unlit
    (KHR_materials_unlit), so that it is read back without one."""

    def __init__(self, mesh: Mesh, unlit: bool = False) -> None:
        self.mesh = mesh
        self.lost: list[str] = []
        self.images: dict[str, np.ndarray] = {}  # 8 bit, by the field of the material
        self.textures: dict[str, Texture] = {}  # how they lie, by the same names
        self.sets: list[tuple[Tensor, Tensor]] = []  # texture coordinates, and their indices
        self.colors: tuple[Tensor, Tensor] | None = None  # rows (N, 3), and their indices (F, 3)
        self.material: dict[str, Any] = {}  # as glTF has it; empty where the mesh has none
        if mesh.normals is not None:
            lengths = mesh.normals.detach().norm(dim=1)
            if float(lengths.max()) > (1.0 + UNEVEN) * float(lengths.min()):
                self.lost.append("normals of other lengths than 1")  # which weigh them between vertices
        if mesh.uvs is not None:
            self._set(Texture(torch.zeros(1, 1, 1)))
        material = mesh.material
        base, factor = self._base(material or Material())
        opacity = self._alpha(base)
        if material is None and not self.images and opacity is None and not unlit:
            return
        four = [*factor.expand(3).tolist(), 1.0 if opacity is None else opacity]
        self.material = {"pbrMetallicRoughness": {"baseColorFactor": four}}
        if opacity is not None:
            self.material["alphaMode"] = mode = "MASK" if material is None else material.alpha_mode
            self.material |= {"alphaCutoff": max(0.0, mesh.alpha_cutoff)} if mode == "MASK" else {}
        if material is None:
            self.material["pbrMetallicRoughness"] |= {"metallicFactor": 0.0, "roughnessFactor": 1.0}
            self.material |= {"extensions": {UNLIT: {}}} if unlit else {}
            return
        self.material["doubleSided"] = material.two_sided
        self._surface(material)
        self._emission(material)
        if material.normal_map is not None:
            image, factor = self._values("material.normal_map", material.normal_map)
            self._add("normalTexture", material.normal_map, to_bytes(image * factor, linear=True))
            self.material["normalTexture"] = {"scale": float(material.normal_scale)}

    # -- appearance -------------------------------------------------------------------------------------------------

    def _base(self, material: Material) -> tuple[Texture | None, Tensor]:
        """Return texture and factor of the base colour, apart from colours of vertices."""
        mesh, given, texture = self.mesh, material.base_color, None
        if mesh.texture is not None:
            texture = Texture(mesh.texture, mesh.uvs, mesh.uv_faces, mesh.wrap, mesh.filter)
            if mesh.material is None and mesh.filter == "mipmap":  # which is read as linear where it is not lit
                self.lost.append("filter 'mipmap' without a material")
        each, corners = _colors(mesh)
        if isinstance(given, Texture):
            if texture is None:
                texture, given = given, None
            else:
                self.lost.append("material.base_color beside a texture")
                given = _mean(given)
        elif isinstance(given, Tensor) and given.dim() == 2:
            if corners is None:
                each, corners, given = "material.base_color", (given, mesh.faces), None
            else:
                self.lost.append(f"material.base_color of vertices beside {each}")
                given = _mean(given)
        if corners is not None:
            self.colors = self._within(each, corners[0]).expand(-1, 3), corners[1]
        nothing = texture is None and corners is None
        factor = torch.tensor(DEFAULT_RADIANCE if nothing else 1.0) if given is None else torch.as_tensor(given)
        factor = self._within("material.base_color", factor.detach().cpu().double())
        if texture is not None:
            name = "texture" if mesh.texture is not None else "material.base_color"
            image, own = self._values(name, texture)
            factor = factor * own
            self._add("baseColorTexture", texture, to_bytes(image))
        return texture, factor

    def _alpha(self, base: Texture | None) -> float | None:
        """Write alpha as the fourth channel of the base colour's texture, and return that of its factor; None without alpha."""
        mesh = self.mesh
        if mesh.alpha is None:
            return None
        alpha = self._within("alpha", mesh.alpha.detach().cpu().double())
        if alpha.numel() == 1:
            return float(alpha)
        # Mipmaps are linear where texels are larger than pixels.
        near = base is not None and FILTERS[base.filter][0] == FILTERS[mesh.filter][0]
        lies = Texture(
            alpha[..., None], None, None, mesh.wrap, base.filter if base is not None and near else mesh.filter
        )
        if base is None and mesh.material is None and self.colors is not None:
            self.lost.append("alpha beside colours of vertices")  # load_mesh() refuses a texture there
            return None
        if base is not None and not self._can_share_image(base, lies):
            self.lost.append("alpha that lies otherwise than the base colour's texture")
            return None
        if base is None:
            self._add("baseColorTexture", lies, np.full((*alpha.shape, 3), 255, np.uint8))
        fourth = to_bytes(alpha[..., None], linear=True)[..., :1]
        self.images["baseColorTexture"] = np.concatenate([self.images["baseColorTexture"], fourth], -1)
        return 1.0

    def _surface(self, material: Material) -> None:
        base = self.material["pbrMetallicRoughness"]
        if not material.is_glossy:
            base["metallicFactor"] = 0.0
            self.material["extensions"] = {MATT: {"specularFactor": 0.0}}
            return
        values: dict[str, Any] = {"roughness": material.roughness, "metallic": material.metallic}
        defaults = {"roughness": 1.0, "metallic": 0.0}
        textures = {name: value for name, value in values.items() if isinstance(value, Texture)}
        if len(textures) == 2 and not self._can_share_image(textures["roughness"], textures["metallic"]):
            self.lost.append("material.metallic that lies otherwise than material.roughness")
            values["metallic"] = _mean(textures.pop("metallic"))
        image = None
        for channel, name in enumerate(values, start=1):  # green, blue
            if name in textures:
                texels, factor = self._values(f"material.{name}", textures[name])
                image = torch.ones(*texels.shape[:2], 3).double() if image is None else image
                image[..., channel] = texels[..., 0]
            else:
                factor = self._constant(name, defaults[name] if values[name] is None else values[name])
                factor = self._within(f"material.{name}", factor)
            base[f"{name}Factor"] = float(factor)
        if image is not None:
            self._add("metallicRoughnessTexture", next(iter(textures.values())), to_bytes(image, linear=True))

    def _emission(self, material: Material) -> None:
        given = material.emission
        if given is None:
            return
        if isinstance(given, Texture):
            image = given.image.detach().cpu().double()
            factor = torch.as_tensor(1.0 if given.factor is None else given.factor).detach().cpu().double()
            brightest = max(1.0, float(image.max()))
            image, factor = self._above_zero(image / brightest), factor * brightest
            self._add("emissiveTexture", given, to_bytes(image))
        else:
            factor = self._constant("emission", given)
        factor = self._above_zero(factor).expand(3)
        strength = max(1.0, float(factor.max()))
        self.material["emissiveFactor"] = (factor / strength).tolist()
        if strength > 1.0:
            self.material.setdefault("extensions", {})["KHR_materials_emissive_strength"] = {
                "emissiveStrength": strength
            }

    def _constant(self, name: str, value: Tensor | float) -> Tensor:
        """Return a constant of shape (), (1,) or (3,)."""
        value = torch.as_tensor(value).detach().cpu().double()
        if value.dim() < 2:
            return value
        self.lost.append(f"material.{name} of vertices")
        return _mean(value)

    def _values(self, name: str, texture: Texture) -> tuple[Tensor, Tensor]:
        """Return image and factor, both from 0 to 1; the factor goes into the image where one of them is not."""
        image = texture.image.detach().cpu().double()
        factor = torch.as_tensor(1.0 if texture.factor is None else texture.factor).detach().cpu().double()
        if _is_within(image) and _is_within(factor):
            return image, factor
        return self._within(name, image * factor), torch.ones((), dtype=torch.float64)

    def _within(self, name: str, values: Tensor) -> Tensor:
        if not _is_within(values):
            self.lost.append(f"{name} beyond 0 … 1")
        return values.clamp(0.0, 1.0)

    def _above_zero(self, emission: Tensor) -> Tensor:
        if bool((emission < 0).any()):
            self.lost.append("material.emission below 0")
        return emission.clamp(min=0.0)

    # -- where it lies ----------------------------------------------------------------------------------------------

    def _add(self, field: str, texture: Texture, image: np.ndarray) -> None:
        self.images[field], self.textures[field] = image, texture
        self._set(texture)

    def _set(self, texture: Texture) -> int:
        """Return the number of the texture's coordinates."""
        given = coordinates(self.mesh, texture)
        known = next((k for k, others in enumerate(self.sets) if _are_equal(given, others)), None)
        if known is not None:
            return known
        self.sets.append(given)
        return len(self.sets) - 1

    def _can_share_image(self, a: Texture, b: Texture) -> bool:
        same = [(t.image.shape[:2], t.wraps, t.filter) for t in (a, b)]
        return same[0] == same[1] and _are_equal(coordinates(self.mesh, a), coordinates(self.mesh, b))

    # -- in the file ------------------------------------------------------------------------------------------------

    def write(self, tree: dict[str, Any], primitive: dict[str, Any]) -> None:
        """Write into the JSON that trimesh made, where attributes of vertices have names of their own, and the material is
        images alone."""
        primitive["attributes"] = {name.lstrip("_"): index for name, index in primitive["attributes"].items()}
        if not self.material:
            return
        material = tree["materials"][primitive["material"]]
        material.pop("name", None)
        for field, texture in self.textures.items():
            near, far = FILTERS[texture.filter]
            wraps = [WRAP_CODES[wrap] for wrap in texture.wraps]
            samplers = tree.setdefault("samplers", [])
            samplers.append({"magFilter": near, "minFilter": far, "wrapS": wraps[0], "wrapT": wraps[1]})
            reference = material.get(field) or material["pbrMetallicRoughness"][field]
            reference["texCoord"] = self._set(texture)
            tree["textures"][reference["index"]]["sampler"] = len(samplers) - 1
        _merge(material, self.material)


def _merge(into: dict[str, Any], given: dict[str, Any]) -> None:
    for name, value in given.items():
        if isinstance(value, dict):
            _merge(into.setdefault(name, {}), value)
        else:
            into[name] = value


def _colors(mesh: Mesh) -> tuple[str, tuple[Tensor, Tensor] | None]:
    """Return kind, rows (N, C) and indices (F, 3) of colours other than a texture."""
    F = len(mesh.faces)
    if mesh.colors is not None:
        return "colors", (mesh.colors, mesh.faces)
    if mesh.face_colors is not None:
        return "face_colors", (mesh.face_colors, torch.arange(F)[:, None].expand(-1, 3))
    if mesh.corner_colors is not None:
        return "corner_colors", (mesh.corner_colors.flatten(0, 1), torch.arange(3 * F).reshape(F, 3))
    return "", None


def split(appearance: GltfAppearance) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Return vertices, faces, and attributes of vertices with a leading _, as trimesh expects; a glTF has one index for all."""
    mesh = appearance.mesh
    given: dict[str, tuple[Tensor, Tensor]] = {"": (mesh.verts, mesh.faces)}
    if mesh.normals is not None:
        unit = torch.nn.functional.normalize(mesh.normals.detach().double(), dim=-1)
        given["_NORMAL"] = unit, mesh.faces if mesh.normal_faces is None else mesh.normal_faces
    for number, (uvs, uv_faces) in enumerate(appearance.sets):
        down = torch.stack([uvs[:, 0], 1.0 - uvs[:, 1].double()], 1)
        given[f"_TEXCOORD_{number}"] = down, uv_faces
    if appearance.colors is not None:
        given["_COLOR_0"] = appearance.colors
    rows = {name: values.detach().cpu().float().numpy() for name, (values, _) in given.items()}
    index = np.stack([faces.cpu().long().numpy().reshape(-1) for _, faces in given.values()], 1)
    corners = np.arange(len(index))
    if bool((index == index[:, :1]).all()):  # one already
        kept, faces = np.arange(len(mesh.verts))[:, None].repeat(index.shape[1], 1), index[:, 0]
    elif bool((index == corners[:, None]).all(0).any()):  # all corners differ
        kept, faces = index, corners
    else:
        kept, faces = np.unique(index, axis=0, return_inverse=True)
    found = {name: values[kept[:, k]] for k, (name, values) in enumerate(rows.items())}
    return found.pop(""), faces.reshape(-1, 3), found


def _are_equal(these: tuple[Tensor, Tensor], others: tuple[Tensor, Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(these, others, strict=True))


def _mean(value: Tensor | Texture) -> Tensor:
    """Return the mean, which stands for the values where glTF has one number."""
    if isinstance(value, Texture):
        return value.image.mean((0, 1)) * torch.as_tensor(1.0 if value.factor is None else value.factor)
    return value.mean(0)


def _is_within(values: Tensor) -> bool:
    return bool(((values >= 0.0) & (values <= 1.0)).all())
