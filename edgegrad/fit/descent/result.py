"""The result of a fit by descent: the best values, the scene they make, and how well it shows what the pictures show."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...files.cameras import save_camera
from ...files.image import write_image
from ...files.paths import PathLike, replacing, write_figures, write_json
from ...files.save import save_mesh
from ...optim.tensors import DescentResult, Ending, Record
from ...optional import DRAWING, require
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..contour_colors import draw_contour
from ..edge_support import MIN_EDGE_SUPPORT, edge_support
from ..measured import comparable
from ..placement import Coordinates, Pose
from ..result import FitResult, chosen, history_rows, made_folder, number_or_none, reason_of
from ..views import Observation
from .objective import Objective
from .region_loss import FINAL_STEP
from .scene_builder import build_detached

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RESULT_SPP = 64  # samples per pixel at least, of the renders by which the result is judged


@dataclass(frozen=True, eq=False)
class Fit(FitResult):
    """The result of fit_scene(), fit_shape() and fit_texture(), a FitResult.

    Attributes
    ----------
    values : parameters by name; a PoseParameter as its matrix (4, 4) float64, mesh to world
    poses : PoseParameters by name
    scene, cameras : the scene with these values, and cameras
    loss : mean over all views, without the regularizer, at 64 samples per pixel or more
    explained : share of the render's edges that the pictures show too, 0 … 1
    ending : why the fit took no more steps
    """

    values: dict[str, Tensor]
    poses: dict[str, Pose]
    scene: Scene
    cameras: list[Camera]
    loss: float
    explained: float
    ending: Ending
    seconds: float
    views: list[Observation] = field(repr=False)
    history: list[Record] = field(repr=False)
    start: Scene = field(repr=False)

    @property
    def steps(self) -> int:
        """Return the number of steps."""
        return len(self.history)

    @property
    def converged(self) -> bool:
        """Return whether further steps lead no further and the pictures show enough of the render's edges."""
        return self.ending is Ending.FLAT and self.explained >= MIN_EDGE_SUPPORT

    @property
    def interrupted(self) -> bool:
        """Return whether the fit was interrupted."""
        return self.ending is Ending.INTERRUPTED

    @property
    def mesh(self) -> Mesh:
        """Return the scene's first mesh."""
        return self.scene.meshes[0]

    @property
    def reason(self) -> str:
        """Return the ending in words.

        It is "converged", "edges not explained: …", "loss still falling: …", "steps ran out: …" or "interrupted".
        """
        return reason_of(self.ending, self.explained)

    def render(self, index: int = 0, spp: int = 64, seed: int = 0) -> Tensor:
        """Render the fit as (H, W, C) from the camera at `index`.

        This is alpha (H, W, 1) if the view has a mask alone, or if the loss is "region". It is the depth, normal or position
        that was measured, as render_aovs() gives it, if the view has neither image nor mask.
        """
        return _render(self.scene, self.cameras[index], self.views[index], spp, seed)

    def plot(self, most: int = 4) -> Figure:
        """Draw target, start, fit and difference of at most `most` views; with the loss "region" contours in the picture."""
        rows = []
        for i in chosen(len(self.views), most):
            view = self.views[i]
            start, end = _render(self.start, view.camera, view, 64, 0), self.render(i)
            if (measured := view.measured.get(view.aovs[0])) is not None:
                start, end = measured.displayed(start), measured.displayed(end)
            if view.by_region:
                start, end = (draw_contour(view.shown, alpha) for alpha in (start, end))
            rows.append((view.shown, start, end))
        return require("edgegrad.fit.plots", *DRAWING).comparison(rows, not self.views[0].by_region)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Write the result to a folder, which is made if missing, and return the names of the files.

        - fit.json: loss, reason, cameras, and values of up to 64 numbers
        - values.pt: all values, for torch.load
        - history.json: loss, gradient norms and small values of each step
        - mesh*.ply: shapes that moved; texture*.png: textures of 1 or 3 channels, as sRGB
        - mesh*.glb: meshes with textures and materials, as save_mesh() writes them, if pillow is installed
        - camera*.json: cameras, as load_camera reads them
        - fit.png: plot(), loss.png: plot_history(); not with figures=False

        Each file is written whole or not at all. Raises OSError, or at last ImportError if matplotlib is missing.
        """
        out = made_folder(folder)
        written = ["fit.json", "values.pt", "history.json"]
        write_json(out / "fit.json", self._summary())
        with replacing(out / "values.pt") as temporary:
            torch.save(self.values, temporary)
        write_json(out / "history.json", history_rows(self.history))
        moved = any(n.endswith("verts") for n in self.values) or any(not n.startswith("cameras.") for n in self.poses)
        for i, mesh in enumerate(self.scene.meshes):
            number = "" if len(self.scene.meshes) == 1 else str(i)
            if moved:
                save_mesh(out / f"mesh{number}.ply", mesh)
                written.append(f"mesh{number}.ply")
            if mesh.texture is not None and mesh.texture.shape[-1] in (1, 3):
                write_image(out / f"texture{number}.png", mesh.texture.clamp(0.0, 1.0))
                written.append(f"texture{number}.png")
            textured = mesh.texture is not None or mesh.material is not None
            if textured and mesh.channels in (None, 1, 3) and (find_spec("PIL") or not mesh.has_textures):
                save_mesh(out / f"mesh{number}.glb", mesh)
                written.append(f"mesh{number}.glb")
        for i, camera in enumerate(self.cameras):
            name = f"camera{'' if len(self.cameras) == 1 else i}.json"
            save_camera(out / name, camera)
            written.append(name)
        draw = {"fit.png": self.plot} | ({"loss.png": self.plot_history} if self.history else {})
        return written + (write_figures(out, draw) if figures else [])

    def _summary(self) -> dict[str, Any]:
        small = {name: value.tolist() for name, value in self.values.items() if value.numel() <= 64}
        return {
            "reason": self.reason, "converged": self.converged, "loss": number_or_none(self.loss), "explained": self.explained,
            "steps": self.steps, "seconds": round(self.seconds, 3), "values": small,
        }  # fmt: skip


def _render(scene: Scene, camera: Camera, view: Observation, spp: int, seed: int) -> Tensor:
    with torch.no_grad():
        return render_aovs(scene, camera, view.aovs[:1], spp=spp, seed=seed)[view.aovs[0]]


def make_fit(objective: Objective, descent: DescentResult, start: Scene, coordinates: Coordinates) -> Fit:
    """Judge the best values of a descent over all views with many samples, and return the result."""
    views, options = objective.views, objective.options
    scene, cameras = build_detached(objective.build, descent.values)
    loss, pairs, alphas = 0.0, [], list[Tensor]()
    spp = max(options.spp, RESULT_SPP)
    objective.renew(descent.values, FINAL_STEP)
    with torch.no_grad():
        for i, view in enumerate(views):
            first, second = (
                next(objective.renders(scene, cameras, [i], spp, (options.seed + k) % 2**32))[1] for k in (1, 2)
            )
            mean = {name: 0.5 * (image + second[name]) for name, image in first.items()}
            loss += float(objective.views_loss([i], mean)) / len(views)
            if objective.regions is not None:
                alphas.append(mean["alpha"][0])
            targets = {name: (target, view.weight) for name, target in view.wanted.items()}
            for name, given in view.measured.items():
                targets[name] = comparable(mean[name][0], mean["alpha"][0], given)
            pairs += [(first[name][0], second[name][0], *target) for name, target in targets.items()]
    share = edge_support(pairs) if objective.regions is None else objective.regions.edge_support(alphas)
    history = [coordinates.recorded(record) for record in descent.history]
    return Fit(
        values=coordinates.result_values(descent.values), poses=coordinates.poses(descent.values), scene=scene, cameras=cameras,
        views=views, loss=loss, explained=share, ending=descent.ending, history=history, seconds=descent.seconds,
        start=start,
    )  # fmt: skip
