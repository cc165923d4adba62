"""The result of fit_pose: the pose, the steps that led there, and its JSON form."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from torch import Tensor

from ...camera.camera import Camera
from ...camera.poses import rigid
from ...files.cameras import camera_fields, camera_from_fields
from ...files.formats.part import FormatError
from ...files.paths import PathLike, write_figures, write_text
from ...optim.tensors import Ending
from ...optional import DRAWING, require
from ..edge_support import MIN_EDGE_SUPPORT
from ..placement import Pose, pose_from_matrix
from ..result import FitResult, made_folder, number_or_none, reason_of
from .confidence import FEATURES, confidence_of
from .settings import CAMERA
from .uncertainty import Uncertainty

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .task import PoseTask


class Step(NamedTuple):
    """One render of the fit."""

    size: tuple[int, int]  # pixels (H, W) of this level of the pyramid
    loss: float  # what the steps lower, see PoseFit; comparable within one level
    pose: Pose
    best: bool  # It was the best so far.
    # Norms of the loss's gradient by sought part: rotation (radians), shift (object sizes), scale and focal (logarithms),
    # principal (widths of the image) and distortion; empty where the loss rose and the step was taken back.
    gradient: Mapping[str, float]


class PoseMode(NamedTuple):
    """A pose at which the pictures are likely, and the share of the posterior's mass about it, see docs/pose.md."""

    matrix: Tensor  # (4, 4) float64, mesh to world
    probability: float


@dataclass(frozen=True, eq=False)
class PoseFit(FitResult):
    """The result of fit_pose(), a FitResult.

    R (3, 3), t (3,) float64 and scale place the mesh: `world = scale · R v + t`, t in world units. `camera` is the given one
    (of several the first), with the focal length found when that was asked for.

    `converged` says that the descent came to rest, and `reason` what else speaks against the pose; `confidence` is the
    probability that it is right.

    `loss` is −log of how much likelier the pictures are with the object than without, in nats of independent pixels. It belongs
    to the finest level, and compares only fits to the same pictures.
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
    cameras: list[Camera] = field(default_factory=list, repr=False)  # all given ones, as `camera`; not kept in JSON
    uncertainty: Uncertainty | None = field(default=None, repr=False)  # None before the answer
    visible: float = 1.0  # share of this object that the others of fit_poses() do not hide
    conflict: str = ""  # the other pose or object that may be the right one, in words
    enough: float = MIN_EDGE_SUPPORT  # least `explained` of a right pose
    # The poses at which the search came to rest, by their probabilities; the first one is the answer.
    modes: Sequence[PoseMode] = ()
    features: Mapping[str, float] = field(default_factory=dict, repr=False)  # of the fit, on which `confidence` depends

    @property
    def matrix(self) -> Tensor:
        """Mesh to world, (4, 4) float64, for column vectors: `scale · R` and `t`."""
        return rigid(self.scale * self.R, self.t)

    @property
    def confidence(self) -> float:
        """The probability, 0 … 1, that the pose is right within 2° and 2 % of the object's size, up to given symmetries.

        It is the mass of the mode times a logistic regression on features of the fit that was trained on other pictures, see
        docs/pose.md; NaN before the answer.
        """
        return confidence_of(self.features) if self.features else math.nan

    @property
    def reason(self) -> str:
        """Return "converged", or what speaks against the pose, in words.

        These are "edges not explained: …", "hidden: …", "in one place: …", "ambiguous: …", "directions unknown: …", "steps
        ran out: …" and "interrupted".
        """
        if not self.interrupted and self.visible < CAMERA.least_visible:
            return f"hidden: the other objects leave {self.visible:.0%} of it to be seen; its pose is about its start's"
        if self.conflict and not self.interrupted:
            return self.conflict
        ending = Ending.INTERRUPTED if self.interrupted else Ending.FLAT if self.converged else Ending.STEPS
        words = reason_of(ending, self.explained, "mesh, camera or picture", self.enough)
        if self.uncertainty is None or not self.uncertainty.unknown or self.interrupted or self.explained < self.enough:
            return words
        if self.uncertainty.of_camera:
            fix = "seek less of the lens, or give pictures that the object fills, from several sides or nearer"
            return f"not known: {self.uncertainty.unknown}; {fix}"
        fix = "give the mesh's colours, symmetries of the mesh, depth, or another picture"
        if self.uncertainty.focal > CAMERA.most_focal:
            fix = "give a picture from nearer, where perspective shows, or the lens as it was calibrated"
        return f"directions unknown: {self.uncertainty.unknown}; {fix}"

    def plot(self, most: int = 4) -> Figure:
        """Draw target | start | fit | difference, a row for each of at most so many pictures.

        With a mask they are all over black, as they were compared.
        """
        return require("edgegrad.fit.pose.pictures", *DRAWING).sheet(self, most=most)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write pose.json, fit.png and loss.png (plot_history()) to a folder, and return their names.

        The folder is made where it is missing, and each file is written whole or not at all. A fit that took no step writes
        pose.json alone. Raises OSError, or ImportError once pose.json is written when matplotlib or pillow is missing.
        """
        out = made_folder(folder)
        write_text(out / "pose.json", self.to_json() + "\n")
        if not self.history or not figures:
            return ["pose.json"]
        return ["pose.json", *write_figures(out, {"fit.png": self.plot, "loss.png": self.plot_history})]

    def to_json(self) -> str:
        """Return JSON text with the pose, `mesh_to_world` 4 × 4 by rows for column vectors, the camera, and figures."""
        content = {
            "mesh_to_world": self.matrix.tolist(), "scale": self.scale, "camera": camera_fields(self.camera),
            "loss": number_or_none(self.loss), "steps": self.steps, "seconds": round(self.seconds, 3),
            "converged": self.converged, "reason": self.reason, "interrupted": self.interrupted,
            "explained": number_or_none(self.explained), "confidence": number_or_none(self.confidence),
            "features": dict(self.features), "conflict": self.conflict, "visible": self.visible, "enough": self.enough,
            "modes": [{"mesh_to_world": mode.matrix.tolist(), "probability": mode.probability} for mode in self.modes],
            "uncertainty": None if self.uncertainty is None else self.uncertainty.to_dict(),
        }  # fmt: skip
        return json.dumps(content, indent=2)

    @staticmethod
    def from_json(text: str) -> PoseFit:
        """Read what to_json wrote; the history is not kept. Raises ValueError that names what is missing or wrong."""
        data = _parsed(text)
        _check_entries(data, "mesh_to_world", "camera", "loss", "steps", "seconds", "converged", "interrupted")
        pose = pose_from_matrix("mesh_to_world", data["mesh_to_world"])
        try:
            known, given = data.get("uncertainty"), dict(data.get("features") or {})
            modes = [
                PoseMode(pose_from_matrix("modes", one["mesh_to_world"]).matrix, float(one["probability"]))
                for one in data.get("modes") or []
            ]
            loss, explained = (math.nan if (x := data.get(name)) is None else x for name in ("loss", "explained"))
            return PoseFit(
                pose.R, pose.t, float(pose.scale), camera_from_fields(data["camera"]), float(loss), int(data["steps"]),
                float(data["seconds"]), bool(data["converged"]), bool(data["interrupted"]), float(explained),
                uncertainty=None if known is None else Uncertainty.from_dict(known),
                features={name: float(given[name]) for name in FEATURES} if given else {},
                conflict=str(data.get("conflict", "")), visible=float(data.get("visible", 1.0)),
                enough=float(data.get("enough", MIN_EDGE_SUPPORT)), modes=modes,
            )  # fmt: skip
        except (FormatError, KeyError, TypeError, ValueError) as error:
            raise ValueError(f"pose: expected what PoseFit.to_json writes, got a fault in it ({error})") from error


def pose_from_json(text: str) -> Pose:
    """Read a pose from a JSON object with `mesh_to_world`, 4 × 4 by rows, or from such a matrix alone. An object with `poses`,
    as `edgegrad track` writes them, gives the last one that is not `lost`. Raises ValueError."""
    data = _parsed(text, allow_matrix=True)
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


def _parsed(text: str, allow_matrix: bool = False) -> dict[str, Any]:
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(f"pose: expected JSON, got text that is not ({error})") from None
    if allow_matrix and isinstance(data, list) and data:
        return {"mesh_to_world": data}
    if not isinstance(data, dict):
        raise ValueError(f'pose: expected a JSON object, got {type(data).__name__}; write {{"mesh_to_world": …}}')
    return data


def _check_entries(data: dict[str, Any], *keys: str) -> None:
    if missing := [key for key in keys if key not in data]:
        raise ValueError(f"pose: expected the entry {missing[0]!r}, got {', '.join(data) or 'none'}; add it")
