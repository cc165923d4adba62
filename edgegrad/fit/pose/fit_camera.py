"""fit_camera(): where a picture of a known scene was taken, and through which lens."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_flag, check_int
from ...files.cameras import save_camera
from ...files.paths import PathLike, replacing
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..history import Record, plain_history
from .fit_pose import search_pose
from .given import Names, bare
from .result import PoseFit, Step
from .task import PARTS, Lens
from .uncertainty import Uncertainty

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_COEFFICIENTS = 8
# Which tensor of a camera each part of a step moves.
PARTS_OF = {
    "rotation": "world_to_camera", "shift": "world_to_camera", "focal": "K", "principal": "K", "distortion": "distortion",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CameraFit:
    """What fit_camera found: the cameras, and the search for them, in which the scene moved before cameras at rest.

    `history` has a Record of each step: the loss, which is comparable within one level of the image pyramid; what the cameras
    were, float64, by the names that fit_scene() has for them ("cameras.0.world_to_camera", and "cameras.0.K" and
    "cameras.0.distortion" where they are sought); and norms of the gradient by "world_to_camera" (in radians and sizes of the
    scene), "K" (logarithm of the focal length, widths of the image) and "distortion", which all cameras share: of those that are
    sought on the level, and none where the loss rose and the step was taken back. The last record is the final comparison.
    `search.history` has the size of the level and which steps were the best so far.
    """

    cameras: list[Camera]
    search: PoseFit

    @property
    def camera(self) -> Camera:
        """Of several the first."""
        return self.cameras[0]

    @property
    def loss(self) -> float:
        return self.search.loss

    @property
    def history(self) -> list[Record]:
        return [self._record(number, step) for number, step in enumerate(self.search.history)]

    @property
    def steps(self) -> int:
        return self.search.steps

    @property
    def seconds(self) -> float:
        return self.search.seconds

    @property
    def explained(self) -> float:
        return self.search.explained

    @property
    def converged(self) -> bool:
        return self.search.converged

    @property
    def interrupted(self) -> bool:
        return self.search.interrupted

    @property
    def reason(self) -> str:
        """As of PoseFit."""
        return self.search.reason

    @property
    def uncertainty(self) -> Uncertainty | None:
        """As of PoseFit, of the scene before the cameras; `focal` says how exactly the focal length is known."""
        return self.search.uncertainty

    def plot(self) -> Figure:
        """target | start | fit | difference."""
        return self.search.plot()

    def plot_history(self) -> Figure:
        """The loss and the norm of each gradient, step by step."""
        return self.search.plot_history()

    def save(self, folder: PathLike) -> list[str]:
        """Writes history.json, camera.json, as load_camera reads it (of several camera-0.json and so on), and what PoseFit.save
        writes; gives the names. Raises OSError, or ImportError at last when matplotlib or pillow is missing."""
        Path(folder).mkdir(parents=True, exist_ok=True)
        several = len(self.cameras) > 1
        own = [f"camera-{i}.json" if several else "camera.json" for i in range(len(self.cameras))]
        for name, camera in zip(own, self.cameras, strict=True):
            save_camera(Path(folder) / name, camera)
        own.append(self.write_history(folder))
        return [*own, *self.search.save(folder)]

    def write_history(self, folder: PathLike) -> str:
        """history.json alone, with loss, gradient norms and cameras of each step; gives its name. Raises OSError."""
        with replacing(Path(folder) / "history.json") as temporary:
            temporary.write_text(json.dumps(plain_history(self.history), indent=2) + "\n", encoding="utf-8")
        return "history.json"

    def _record(self, number: int, step: Step) -> Record:
        task = self.search.task
        assert task is not None
        sought = [PARTS_OF[name] for name, entries in PARTS.items() if any(entry in task.free for entry in entries)]
        values = {}
        for i, shot in enumerate(task.shots):
            camera = moved(task.lens(shot.camera, step.pose), step.pose.matrix)
            values |= {f"cameras.{i}.{name}": getattr(camera, name).clone() for name in dict.fromkeys(sought)}
        squares: dict[str, float] = {}
        for part, norm in step.gradient.items():
            squares[PARTS_OF[part]] = squares.get(PARTS_OF[part], 0.0) + norm**2
        return Record(number, step.loss, {name: math.sqrt(square) for name, square in squares.items()}, values)

    def _repr_png_(self) -> bytes | None:
        return self.search._repr_png_()


def fit_camera(
    scene: Mesh | Scene,
    image: Tensor | Sequence[Tensor] | None,
    camera: Camera | Sequence[Camera],
    *,
    mask: Tensor | Sequence[Tensor] | None = None,
    weight: Tensor | Sequence[Tensor] | None = None,
    background: Tensor | float | None = None,
    focal: bool = True,
    principal: bool = False,
    distortion: int = 0,
    max_size: int = 512,
    steps: int = 60,
    spp: int = 16,
    tolerance: float = 3e-4,
    seed: int = 0,
    search: bool = True,
    progress: bool = True,
    callback: Callable[[CameraFit], None] | None = None,
    checkpoint: PathLike | None = None,
    checkpoint_every: int = 25,
    resume: bool = False,
) -> CameraFit:
    """Pose and lens of the camera that took a picture of a known scene.

    scene       what the picture shows, where it is; unlit, or all colours as they are in the picture
    image       (H, W, C) linear radiance, or a list of pictures; None with a mask: that alone is compared
    camera      of size (H, W), where the fit starts: within about 30° and 15 % of the scene's size; or a list of cameras, one
                for each picture, which keep their places to one another, as those of a rig, and share what is found of the lens
    focal       also find the focal length: one factor for both of K
    principal   also find the principal point
    distortion  also find so many coefficients (0, 4, 5 or 8; of a fisheye 4), the first of those of OpenCV's model (k1, k2, p1,
                p2, k3, …) or a fisheye's, as a Camera has them; those that the camera has beyond stay

    mask, weight, background, search, checkpoint, resume and the rest are as for fit_pose(), whose search this is. What a
    picture does not show stays uncertain: focal length against distance where there is hardly any perspective, the
    principal point against a turn of the camera. In photographs `uncertainty` says how exactly pose and focal length are known,
    and one that is not known to 5 % is not `converged`. Raises TypeError or ValueError that names the argument.
    """
    projections = set()
    for one in camera if isinstance(camera, (list, tuple)) else [camera]:
        if not isinstance(one, Camera):
            raise TypeError(f"camera: expected a Camera, got {type(one).__name__}; make one with Camera.look_at(…)")
        projections.add(one.projection)
    count = check_int("distortion", distortion, 0, MOST_COEFFICIENTS)
    for projection in sorted(projections) if count else []:
        if projection not in ("perspective", "fisheye"):
            raise ValueError(f"distortion: expected 0 for this projection, {projection}, got {count}")
        if projection == "fisheye" and count != 4:
            raise ValueError(f"distortion: expected 0 or 4 for a fisheye, got {count}")
        if projection == "perspective" and count not in (4, 5, 8):
            raise ValueError(f"distortion: expected 0, 4, 5 or 8 for a perspective camera, got {count}")
    lens = Lens(False, check_flag("focal", focal), check_flag("principal", principal), count)
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: expected a function of a CameraFit, got {type(callback).__name__}")
    target: object = image
    names = Names(
        "scene", "mask" if image is None else "image", "camera", ("fit_scale", "focal", "principal", "distortion")
    )
    if image is None:
        if mask is None:
            raise ValueError("image: expected a picture, or a mask, to compare with, got neither")
        scene, target = bare(scene), mask

    def result(search: PoseFit) -> CameraFit:
        return CameraFit([moved(seen, search.matrix) for seen in search.cameras], search)

    def step(search: PoseFit) -> None:
        assert callback is not None
        callback(result(search))

    start = torch.eye(4, dtype=torch.float64)
    found = search_pose(
        scene, target, camera, mask, start, lens, background, weight, None, names, max_size=max_size, steps=steps, spp=spp,
        tolerance=tolerance, seed=seed, search=search, progress=progress, callback=None if callback is None else step,
        checkpoint=checkpoint, checkpoint_every=checkpoint_every, resume=resume,
    )  # fmt: skip
    return result(found)


def moved(camera: Camera, matrix: Tensor) -> Camera:
    """The camera that sees a scene at rest as this one W sees it moved by the matrix M (4, 4): W M."""
    W = camera.world_to_camera
    return camera.replace(world_to_camera=(W.detach().double() @ matrix).to(W))
