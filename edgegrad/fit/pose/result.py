"""What fit_pose returns: where the mesh is, the steps that led there, and its JSON form."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...files.paths import PathLike, replacing
from ...optional import DRAWING, require
from ..edge_support import MIN_EDGE_SUPPORT
from ..ending import Ending, reason_of
from .pose import Pose, pose_from_matrix
from .uncertainty import FOCAL, Uncertainty

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .task import PoseTask


HIDDEN = 0.1  # share of an object that others must leave to be seen for its pose to be believed


class Step(NamedTuple):
    """One render of the fit."""

    size: tuple[int, int]  # pixels (H, W) of this level of the pyramid
    loss: float  # mean squared difference, blurred alike; comparable within one level
    pose: Pose
    best: bool  # whether it was the best so far
    # Norms of the loss's gradient by rotation (radians), shift (object sizes), scale and focal (logarithms), principal (widths of
    # the image) and distortion, of those that are sought on the level; empty where the loss rose and the step was taken back.
    gradient: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class PoseFit:
    """What fit_pose found.

    R (3, 3), t (3,) float64 and scale place the mesh: `world = scale · R v + t`, t in world units. `camera` is the given
    one (of several the first), with the focal length found when that was asked for. `loss` is the mean squared difference to the
    picture over pixels and channels, at the finest level, in linear radiance of which 1 is the picture's white; where a pixel is
    far off, it counts no more than a tenth of the picture's range does.
    """

    R: Tensor
    t: Tensor
    scale: float
    camera: Camera
    loss: float
    steps: int
    seconds: float
    converged: bool
    interrupted: bool = False
    explained: float = math.nan  # the share of the render's edges that the pictures show too, 0 … 1
    history: list[Step] = field(default_factory=list, repr=False)  # its last `best` step is this pose
    task: PoseTask | None = field(default=None, repr=False)  # what was compared, for pictures; not kept in JSON
    cameras: list[Camera] = field(
        default_factory=list, repr=False
    )  # all that were given, as `camera`; not kept in JSON
    # How exactly the pictures show the pose; None before the answer.
    uncertainty: Uncertainty | None = field(default=None, repr=False)
    # Of a fit of several objects, how much of this one the others leave to be seen, 0 … 1. Not kept in JSON
    visible: float = 1.0
    conflict: str = ""  # in words, which other pose or object it cannot be told from; not kept in JSON
    enough: float = MIN_EDGE_SUPPORT  # of `explained`, for this mesh and picture; not kept in JSON

    @property
    def matrix(self) -> Tensor:
        """Mesh to world, (4, 4) float64, for column vectors: `scale · R` and `t`."""
        one = torch.ones((), dtype=torch.float64)
        return Pose(self.R, self.t, self.scale * one, one).matrix

    @property
    def reason(self) -> str:
        """In words: "converged", or what kept the fit from that: "edges not explained: …", "hidden: …", "in one place: …",
        "looks alike: …", "directions unknown: …", "steps ran out: …", "interrupted"."""
        if not self.interrupted and not self.converged and self.visible < HIDDEN:
            return f"hidden: the other objects leave {self.visible:.0%} of it to be seen; its pose is about its start's"
        if self.conflict and not self.interrupted:
            return self.conflict
        ending = Ending.INTERRUPTED if self.interrupted else Ending.FLAT if self.converged else Ending.STEPS
        words = reason_of(ending, self.explained, "mesh, camera or picture", self.enough)
        if self.uncertainty is None or not self.uncertainty.unknown or self.interrupted or self.explained < self.enough:
            return words
        fix = "give the mesh's colours, symmetries of the mesh, depth, or another picture"
        if self.uncertainty.focal > FOCAL:
            fix = "give a picture from nearer, where perspective shows, or the lens as it was calibrated"
        return f"directions unknown: {self.uncertainty.unknown}; {fix}"

    def plot(self) -> Figure:
        """target | start | fit | difference, a row for each picture; with a mask all over black, as they were compared."""
        return require("edgegrad.fit.pose.pictures", *DRAWING).sheet(self)

    def plot_history(self) -> Figure:
        """The loss and the norm of each gradient, step by step."""
        return require("edgegrad.fit.pose.pictures", *DRAWING).curves_of(self)

    def save(self, folder: PathLike) -> list[str]:
        """Writes pose.json, fit.png, loss.png (plot_history()) and fit.webp to a folder, which is made where it is missing, each
        whole or not at all, and gives their names; of a fit that took no step, pose.json alone. Raises OSError, or ImportError
        once pose.json is written when matplotlib or pillow is missing."""
        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        with replacing(out / "pose.json") as temporary:
            temporary.write_text(self.to_json() + "\n", encoding="utf-8")
        if not self.history:
            return ["pose.json"]
        report = require("edgegrad.fit.pose.pictures", *DRAWING)
        draw = {"fit.png": report.draw_fit, "loss.png": report.draw_loss, "fit.webp": report.draw_animation}
        for name, function in draw.items():
            function(out / name, self)
        return ["pose.json", *draw]

    def _repr_png_(self) -> bytes | None:
        """In a notebook: the picture of plot()."""
        if self.task is None or not self.history:
            return None
        file = io.BytesIO()
        self.plot().savefig(file, format="png", dpi=100)
        return file.getvalue()

    def to_json(self) -> str:
        """The pose as JSON text: `mesh_to_world` 4 × 4 by rows, for column vectors; camera and figures of the fit beside it."""
        return json.dumps(
            {
                "mesh_to_world": self.matrix.tolist(),
                "scale": self.scale,
                "camera": {
                    "world_to_camera": self.camera.world_to_camera.tolist(),
                    "K": self.camera.K.tolist(),
                    "size": list(self.camera.size),
                    "projection": self.camera.projection,
                    "distortion": None if self.camera.distortion is None else self.camera.distortion.tolist(),
                },
                "loss": self.loss if math.isfinite(self.loss) else None,  # none yet when interrupted at once
                "steps": self.steps,
                "seconds": round(self.seconds, 3),
                "converged": self.converged,
                "reason": self.reason,
                "interrupted": self.interrupted,
                "explained": self.explained if math.isfinite(self.explained) else None,
                "uncertainty": None if self.uncertainty is None else self.uncertainty.plain(),
            },
            indent=2,
        )

    @staticmethod
    def from_json(text: str) -> PoseFit:
        """From what to_json wrote; the history is not kept. Raises ValueError that names what is missing or wrong."""
        data = _parsed(text)
        _check_entries(data, "mesh_to_world", "camera", "loss", "steps", "seconds", "converged", "interrupted")
        pose = pose_from_matrix("mesh_to_world", data["mesh_to_world"])
        try:
            camera = data["camera"]
            M, K = (torch.tensor(camera[key], dtype=torch.float64) for key in ("world_to_camera", "K"))
            view = Camera(M, K, camera["size"], camera["projection"], camera.get("distortion"))
            loss = math.nan if data["loss"] is None else float(data["loss"])
            steps, seconds = int(data["steps"]), float(data["seconds"])
            share = data.get("explained")
            share = math.nan if share is None else float(share)
            known = data.get("uncertainty")
            known = None if known is None else Uncertainty.from_plain(known)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"pose: expected what PoseFit.to_json writes, got a fault in it ({error})") from error
        flags = bool(data["converged"]), bool(data["interrupted"])
        return PoseFit(pose.R, pose.t, float(pose.scale), view, loss, steps, seconds, *flags, share, uncertainty=known)


def pose_from_json(text: str) -> Pose:
    """The pose alone, from a JSON object with `mesh_to_world`, 4 × 4 by rows, or from such a matrix alone; or from an object with
    `poses`, as `edgegrad track` writes them, of which the last one that is not `lost`. Raises ValueError."""
    data = _parsed(text, bare=True)
    if "poses" not in data:
        _check_entries(data, "mesh_to_world")
        return pose_from_matrix("mesh_to_world", data["mesh_to_world"])
    rows = data["poses"]
    if not isinstance(rows, list) or not all(isinstance(row, dict) and "mesh_to_world" in row for row in rows):
        raise ValueError("poses: expected a list of objects, each with mesh_to_world, as edgegrad track writes them")
    seen = [row for row in rows if not row.get("lost", False)]
    if not seen:
        raise ValueError(f"poses: expected one that is not lost, got {len(rows)}, all lost; give a pose of fit-pose")
    return pose_from_matrix("mesh_to_world", seen[-1]["mesh_to_world"])


def _parsed(text: str, bare: bool = False) -> dict[str, Any]:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"pose: expected JSON, got text that is not ({error})") from None
    if bare and isinstance(data, list) and data:
        return {"mesh_to_world": data}
    if not isinstance(data, dict):
        raise ValueError(f'pose: expected a JSON object, got {type(data).__name__}; write {{"mesh_to_world": …}}')
    return data


def _check_entries(data: dict[str, Any], *keys: str) -> None:
    if missing := [key for key in keys if key not in data]:
        raise ValueError(f"pose: expected the entry {missing[0]!r}, got {', '.join(data) or 'none'}; add it")
