"""What a fit by descent returns: the best values, what they make, and how well that explains the pictures."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from ...aovs import render_aovs
from ...camera.camera import Camera
from ...files.cameras import save_camera
from ...files.image import write_image
from ...files.paths import PathLike, replacing
from ...files.save import save_mesh
from ...optional import DRAWING, require
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..ending import Ending, reason_of
from ..history import Record, number_or_none, plain_history
from ..placement import Pose
from ..sides import outlined
from ..verdict import ENOUGH
from ..views import View

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False)
class Fit:
    """What a fit found.

    values     the parameters, by name; poses as matrices (4, 4) float64, mesh to world
    poses      those of PoseParameters, by name
    scene      with them, and cameras
    loss       of all views, without the regularizer, at 64 samples a pixel or more
    explained  the share of the render's edges that the pictures show too, 0 … 1
    ending     why the fit took no more steps
    """

    values: dict[str, Tensor]
    poses: dict[str, Pose]
    scene: Scene
    cameras: list[Camera]
    loss: float
    explained: float
    ending: Ending
    seconds: float
    views: list[View] = field(repr=False)
    history: list[Record] = field(repr=False)
    start: Scene = field(repr=False)  # where the fit began

    @property
    def steps(self) -> int:
        return len(self.history)

    @property
    def converged(self) -> bool:
        """Further steps lead no further, and the pictures show what the fit has found: not a wrong place, nor a picture of
        something else."""
        return self.ending is Ending.FLAT and self.explained >= ENOUGH

    @property
    def interrupted(self) -> bool:
        return self.ending is Ending.INTERRUPTED

    @property
    def mesh(self) -> Mesh:
        """The scene's first mesh."""
        return self.scene.meshes[0]

    @property
    def reason(self) -> str:
        """In words: "converged", or what kept the fit from that: "edges not explained: …", "loss still falling: …", "steps ran
        out: …", "interrupted"."""
        return reason_of(self.ending, self.explained)

    def render(self, index: int = 0, spp: int = 64, seed: int = 0) -> Tensor:
        """(H, W, C) as the camera of that place sees the fit; alpha (H, W, 1) where there was a mask alone, or by regions; where
        there was none, the depth, normal or position that was measured, as render_aovs() gives it."""
        return _render(self.scene, self.cameras[index], self.views[index], spp, seed)

    def plot(self, most: int = 4) -> Figure:
        """target | start | fit | difference of up to so many views; by regions the contour of start and fit in the picture."""
        n = len(self.views)
        chosen = sorted({round(k * (n - 1) / max(1, min(most, n) - 1)) for k in range(min(most, n))})
        rows = []
        for i in chosen:
            view = self.views[i]
            start, end = _render(self.start, view.camera, view, 64, 0), self.render(i)
            if (measured := view.measured.get(view.aovs[0])) is not None:
                start, end = measured.displayed(start), measured.displayed(end)
            if view.outlined:
                start, end = (outlined(view.shown, alpha) for alpha in (start, end))
            rows.append((view.shown, start, end))
        return require("edgegrad.fit.plots", *DRAWING).comparison(rows, not self.views[0].outlined)

    def plot_history(self) -> Figure:
        """The loss and the norm of each gradient, step by step."""
        return require("edgegrad.fit.plots", *DRAWING).curves(self.history)

    def save(self, folder: PathLike, figures: bool = True) -> list[str]:
        """Writes all of it to a folder, which is made where it is missing, and gives the files' names:

        fit.json      loss, reason, cameras, and values of up to 64 numbers
        values.pt     all values, for torch.load
        history.json  loss, gradient norms and small values of each step
        mesh*.ply     the shapes that moved
        texture*.png  textures of 1 or 3 channels, as sRGB
        mesh*.glb     the meshes with textures and materials, as save_mesh() writes them, where pillow is installed
        camera*.json  the cameras, as load_camera reads them
        fit.png       plot(), loss.png: plot_history(); not with figures=False

        Each file is written whole or not at all. Raises OSError, or at last ImportError when matplotlib is missing.
        """
        out = Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        written = []

        def text(name: str, content: Any) -> None:
            with replacing(out / name) as temporary:
                temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            written.append(name)

        text("fit.json", self._summary())
        with replacing(out / "values.pt") as temporary:
            torch.save(self.values, temporary)
        written.append("values.pt")
        text("history.json", plain_history(self.history))
        moved = any(n.endswith("verts") for n in self.values) or any(not n.startswith("cameras.") for n in self.poses)
        for i, mesh in enumerate(self.scene.meshes):
            number = "" if len(self.scene.meshes) == 1 else str(i)
            if moved:
                save_mesh(out / f"mesh{number}.ply", mesh)
                written.append(f"mesh{number}.ply")
            if mesh.texture is not None and mesh.texture.shape[-1] in (1, 3):
                write_image(out / f"texture{number}.png", mesh.texture.clamp(0.0, 1.0))
                written.append(f"texture{number}.png")
            looks = mesh.texture is not None or mesh.material is not None
            if looks and mesh.channels in (None, 1, 3) and (find_spec("PIL") or not mesh.has_textures):
                save_mesh(out / f"mesh{number}.glb", mesh)
                written.append(f"mesh{number}.glb")
        for i, camera in enumerate(self.cameras):
            name = f"camera{'' if len(self.cameras) == 1 else i}.json"
            save_camera(out / name, camera)
            written.append(name)
        draw = {"fit.png": self.plot} | ({"loss.png": self.plot_history} if self.history else {})
        for name in draw if figures else ():
            with replacing(out / name) as temporary:
                draw[name]().savefig(temporary)
            written.append(name)
        return written

    def _summary(self) -> dict[str, Any]:
        small = {name: value.tolist() for name, value in self.values.items() if value.numel() <= 64}
        return {
            "reason": self.reason, "converged": self.converged, "loss": number_or_none(self.loss), "explained": self.explained,
            "steps": self.steps, "seconds": round(self.seconds, 3), "values": small,
        }  # fmt: skip

    def _repr_png_(self) -> bytes:
        """In a notebook: the picture of plot()."""
        file = io.BytesIO()
        self.plot().savefig(file, format="png", dpi=100)
        return file.getvalue()


def _render(scene: Scene, camera: Camera, view: View, spp: int, seed: int) -> Tensor:
    with torch.no_grad():
        return render_aovs(scene, camera, view.aovs[:1], spp=spp, seed=seed)[view.aovs[0]]
