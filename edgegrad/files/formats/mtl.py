"""Material libraries of OBJ files (MTL), and the appearance that their materials give a part."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import takewhile
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from ...scene.material import Material
from .context import LoadContext
from .part import FormatError
from .text import as_utf8, unquoted

READ = {"kd", "map_kd", "ke", "ks", "ns", "illum", "d", "tr", "map_d", "pr", "pm"}
# These change no picture: ambient light, the index of refraction (dielectrics have that of 1.5), hints.
HARMLESS = {"ka", "ni", "sharpness", "map_aat"}
# Only lit scenes would use these, which nothing reads: maps, and numbers that have no effect at this value.
MAPS = {
    "map_ka", "map_ks", "map_ns", "map_ke", "map_pr", "map_pm", "map_ps", "map_bump", "bump", "norm", "disp", "decal",
    "refl", "map_refl", "map_tr", "map_tf", "map_ni",
}  # fmt: skip
NUMBERS = {"tf": 1.0, "ps": 0.0, "pc": 0.0, "pcr": 0.0, "aniso": 0.0, "anisor": 0.0}


class Library:
    """The materials of an OBJ file; parts share images, and materials that scatter light equally."""

    def __init__(self, context: LoadContext) -> None:
        self.context = context
        self.materials: dict[str, dict[str, str]] = {}  # what follows each keyword, which is in lower case
        self.files: dict[str, str] = {}  # by material
        self.images: dict[str, Any] = {}
        self.scattering: dict[object, Material] = {}

    def read(self, data: bytes, file: str) -> None:
        current: dict[str, str] = {}
        for line in as_utf8(data).decode().split("\n"):
            keyword, rest = [*line.strip().split(None, 1), "", ""][:2]
            if keyword.lower() == "newmtl":
                current = self.materials[rest] = {}
                self.files[rest] = file
            elif rest and not keyword.startswith("#"):  # some programs write keywords with nothing after them
                current[keyword.lower()] = rest

    def appearance(self, name: str | None, uvs: np.ndarray | None, count: int) -> dict[str, Any]:
        """Return the appearance fields of a part of `count` triangles; without a material, those of none. Raises FormatError,
        which names the material, or FileNotFoundError."""
        given = self.materials.get(name or "", {})
        try:
            return self._appearance(given, uvs, count)
        except FormatError as error:
            raise FormatError(f"newmtl {name} in {self.files.get(name or '')}: {error}") from error.__cause__

    def _appearance(self, given: Mapping[str, str], uvs: np.ndarray | None, count: int) -> dict[str, Any]:
        appearance = self._base(given, uvs, count)
        self._note_unread(given)
        if self.context.options.lit:
            appearance |= {"material": self._material(given), "alpha": self._alpha(given, appearance)}
            if appearance["alpha"] is not None and appearance["alpha"].numel() == 1 and appearance.get("uvs") is None:
                appearance |= {"uvs": np.zeros((1, 2), np.float32), "uv_faces": np.zeros((count, 3), np.int64)}
        return appearance

    def _base(self, given: Mapping[str, str], uvs: np.ndarray | None, count: int) -> dict[str, Any]:
        """Return map_Kd times Kd, as the format says, or Kd alone."""
        color = None
        if given.get("kd", "").split()[:1] in (["spectral"], ["xyz"]):
            self.context.unread.note(f"Kd {given['kd']}", "not read")
        elif color := _numbers(given, "kd"):
            if len(color) not in (1, 3):
                raise FormatError(
                    f"expected one number or three for Kd in the material, got {given['kd']!r}; repair it"
                )
            if min(color) < 0.0:
                raise FormatError(f"expected numbers from 0 on for Kd in the material, got {given['kd']!r}; repair it")
            color = np.broadcast_to(color, 3).tolist()
        if "map_kd" in given:
            if color and not any(color):
                self.context.unread.note("map_Kd times a Kd of 0", "black, as the format says; set Kd to 1 1 1")
            texture = MtlTexture.from_statement(given["map_kd"], "map_Kd", self.context)
            texels = self.context.textures.get(texture.name, self._image(texture.name), tuple(color or (1.0, 1.0, 1.0)))
            return {"texture": texels, "wrap": texture.wrap} | (
                {} if uvs is None else {"uvs": texture.transformed_uvs(uvs)}
            )
        return {} if not color else {"face_colors": torch.tensor(color, dtype=torch.float32).repeat(count, 1)}

    def _image(self, name: str) -> Any:
        if name not in self.images:
            self.images[name] = self.context.folder.image(name)
        return self.images[name]

    def _note_unread(self, given: Mapping[str, str]) -> None:
        """Note keywords that a lit scene would need, and unknown ones."""
        for name in given:
            if name in READ | HARMLESS or (name in MAPS | set(NUMBERS) and not self.context.options.lit):
                continue
            if name not in NUMBERS or any(v != NUMBERS[name] for v in _numbers(given, name)):
                self.context.unread.note(name)

    def _material(self, given: Mapping[str, str]) -> Material:
        """Return a Lambertian material or, with highlights, a dielectric whose roughness follows from Ns. Phong's exponent Ns
        is as wide as a lobe of α² = 2 / (Ns + 2), and α = roughness² (Walter et al. 2007, section 5.2)."""
        metallic, roughness = _number(given, "pm"), _number(given, "pr")
        shiny = _number(given, "illum", 2.0) not in (0.0, 1.0) and any(_numbers(given, "ks"))
        if metallic is None and roughness is None and shiny:
            self.context.unread.note("Ks", "a dielectric of 4 %, by Ns")
            exponent = _number(given, "ns", 0.0)
            assert exponent is not None
            roughness = (2.0 / (max(exponent, 0.0) + 2.0)) ** 0.25
        emission = tuple(_numbers(given, "ke"))
        key = metallic, roughness, emission if any(emission) else None
        if key not in self.scattering:
            glow = torch.tensor(np.broadcast_to(emission, 3).copy(), dtype=torch.float32) if any(emission) else None
            self.scattering[key] = Material(metallic=metallic, roughness=roughness, emission=glow)
        return self.scattering[key]

    def _alpha(self, given: Mapping[str, str], appearance: dict[str, Any]) -> Tensor | None:
        """Return alpha (h, w) float32: d times map_d, an image's alpha or else its grey, where either is less than one."""
        opacity = _number(given, "d", 1.0)
        assert opacity is not None
        if _number(given, "tr", 0.0):
            self.context.unread.note("Tr", "left out, for writers differ in what 1 means; d says it")
        if opacity < 1.0:
            self.context.unread.note("d", "shown where it is 0.5 or more, cut out elsewhere")
        if "map_d" not in given:
            return torch.full((1, 1), opacity) if opacity < 0.5 else None
        texture = MtlTexture.from_statement(given["map_d"], "map_d", self.context)
        if "map_kd" not in given:
            appearance["wrap"] = texture.wrap
            if appearance.get("uvs") is not None:
                appearance["uvs"] = texture.transformed_uvs(appearance["uvs"])
        elif texture.transform != MtlTexture.from_statement(given["map_kd"], "map_Kd", self.context).transform:
            self.context.unread.note("options of map_d", "those of map_Kd")
        image = self._image(texture.name)
        grey = self.context.textures.data(texture.name, image, slice(0, 1))[..., 0]
        own = self.context.textures.alpha(image, opacity)
        return opacity * grey if own is None else own


def _numbers(given: Mapping[str, str], name: str) -> list[float]:
    """Return the numbers after a keyword, up to a comment. Raises FormatError."""
    try:
        values = [float(word) for word in given.get(name, "").split("#")[0].split()]
    except ValueError as error:
        raise FormatError(f"expected numbers for {name} in the material, got {given[name]!r}; repair it") from error
    if not np.isfinite(values).all():
        raise FormatError(f"expected finite numbers for {name} in the material, got {given[name]!r}; repair it")
    return values


def _number(given: Mapping[str, str], name: str, default: float | None = None) -> float | None:
    values = _numbers(given, name)
    return values[0] if values else default


# How many words follow an option, at most; those of -o, -s and -t are numbers, of which the last may be missing.
OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-bm": 1, "-type": 1,
           "-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # fmt: skip
MAY_LACK_THE_LAST = ("-o", "-s", "-t")
# These are applied, are hints on filters, or concern bumps alone.
APPLIED = ("-o", "-s", "-clamp", "-blendu", "-blendv", "-boost", "-texres", "-bm")
# The others change nothing with these values; for -imfchan, grey comes from brightness.
NEUTRAL = {"-cc": ("off",), "-mm": ("0", "1"), "-t": ("0", "0", "0"), "-imfchan": ("l",)}


class MtlTexture(NamedTuple):
    """A texture of a material library, and how it lies on the mesh."""

    name: str
    scale: tuple[float, float] = (1.0, 1.0)  # of texture coordinates, before
    offset: tuple[float, float] = (0.0, 0.0)  # this is added
    wrap: tuple[str, str] = ("repeat", "repeat")

    @classmethod
    def from_statement(cls, statement: str, keyword: str, context: LoadContext) -> MtlTexture:
        """Parse a statement such as `map_Kd -s 2 2 1 wood grain.png`, without the keyword. Notes unread options. Raises
        FormatError."""
        options, rest = dict[str, tuple[str, ...]](), statement.strip()
        while (option := rest.split(None, 1)[0].lower() if rest else "") in OPTIONS:
            words = rest.split(None, OPTIONS[option] + 1)[1:]
            values = words[: OPTIONS[option]]
            if option in MAY_LACK_THE_LAST:
                values = list(takewhile(_is_number, values))
            options[option] = tuple(value.lower() for value in values)
            rest = rest.split(None, len(values) + 1)[-1] if len(words) > len(values) else ""
        rest = unquoted(rest)
        if re.match("-[a-z]", option) and not context.folder.holds(rest):
            known = ", ".join(sorted(OPTIONS))
            raise FormatError(
                f"expected options of a texture ({known}), got {option} in {keyword} {statement!r}; remove it"
            )
        if not rest:
            raise FormatError(
                f"expected the name of an image after {keyword} {statement!r}, got none; repair the material"
            )
        for option, values in options.items():
            if option not in APPLIED and not _is_neutral(option, values):
                context.unread.note(" ".join([keyword, option, *values]))
        wrap = "clamp" if options.get("-clamp") == ("on",) else "repeat"
        return cls(rest, _pair(options.get("-s", ()), 1.0), _pair(options.get("-o", ()), 0.0), (wrap, wrap))

    @property
    def transform(self) -> tuple[object, ...]:
        return self.scale, self.offset, self.wrap

    def transformed_uvs(self, uvs: np.ndarray) -> np.ndarray:
        """Return texture coordinates (N, 2) scaled and shifted for this texture."""
        if self.scale == (1.0, 1.0) and self.offset == (0.0, 0.0):
            return uvs
        return (uvs.astype(np.float64) * self.scale + self.offset).astype(np.float32)


def _is_neutral(option: str, values: tuple[str, ...]) -> bool:
    def number_or_word(word: str) -> object:
        return float(word) if _is_number(word) else word

    return all(
        number_or_word(a) == number_or_word(b) for a, b in zip(values, NEUTRAL.get(option, ("",) * 3), strict=False)
    )


def _pair(words: tuple[str, ...], default: float) -> tuple[float, float]:
    values = [float(word) for word in words]
    if not np.isfinite(values).all():
        raise FormatError(
            f"expected finite numbers for the options of a texture, got {' '.join(words)}; repair the material"
        )
    return values[0] if values else default, values[1] if len(values) > 1 else default


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
