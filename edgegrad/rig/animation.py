"""Animations of joints and morphs, by keys over time (glTF 2.0, section 3.11 and appendix C)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..check import as_double, as_tensor, check_choice, check_finite, check_shape
from .joints import Joints
from .rotations import roma

PATHS = ("translation", "rotation", "scale", "weights")
ROUNDED = 0.01  # what rounding to normalised bytes changes of a quaternion's length, at most
INTERPOLATIONS = ("LINEAR", "STEP", "CUBICSPLINE")


@dataclass(frozen=True, eq=False)
class Channel:
    """The motion that an animation gives one joint, or some morphs.

    Parameters
    ----------
    path : "translation", "rotation", "scale" or "weights"
        The first three are within the parent and in place of what is at rest; the last is of morphs.
    target : int
        Place of the joint, or of the first morph.
    times : (K,)
        Seconds, ascending.
    values : (K, n), or (K, 3, n) for a CUBICSPLINE
        3 numbers, 4 of a unit quaternion x, y, z, w, or as many as there are morphs. A CUBICSPLINE has the tangent that it
        comes in by, the value, and the tangent that it goes out by. Quaternions of length 1 to 0.01, as normalised bytes have
        it, are divided by it, with their tangents; others are refused.
    interpolation : "LINEAR", "STEP" or "CUBICSPLINE", default "LINEAR"
        "LINEAR" takes the shorter arc of rotations.
    """

    path: str
    target: int
    times: Tensor
    values: Tensor
    interpolation: str = "LINEAR"

    def __post_init__(self) -> None:
        check_choice("path", self.path, PATHS)
        check_choice("interpolation", self.interpolation, INTERPOLATIONS)
        times = as_double("times", self.times, ("K",))
        n: int | str = {"rotation": 4, "weights": "n"}.get(self.path, 3)
        shape = (len(times), 3, n) if self.interpolation == "CUBICSPLINE" else (len(times), n)
        values = as_double("values", self.values, shape)
        if not bool((times.diff() > 0).all()):
            raise ValueError(f"times: expected ascending numbers, got {times.tolist()[:5]}")
        if self.path == "rotation":
            values = _of_unit_length(values, values[:, 1] if self.interpolation == "CUBICSPLINE" else values)
        object.__setattr__(self, "times", times)
        object.__setattr__(self, "values", values)

    def at(self, t: Tensor) -> Tensor:
        """Return values (…, n) at times (…), differentiable by them; before the first key and after the last, theirs."""
        K = len(self.times)
        t = t.clamp(float(self.times[0]), float(self.times[-1]))
        k = (torch.searchsorted(self.times, t.detach().contiguous(), right=True) - 1).clamp(0, max(K - 2, 0))
        last = (k + 1).clamp(max=K - 1)
        cubic = self.interpolation == "CUBICSPLINE"
        keys = self.values[:, 1] if cubic else self.values
        length = (self.times[last] - self.times[k]).clamp(min=1e-30)
        s = ((t - self.times[k]) / length)[..., None]
        if self.interpolation == "STEP" or K == 1:
            return torch.where(s.detach() < 1.0, keys[k], keys[last])
        if not cubic:
            return _slerp(keys[k], keys[last], s) if self.path == "rotation" else keys[k] + s * (keys[last] - keys[k])
        length = length[..., None]
        out, into = length * self.values[k, 2], length * self.values[last, 0]
        s2, s3 = s * s, s * s * s
        value = (
            (2 * s3 - 3 * s2 + 1) * keys[k]
            + (s3 - 2 * s2 + s) * out
            + (3 * s2 - 2 * s3) * keys[last]
            + (s3 - s2) * into
        )
        return value / value.norm(dim=-1, keepdim=True) if self.path == "rotation" else value


def _of_unit_length(values: Tensor, quaternions: Tensor) -> Tensor:
    """Return rows of values divided by the lengths of their quaternions (K, 4). Raises ValueError."""
    length = quaternions.norm(dim=-1)
    bad = (length - 1.0).abs() > ROUNDED
    if bool(bad.any()):
        k = int(bad.nonzero()[0])
        raise ValueError(
            f"values: expected unit quaternions x, y, z, w, got one of length {float(length[k]):.3g} at key {k}; divide each by "
            "its length, and its tangents, too"
        )
    return values / length.reshape(-1, *[1] * (values.dim() - 1))


def _slerp(first: Tensor, last: Tensor, s: Tensor) -> Tensor:
    """Interpolate (…, 4) from one unit quaternion to another by the shorter arc."""
    lib = roma()
    turn = lib.unitquat_to_rotvec(lib.quat_product(lib.quat_conjugation(first), last))
    return lib.quat_product(first, lib.rotvec_to_unitquat(s * turn))


@dataclass(frozen=True, eq=False)
class Animation:
    """The motion of joints and morphs over time. Load one by rig.animation(name)."""

    name: str
    channels: tuple[Channel, ...]
    joints: Joints = field(repr=False)
    morphs: Tensor = field(repr=False)  # (M,) at rest

    @property
    def duration(self) -> float:
        """Return the seconds to the last key."""
        return max((float(channel.times[-1]) for channel in self.channels), default=0.0)

    def at(self, t: float | Tensor) -> dict[str, Tensor]:
        """Return what moves at a time in seconds, as rig.posed(**…) takes it; at times (B,) a batch.

        It is differentiable by the time. Before the first key and after the last one, it rests at theirs; take t % duration
        for a loop.
        """
        time = as_tensor("t", t, floating=True).double()
        check_shape("t", time, (), ("B",))
        check_finite("t", time)
        assert isinstance(self.joints.stretches, Tensor)
        rest = {
            "rotation": torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).expand(len(self.joints), 4),
            "translation": self.joints.translations,
            "scale": self.joints.stretches.diagonal(dim1=-2, dim2=-1),
            "weights": self.morphs,
        }
        called = {
            "rotation": "rotations",
            "translation": "joint_translations",
            "scale": "joint_scales",
            "weights": "morphs",
        }
        found = {}
        for path in called:
            rows = [row.expand((*time.shape, *row.shape)) for row in rest[path].unbind(0)] if len(rest[path]) else []
            moved = [channel for channel in self.channels if channel.path == path]
            for channel in moved:
                value = channel.at(time)
                if path == "weights":
                    rows[channel.target : channel.target + value.shape[-1]] = value.unbind(-1)
                else:
                    rows[channel.target] = self._from_rest(channel.target, value) if path == "rotation" else value
            if moved:
                found[called[path]] = torch.stack(rows, time.dim())
        return found

    def _from_rest(self, joint: int, rotation: Tensor) -> Tensor:
        lib = roma()
        rest = lib.rotmat_to_unitquat(self.joints.rotations[joint])
        return lib.quat_product(
            lib.quat_conjugation(rest).expand(rotation.shape), rotation / rotation.norm(dim=-1, keepdim=True)
        )
