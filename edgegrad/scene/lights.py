"""Lights: points, spots, directions; faces that emit; and irradiance as spherical harmonics."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import normalize

from ..check import check_fields, check_shape, values_visible
from .affine import Affine, check_rotation
from .material import numbers
from .rows import unit
from .spherical_harmonics import harmonics


class LightPoints(NamedTuple):
    """Points of a light by coordinates that stay while it moves, without derivatives.

    Attributes
    ----------
    index : (N,) int64
        Face of an emissive mesh, or texel of an environment.
    uv : (N, 2) float64
        The last two barycentrics there, or the place within the texel.
    density : (N,) float64
        pdf by world area or by solid angle; 1 for a light without extent.
    """

    index: Tensor  # pyright: ignore[reportIncompatibleMethodOverride]
    uv: Tensor
    density: Tensor

    def select(self, rows: Tensor | slice) -> LightPoints:
        """Return some of the points."""
        return LightPoints(self.index[rows], self.uv[rows], self.density[rows])


class Light:
    """Base class of all lights. Negative radiances, intensities and colours are not refused, because an optimisation may pass
    there: they take light away, and images stay linear in them."""

    casts = True  # whether it casts shadows
    infinite = False  # whether it is a direction
    punctual = True  # whether it is one point

    def replace(self, **fields: Any) -> Any:
        """Return this light with some fields replaced."""
        check_fields(self, fields)
        return dataclasses.replace(self, **fields)  # pyright: ignore[reportArgumentType]

    @property
    def channels(self) -> int | None:
        """Return C, or None for a light of one colour in all channels."""
        color = getattr(self, "color", None)
        return None if color is None or color.shape[0] == 1 else color.shape[0]

    def transformed(self, R: Tensor | None = None, t: Tensor | None = None, scale: Tensor | float = 1.0) -> Any:
        """Return the light, moved as Mesh.transformed moves meshes. Raises TypeError or ValueError."""
        return self._moved(Affine.from_arguments(R, t, scale, torch.empty(0, dtype=torch.float64)))

    def _moved(self, affine: Affine) -> Light:
        raise NotImplementedError

    def draw(self, u: Tensor) -> LightPoints:
        """Draw points from numbers u (N, 2), uniform in [0, 1)."""
        count = len(u)
        one = torch.ones(count, dtype=torch.float64, device=u.device)
        return LightPoints(torch.zeros(count, dtype=torch.int64, device=u.device), one[:, None].expand(-1, 2) * 0, one)

    def shows(self, points: LightPoints) -> Tensor:
        """Return (N,) bool whether the light is there, not masked by alpha."""
        return torch.ones(len(points.index), dtype=torch.bool, device=points.index.device)

    def place(self, points: LightPoints) -> Tensor:
        """Return (N, 3) where the points are; of an infinite light the unit directions towards them. Differentiable."""
        raise NotImplementedError

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        """Return the irradiance (N, C) or (N, 1) at normal incidence at positions (N, 3), over the pdf, with nothing in
        between. Differentiable."""
        raise NotImplementedError

    def incident(self, points: LightPoints, position: Tensor) -> Tensor:
        """Return unit directions (N, 3) from positions (N, 3), or (1, 3) where they are the same for all. Differentiable."""
        place = self.place(points)
        return place.to(position) if self.infinite else unit(place.double() - position.double()).to(position)

    # -- what the classes share ---------------------------------------------------------------------------------------

    def _set(self, name: str, *shape: int | str, unit: bool = False, fix: str = "") -> None:
        value = numbers(name, getattr(self, name))
        if shape == ():
            if value.numel() != 1:
                color = "; give the colour as color=" if name == "intensity" else ""
                raise ValueError(f"{name}: expected one number, got shape {tuple(value.shape)}{color}")
            value = value if value.dim() == 0 else value.reshape(())  # a leaf stays one
        else:
            check_shape(name, value, shape, fix=fix)
        if unit and values_visible(value) and not bool((value.detach() != 0).any()):
            raise ValueError(f"{name}: expected a direction, got zeros")
        object.__setattr__(self, name, value)

    def _set_power(self) -> None:
        self._set("intensity")
        if getattr(self, "color") is not None:  # noqa: B009
            self._set("color", "C", fix="a number for all channels is intensity=")

    def _power(self, like: Tensor) -> Tensor:
        """Return intensity times colour, (1, C) or (1, 1)."""
        intensity, color = (getattr(self, name) for name in ("intensity", "color"))
        power = intensity.to(like).reshape(1, 1)
        return power if color is None else power * color.to(like)


@dataclass(frozen=True, eq=False)
class DirectionalLight(Light):
    """Light from infinitely far away, such as the sun's. Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    direction : (3,)
        Direction in which it travels, world axes, of any length but zero.
    intensity : float, default 1
        Irradiance of a surface that it meets head-on, W/m² (glTF: lux).
    color : (C,), default ones
        Factor of the intensity.
    """

    direction: Tensor
    intensity: Tensor | float = 1.0
    color: Tensor | None = None

    infinite = True

    def __post_init__(self) -> None:
        self._set("direction", 3, unit=True)
        self._set_power()

    def _moved(self, affine: Affine) -> DirectionalLight:
        return self.replace(direction=affine.vectors(self.direction))

    def place(self, points: LightPoints) -> Tensor:
        return -direction_of(self.direction).expand(len(points.index), 3)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        return self._power(position).expand(len(position), -1)


@dataclass(frozen=True, eq=False)
class PointLight(Light):
    """Light from one point in all directions. Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    position : (3,)
        World units.
    intensity : float, default 1
        W/sr (glTF: cd), for distances in world units.
    color : (C,), default ones
        Factor of the intensity.
    """

    position: Tensor
    intensity: Tensor | float = 1.0
    color: Tensor | None = None

    def __post_init__(self) -> None:
        self._set("position", 3)
        self._set_power()

    def _moved(self, affine: Affine) -> PointLight:
        # The irradiance stays the same in other units of length.
        return self.replace(position=affine.points(self.position), intensity=self.intensity * affine.area)

    def place(self, points: LightPoints) -> Tensor:
        return self.position.expand(len(points.index), 3)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        return self._power(position) * inverse_square(self.position.to(position) - position)


@dataclass(frozen=True, eq=False)
class SpotLight(Light):
    """Light from one point in a cone, as in glTF (KHR_lights_punctual).

    Between the angles the intensity falls by the square of (cos θ − cos outer) / (cos inner − cos outer). Raises TypeError or
    ValueError that names the argument.

    Parameters
    ----------
    position : (3,)
        World units.
    direction : (3,)
        Direction of the cone's axis, away from the light, of any length but zero.
    intensity : float, default 1
        W/sr (glTF: cd) on the axis, for distances in world units.
    color : (C,), default ones
        Factor of the intensity.
    inner_angle : float, default 0
        Angle from the axis in radians up to which it is as bright as there.
    outer_angle : float, default π/4
        Angle from the axis in radians where it ends: 0 ≤ inner < outer ≤ π/2.
    """

    position: Tensor
    direction: Tensor
    intensity: Tensor | float = 1.0
    color: Tensor | None = None
    inner_angle: Tensor | float = 0.0
    outer_angle: Tensor | float = math.pi / 4

    def __post_init__(self) -> None:
        self._set("position", 3)
        self._set("direction", 3, unit=True)
        self._set_power()
        self._set("inner_angle")
        self._set("outer_angle")
        if not values_visible(*(torch.as_tensor(angle) for angle in (self.inner_angle, self.outer_angle))):
            return
        inner, outer = (float(torch.as_tensor(angle).detach()) for angle in (self.inner_angle, self.outer_angle))
        if not 0 <= inner < outer <= math.pi / 2 + 1e-6:
            raise ValueError(
                f"inner_angle: expected 0 ≤ inner_angle < outer_angle ≤ π/2, got {inner:.6g} and {outer:.6g}; angles are radians "
                "from the axis"
            )

    def _moved(self, affine: Affine) -> SpotLight:
        return self.replace(
            position=affine.points(self.position),
            direction=affine.vectors(self.direction),
            intensity=self.intensity * affine.area,
        )

    def place(self, points: LightPoints) -> Tensor:
        return self.position.expand(len(points.index), 3)

    def arriving(self, points: LightPoints, position: Tensor) -> Tensor:
        away = position - self.position.to(position)
        cosine = unit(away.double()).to(position) @ direction_of(self.direction).to(position)
        inner, outer = (torch.as_tensor(a).to(position).cos() for a in (self.inner_angle, self.outer_angle))
        scale = 1 / (inner - outer).clamp(min=1e-3)  # glTF's own limit
        ramp = ((cosine - outer) * scale).clamp(0, 1) ** 2
        return self._power(position) * ramp[:, None] * inverse_square(away)


def direction_of(direction: Tensor) -> Tensor:
    """Return the unit vector (3,) of one of any length but zero. It is scaled first, because squares of short ones vanish and
    of long ones overflow."""
    return normalize(direction / direction.detach().abs().max(), dim=0)


def inverse_square(v: Tensor) -> Tensor:
    """Return 1/|v|² (N, 1) of vectors (N, 3); zero, without a derivative, where they have no direction."""
    squared = (v * v).sum(-1, keepdim=True)
    some = squared > 0
    return torch.where(some, 1 / torch.where(some, squared, 1.0), 0.0)


@dataclass(frozen=True, eq=False)
class SphericalHarmonics(Light):
    """Irradiance by the direction of the normal, without shadows: cheap and smooth.

    It is scattered by the Lambertian part of a material alone. Raises TypeError or ValueError that names the argument.

    Parameters
    ----------
    coefficients : (9, C)
        E(n) = Σ c_i Y_i(n), in the order Y_00, Y_1−1, Y_10, Y_11, Y_2−2 … Y_22 of the real, orthonormal spherical harmonics
        (Ramamoorthi and Hanrahan 2001): coefficients of irradiance, not of radiance.
    rotation : (3, 3), default the identity
        Rotation from the frame of the coefficients to the world.
    """

    coefficients: Tensor
    rotation: Tensor | None = None

    casts = False
    infinite = True

    def __post_init__(self) -> None:
        self._set("coefficients", 9, "C", fix="a column for each channel: of one, coefficients[:, None]")
        if self.rotation is not None:
            self._set("rotation", 3, 3)
            assert self.rotation is not None
            check_rotation("rotation", self.rotation, "spherical harmonics can only be turned")

    @property
    def channels(self) -> int | None:
        return self.coefficients.shape[1] if self.coefficients.shape[1] > 1 else None

    def _moved(self, affine: Affine) -> SphericalHarmonics:
        return self.replace(rotation=affine.rotated("spherical harmonics", self.rotation))

    def irradiance(self, normal: Tensor) -> Tensor:
        """Return the irradiance (N, C) of surfaces with unit normals (N, 3)."""
        n = normal if self.rotation is None else normal @ self.rotation.to(normal)
        return torch.stack(harmonics(n), -1) @ self.coefficients.to(normal)
