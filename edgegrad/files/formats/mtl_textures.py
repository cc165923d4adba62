"""Textures that statements of MTL files name, with the options before the name."""

from __future__ import annotations

import re
from itertools import takewhile
from typing import NamedTuple

import numpy as np

from .context import LoadContext
from .part import FormatError
from .text import unquoted

# How many words follow an option, at most; those of -o, -s and -t are numbers, of which the last may be missing.
OPTIONS = {"-blendu": 1, "-blendv": 1, "-boost": 1, "-cc": 1, "-clamp": 1, "-imfchan": 1, "-texres": 1, "-bm": 1, "-type": 1,
           "-mm": 2, "-o": 3, "-s": 3, "-t": 3}  # fmt: skip
FEWER = ("-o", "-s", "-t")
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
            if option in FEWER:
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
    def plain(word: str) -> object:
        return float(word) if _is_number(word) else word

    return all(plain(a) == plain(b) for a, b in zip(values, NEUTRAL.get(option, ("",) * 3), strict=False))


def _pair(words: tuple[str, ...], default: float) -> tuple[float, float]:
    """Return the first two numbers. Raises FormatError."""
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
