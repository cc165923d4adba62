"""Where objects and what covers them are at a time, which is counted in frames."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

# Of rotation vectors in radians, and of places in sizes of the object at NEAR sizes of distance. At speed 1 objects turn by some
# 2.5° and move by some 6 pixels a frame.
AMPLITUDE = 0.45, 0.45, 0.45, 0.32, 0.22, 0.25
NEAR = 2.6
RATES = 0.04, 0.13  # radians a frame at speed 1


def smooth_step(x: float) -> float:
    """Return a step from 0 at x = 0 to 1 at x = 1 with slope 0 at both ends."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@dataclass(frozen=True)
class Visit:
    """How far something is from its place: not at all from `begin` to `end`, before and after that by `away`, with ways of `ramp`
    frames between."""

    begin: float
    end: float
    ramp: float
    away: np.ndarray  # (3,) world units

    def offset(self, time: float) -> np.ndarray:
        outside = max((self.begin - time) / self.ramp, (time - self.end) / self.ramp)
        return self.away * smooth_step(outside)


@dataclass(frozen=True)
class Absence:
    """An object leaves the picture along `out` from `begin` on, and comes back from `into`, rotated, until `end`."""

    begin: float
    end: float
    ramp: float  # frames of each way
    out: np.ndarray  # (3,) world units
    into: np.ndarray
    turn: np.ndarray  # (3,) rotation vector

    def offset(self, time: float) -> np.ndarray:
        leaving, coming = (time - self.begin) / self.ramp, (self.end - time) / self.ramp
        return self.out * smooth_step(leaving) if self._first(time) else self.into * smooth_step(coming)

    def rotation(self, time: float) -> Rotation:
        return Rotation.from_rotvec(np.zeros(3) if self._first(time) else self.turn)

    def _first(self, time: float) -> bool:
        return time < (self.begin + self.end) / 2


@dataclass(frozen=True)
class Motion:
    """A rotation and a place about which an object swings: each coordinate is a sum of two sines of time."""

    first: Rotation
    middle: np.ndarray  # (3,)
    amplitude: np.ndarray  # (6,) of a rotation vector and of the place, world units
    rate: np.ndarray  # (6, 2) radians a frame
    phase: np.ndarray  # (6, 2)
    absence: Absence | None = None

    @staticmethod
    def drawn(rng: np.random.Generator, first: Rotation, middle: np.ndarray, scale: float, speed: float) -> Motion:
        """Draw a motion; `scale` is the length of a swing in world units for a size of 1 at the distance NEAR."""
        amplitude = np.array(AMPLITUDE) * np.r_[np.ones(3), np.full(3, scale)]
        rate, phase = speed * rng.uniform(*RATES, (6, 2)), rng.uniform(0.0, 2.0 * math.pi, (6, 2))
        return Motion(first, middle, amplitude, rate, phase)

    def at(self, time: float) -> np.ndarray:
        """Return the pose (4, 4) of the object's centre."""
        swing = self.amplitude * np.sin(self.rate * time + self.phase).sum(1) / 1.4
        R, place = Rotation.from_rotvec(swing[:3]) * self.first, self.middle + swing[3:]
        if self.absence is not None:
            R, place = R * self.absence.rotation(time), place + self.absence.offset(time)
        M = np.eye(4)
        M[:3, :3], M[:3, 3] = R.as_matrix(), place
        return M
