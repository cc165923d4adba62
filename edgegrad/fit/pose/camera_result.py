"""The result of fits of cameras, of one place or of several with one lens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from torch import Tensor

from ...camera.camera import Camera
from ...files.cameras import save_camera
from ...files.paths import PathLike, write_figures, write_json
from ...optim.tensors import Ending
from ...optional import DRAWING, require
from ..result import FitResult, chosen, history_rows, made_folder, number_or_none
from .result import PoseFit, Step
from .uncertainty import Uncertainty

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class CameraFit(FitResult):
    """The result of fit_camera() and of calibrate(), a FitResult: cameras, and how exactly each number is known.

    Attributes
    ----------
    cameras : the camera of each picture
    searches : a PoseFit of each place, in which the scene moved before cameras at rest
        fit_camera() has one place, and calibrate() one for each picture.
    ending : why the fit took no more steps
    joint : the steps of all numbers at once, with the pose and lens of the first place
    """

    cameras: list[Camera]
    searches: list[PoseFit] = field(repr=False)
    ending: Ending
    joint: list[Step] = field(repr=False)

    @property
    def camera(self) -> Camera:
        """Return the first camera."""
        return self.cameras[0]

    @property
    def uncertainty(self) -> Uncertainty | None:
        """Return the standard deviations of the first place and of the lens; None until the searches have ended."""
        return self.uncertainties[0]

    @property
    def uncertainties(self) -> list[Uncertainty | None]:
        """Return the uncertainty of each place."""
        known = [search.uncertainty for search in self.searches]
        return [None if one is None or not one.of_camera else one for one in known]

    @property
    def history(self) -> list[Step]:
        """Return the steps of one place, or those of all numbers at once of several."""
        return self.joint if len(self.searches) > 1 else self.searches[0].history

    @property
    def loss(self) -> float:
        """Return the mean loss over the places."""
        return sum(search.loss for search in self.searches) / len(self.searches)

    @property
    def explained(self) -> float:
        """Return the least share over the places, 0 … 1, of the render's edges that the pictures show, too."""
        return min(search.explained for search in self.searches)

    @property
    def steps(self) -> int:
        """Return the number of records of the history."""
        return len(self.history)

    @property
    def seconds(self) -> float:
        return sum(search.seconds for search in self.searches)

    @property
    def converged(self) -> bool:
        """Return whether further steps lead no further, pictures show the render's edges, and all that was sought is known."""
        return self.ending is Ending.FLAT and all(search.reason == "converged" for search in self.searches)

    @property
    def interrupted(self) -> bool:
        return self.ending is Ending.INTERRUPTED

    @property
    def reason(self) -> str:
        """Return "converged", or what kept the fit from that, in words.

        These are reasons as PoseFit has them, of several places "images[2]: edges not explained: …", and "not known: …" with
        numbers of pose and lens that the pictures hardly show.
        """
        if self.interrupted:
            return "interrupted"
        for k, (search, known) in enumerate(zip(self.searches, self.uncertainties, strict=True)):
            words = search.reason
            if words != "converged":
                of_lens = words.startswith("not known") and known is not None and known.vague
                return words if of_lens or len(self.searches) == 1 else f"images[{k}]: {words}"
        return "converged"

    def plot(self, most: int = 4) -> Figure:
        """Draw target | start | fit | difference of at most so many pictures, as they were compared."""
        shown = [self.searches[k] for k in chosen(len(self.searches), most)]
        return require("edgegrad.fit.pose.pictures", *DRAWING).sheet(*shown, most=most)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, which is made where it is missing, and return the files' names.

        - camera.json, of several camera-0.json and so on: the cameras, as load_camera reads them
        - calibration.json: focal length, principal point and distortion with their standard deviations, those of the poses,
          loss and reason
        - history.json: loss, gradient norms and pose of each step, where several the first one's
        - of one place what PoseFit.save writes; else fit.png and loss.png, plot() and plot_history(), not with figures=False

        Each file is written whole or not at all. Raises OSError, or at last ImportError when matplotlib or pillow is missing.
        """
        out = made_folder(folder)
        names = [f"camera-{k}.json" for k in range(len(self.cameras))] if len(self.cameras) > 1 else ["camera.json"]
        for name, camera in zip(names, self.cameras, strict=True):
            save_camera(out / name, camera)
        write_json(out / "calibration.json", self._summary())
        write_json(out / "history.json", history_rows(self.history))
        names += ["calibration.json", "history.json"]
        if len(self.searches) == 1:
            return [*names, *self.searches[0].save(folder, figures)]
        draw = {"fit.png": self.plot} | ({"loss.png": self.plot_history} if self.joint else {})
        return names + (write_figures(out, draw) if figures else [])

    def _summary(self) -> dict[str, Any]:
        camera = self.camera
        found: dict[str, Any] = {
            "K": camera.K.tolist(), "distortion": camera.coefficients.tolist(), "size": list(camera.size),
            "projection": camera.projection,
        }  # fmt: skip
        if (known := self.uncertainty) is not None:
            found["standard_deviations"] = {
                "focal": known.focal * float(camera.K[0, 0]), "principal": known.principal.tolist(),
                "distortion": known.distortion.tolist(),
                "poses": [{"degrees": one.degrees, "shift": one.shift} for one in self.uncertainties if one is not None],
            }  # fmt: skip
        return found | {
            "reason": self.reason, "converged": self.converged, "loss": number_or_none(self.loss),
            "explained": [search.explained for search in self.searches], "steps": self.steps,
            "seconds": round(self.seconds, 3),
        }  # fmt: skip


def fitted(searches: Sequence[PoseFit], ending: Ending = Ending.STEPS, joint: Sequence[Step] = ()) -> CameraFit:
    """Return searches that moved the scene before cameras as a fit of the cameras."""
    cameras = [_moved(seen, search.matrix) for search in searches for seen in search.cameras]
    return CameraFit(cameras, list(searches), ending, list(joint))


def _moved(camera: Camera, matrix: Tensor) -> Camera:
    """Return the camera W M that sees a scene at rest as this one, W, sees it moved by the matrix M (4, 4)."""
    W = camera.world_to_camera
    return camera.replace(world_to_camera=(W.detach().double() @ matrix).to(W))
