"""Light from all around: a constant, or an image of directions."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..check import check_shape
from .affine import Affine, check_rotation
from .lights import Light, LightPoints
from .material import numbers
from .textures import adjacent

UNIFORM_SHARE = 0.1  # the share of points of a light that is drawn evenly, so that what is dark has a gradient too


@dataclass(frozen=True, eq=False)
class Environment(Light):
    """Light from infinitely far away, from all around.

    Directions are drawn by what texels emit times their solid angle, a tenth of them evenly; for glossy surfaces also by how
    they scatter. Radiance below zero takes light away, as an optimisation may need. TypeError and ValueError name a wrong
    argument.

    Parameters
    ----------
    radiance : float, (C,) or (h, w, C)
        Constant, or a linear image of directions in the equirectangular projection: row 0 is around +Y, the last one around
        −Y, the middle is the direction −Z, and +X is to the right of it. Between the centres of texels it is bilinear, around
        the whole turn.
    rotation : (3, 3), default the identity
        Rotation from that frame to the world.
    visible : bool, default True
        Whether it is shown behind all surfaces where the scene has no background of its own.

    Examples
    --------
    >>> import edgegrad as eg
    >>> sky = eg.lights.Environment(1.0)
    >>> ball = eg.shapes.sphere(material=eg.Material(base_color=0.5))
    >>> camera = eg.Camera.look_at((0, 0, 4), (0, 0, 0), size=(9, 9))
    >>> image = eg.render(eg.Scene([ball], lights=[sky]), camera, spp=512)
    >>> round(float(image[0, 0, 0]), 1), round(float(image[4, 4, 0]), 1)
    (1.0, 0.5)
    """

    radiance: Tensor
    rotation: Tensor | None = None
    visible: bool = True

    infinite = True
    punctual = False

    def __post_init__(self) -> None:
        radiance = numbers("radiance", self.radiance)
        radiance = radiance.reshape(1) if radiance.dim() == 0 else radiance
        check_shape("radiance", radiance, ("C",), ("h", "w", "C"), fix="an image of one channel is radiance[..., None]")
        object.__setattr__(self, "radiance", radiance)
        if self.rotation is not None:
            self._set("rotation", 3, 3)
            assert self.rotation is not None
            check_rotation("rotation", self.rotation, "an environment can only be turned")
        if not isinstance(self.visible, bool):
            raise TypeError(f"visible: expected True or False, got {type(self.visible).__name__}")

    @property
    def channels(self) -> int | None:
        C = self.radiance.shape[-1]
        return C if C > 1 else None

    def _moved(self, affine: Affine) -> Environment:
        return self.replace(rotation=affine.rotated("an environment", self.rotation))

    @property
    def _size(self) -> tuple[int, int]:
        return (1, 1) if self.radiance.dim() == 1 else (self.radiance.shape[0], self.radiance.shape[1])

    @cached_property
    def _magnitude(self) -> Tensor:
        return self.radiance.detach().double().reshape(*self._size, -1).abs().mean(2)

    @cached_property
    def _cosines(self) -> Tensor:
        """Return the cosines (h + 1,) float64 of the angles from +Y at which rows begin and end."""
        h = self._size[0]
        return torch.arange(h + 1, device=self.radiance.device).double().mul(math.pi / h).cos()

    @property
    def _solid_angles(self) -> Tensor:
        """Return the solid angles (h, w) float64 of texels."""
        h, w = self._size
        return ((self._cosines[:-1] - self._cosines[1:]) * (2 * math.pi / w))[:, None].expand(h, w)

    @cached_property
    def _brightness(self) -> Tensor:
        """Return the magnitude (h · w,) float64 of texels plus a share of the mean, so that what is dark has a gradient,
        too."""
        mean = (self._magnitude * self._solid_angles).sum() / (4 * math.pi)
        mean = torch.where(mean > 0, mean, 1.0)
        return ((1 - UNIFORM_SHARE) * self._magnitude + UNIFORM_SHARE * mean).reshape(-1)

    @cached_property
    def _table(self) -> tuple[Tensor, Tensor]:
        """Return the running sum (h · w,) float64 of the probabilities of texels, and their pdf by solid angle."""
        with torch.no_grad():
            image = self._magnitude
            # The mean of the bilinear function over a texel.
            rows = torch.cat([image[:1], image, image[-1:]])
            image = (rows[:-2] + 6 * rows[1:-1] + rows[2:]) / 8
            image = (image.roll(1, 1) + 6 * image + image.roll(-1, 1)) / 8
            angle = self._solid_angles
            power = image * angle
            total = float(power.sum())
            share = angle / (4 * math.pi)
            chance = (1 - UNIFORM_SHARE) * power / total + UNIFORM_SHARE * share if total > 0 else share
            return chance.reshape(-1).cumsum(0), (chance / angle).reshape(-1)

    def draw(self, u: Tensor) -> LightPoints:
        running, density = self._table
        w = self._size[1]
        row, v = pick(running[w - 1 :: w].contiguous(), u[:, 0])
        index, x = pick(running, u[:, 1], row * w, w)
        return LightPoints(index, torch.stack([x, v], 1), density[index])

    def _own_directions(self, points: LightPoints) -> Tensor:
        """Return directions (N, 3) float64 in the frame of the image."""
        w = self._size[1]
        row, column = points.index // w, points.index % w
        y = torch.lerp(self._cosines[row], self._cosines[row + 1], points.uv[:, 1])
        phi = (2 * math.pi / w) * (column + points.uv[:, 0]) - math.pi
        across = (1 - y * y).clamp(min=0).sqrt()
        return torch.stack([across * phi.sin(), y, -across * phi.cos()], 1)

    def points_at(self, direction: Tensor) -> LightPoints:
        """Return the points at unit directions (N, 3) in the world; without derivatives."""
        with torch.no_grad():
            d = direction.double()
            x, y, z = (d if self.rotation is None else normalize(d @ self.rotation.to(d), dim=-1)).unbind(-1)
            h, w = self._size
            row = (torch.acos(y.clamp(-1, 1)) * (h / math.pi)).long().clamp(0, h - 1)
            top, bottom = self._cosines[row], self._cosines[row + 1]
            turn = (torch.atan2(x, -z) / (2 * math.pi) + 0.5) * w
            column = turn.long().clamp(0, w - 1)
            index = row * w + column
            uv = torch.stack([turn - column, (y - top) / (bottom - top)], 1).clamp(0, 1)
            return LightPoints(index, uv, self._table[1][index])

    def above(self, points: LightPoints, normal: Tensor) -> LightPoints:
        """Return the same directions, of which those below surfaces with unit normals (N, 3) are mirrored to above them.

        Each then stands for both.
        """
        with torch.no_grad():
            d, n = self.place(points), normal.detach().double()
            cosine = (d * n).sum(1, keepdim=True)
            mirrored = self.points_at(d - 2 * cosine * n)
            below = cosine[:, 0] < 0
            return LightPoints(
                torch.where(below, mirrored.index, points.index),
                torch.where(below[:, None], mirrored.uv, points.uv),
                points.density + mirrored.density,
            )

    def place(self, points: LightPoints) -> Tensor:
        d = self._own_directions(points)
        return d if self.rotation is None else normalize(d @ self.rotation.to(d).mT, dim=-1)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        radiance = self._looked_up(self._own_directions(points))
        return (radiance / points.density[:, None]).to(position)

    def _bilinear(self, texels: Tensor, row: Tensor, column: Tensor) -> Tensor:
        """Interpolate texels (h · w, C) at rows and columns (N,), around the whole turn."""
        h, w = self._size
        c0, r0 = column.detach().floor(), row.detach().floor()
        fc, fr = (column - c0).to(texels)[:, None], (row - r0).to(texels)[:, None]
        left, right = adjacent(c0, w, "repeat")
        above, below = (
            torch.lerp(texels[row * w + left], texels[row * w + right], fc) for row in adjacent(r0, h, "clamp")
        )
        return torch.lerp(above, below, fr)

    def towards(self, direction: Tensor) -> Tensor:
        """Return the radiance (N, C) from where directions (N, 3) in the world, of any length, point to; differentiable."""
        return self._looked_up(direction if self.rotation is None else direction @ self.rotation.to(direction))

    def _looked_up(self, d: Tensor) -> Tensor:
        if self.radiance.dim() == 1:
            return self.radiance.to(d).expand(len(d), -1)
        h, w = self._size
        x, y, z = d.double().unbind(-1)
        squared = x * x + z * z
        some = squared > 0  # the axis has no longitude
        x, z = torch.where(some, x, 0.0), torch.where(some, z, -1.0)
        across = torch.where(some, torch.where(some, squared, 1.0).sqrt(), 0.0)
        column = (torch.atan2(x, -z) / (2 * math.pi) + 0.5) * w - 0.5
        row = torch.atan2(across, y) / math.pi * h - 0.5
        return self._bilinear(self.radiance.to(d).reshape(h * w, -1), row, column)


def pick(running: Tensor, u: Tensor, first: Tensor | int = 0, count: int | None = None) -> tuple[Tensor, Tensor]:
    """Return which parts (N,) of the `count` from `first` on numbers u (N,) in [0, 1) pick, and how far within these. `running`
    (M,) is the running sum of their probabilities. The place within is (N,) in [0, 1], uniform as well."""
    u, count = u.detach().double(), len(running) if count is None else count
    first = torch.zeros_like(u, dtype=torch.int64) + first

    def before(k: Tensor) -> Tensor:
        return torch.where(k > 0, running[(k - 1).clamp(min=0)], 0.0)

    start = before(first)
    at = start + u * (before(first + count) - start)
    part = torch.searchsorted(running, at.contiguous(), right=True).clamp(min=first, max=first + count - 1)
    mass = before(part + 1) - before(part)
    within = ((at - before(part)) / torch.where(mass > 0, mass, 1.0)).clamp(0, 1)
    return part, torch.where(mass > 0, within, 0.5)
