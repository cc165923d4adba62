"""The result of a fit of a rig."""

from __future__ import annotations

import math
import statistics
from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from ...files.paths import PathLike, write_json
from ...files.save import save_scene
from ...rig.rig import Rig
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..descent.result import Fit
from ..edge_support import MIN_EDGE_SUPPORT
from ..result import FitResult, delegated, made_folder
from .settings import RIG
from .uncertainty import RIG_CONFIDENCE, JointUncertainty


@dataclass(frozen=True, eq=False)
class RigFit(FitResult):
    """The result of fit_rig(), a FitResult.

    Attributes
    ----------
    values : all that posed() takes, by name: rig.posed(**values); rotations as rotation vectors
    fit : the numbers that were sought, loss, views and history
    explained_joints : by the name of each joint that was sought and that pictures can show
        The share of its edges that they do, 0 … 1.
    left_out : the largest share of a mask's area in regions that the fit does not cover, or covers wrongly
    uncertainty : how exactly the pictures show each joint
        None where that is unknown: of a rig whose controls have no names, or one that PyTorch does not differentiate in
        forward mode.
    features : what `confidence` is computed from, by name
    """

    rig: Rig
    values: dict[str, Any]
    fit: Fit = field(repr=False)
    explained_joints: dict[str, float] = field(default_factory=dict, repr=False)
    uncertainty: JointUncertainty | None = field(default=None, repr=False)
    left_out: float = field(default=0.0, repr=False)
    features: dict[str, float] = field(default_factory=dict, repr=False)

    loss, explained, history, steps, seconds, interrupted, plot = delegated(
        "fit", "loss explained history steps seconds interrupted plot"
    )

    def posed(self) -> Scene | Mesh:
        """Return the rig's meshes in the pose that was found."""
        return self.rig.posed(**self.values)

    @property
    def bones(self) -> Tensor | None:
        """Return the bones, see Rig.bones()."""
        return self.rig.bones(self.values)

    @property
    def converged(self) -> bool:
        """Return whether Fit.converged holds, and the pictures show each joint of the fit, and how it is rotated."""
        return self.fit.converged and not self.missed and self.left_out < RIG.missed_region and not self._unknown

    @property
    def reason(self) -> str:
        """Return "converged", or what kept the fit from that, in words; see Fit.reason."""
        if not self.fit.converged:
            return self.fit.reason
        if self.missed:
            worst = sorted(self.missed, key=lambda name: self.explained_joints[name])[:3]
            said = ", ".join(f"{self.explained_joints[name]:.0%} at {name}" for name in worst)
            return (
                f"edges not explained: the pictures show too few of the edges of {len(self.missed)} joints ({said}); start "
                "nearer, give more tries or keypoints, or look for what covers them"
            )
        if self.left_out >= RIG.missed_region:
            return (
                f"masks not explained: a region of {self.left_out:.0%} of one is without the fit, or of the fit outside it; give "
                "more tries or keypoints, or look for what else the masks show"
            )
        if self._unknown:
            return f"rotations unknown: {self._unknown}; give more pictures or colours, or seek other joints alone"
        return self.fit.reason

    @property
    def confidence(self) -> float:
        """Return the calibrated probability, 0 … 1, that the rotations of all sought joints are within 2° of the true ones.

        NaN: unknown, as of fits by regions and of those without `uncertainty`.
        """
        return RIG_CONFIDENCE.probability(self.features) if self.features else math.nan

    @property
    def _unknown(self) -> str:
        return "" if self.uncertainty is None else self.uncertainty.unknown

    @property
    def missed(self) -> list[str]:
        """Return the joints of whose edges the pictures show too few: they lie in another place."""
        if not self.explained_joints:
            return []
        least = max(MIN_EDGE_SUPPORT, RIG.share_of_median * statistics.median(self.explained_joints.values()))
        return [name for name, share in self.explained_joints.items() if share < least]

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write what Fit.save() writes, and pose.json, posed.glb and joints.json; return the names.

        pose.json has all values by name, as lists, posed.glb the meshes so posed, and joints.json how much of each joint's
        edges the pictures show, and to how many degrees it is known. Raises OSError, or at last ImportError.
        """
        out = made_folder(folder)
        content = {name: value.tolist() for name, value in self.values.items()}
        write_json(out / "pose.json", content)
        known = {} if self.uncertainty is None else self.uncertainty.degrees
        joints = {
            name: {"explained": self.explained_joints.get(name), "degrees": known.get(name)}
            for name in {**known, **self.explained_joints}
        }
        write_json(out / "joints.json", joints)
        save_scene(out / "posed.glb", self.fit.scene.replace(background=None))
        return ["pose.json", "joints.json", "posed.glb", *self.fit.save(out, figures)]
