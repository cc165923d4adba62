"""fit_camera(): where a picture of a known scene was taken, and through which lens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from .._check import check_int
from .._files import PathLike
from ..camera import Camera
from ..io import save_camera
from ..mesh import Mesh
from ..scene import Scene
from .pose import _flag, search_pose
from .result import PoseFit
from .task import Lens

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MOST_COEFFICIENTS = 8


@dataclass(frozen=True, eq=False)
class CameraFit:
    """What fit_camera found: the camera, and the search for it, in which the scene moved before a camera at rest."""

    camera: Camera
    search: PoseFit

    @property
    def loss(self) -> float:
        return self.search.loss

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
    def state(self) -> str:
        """In words: "converged", or what kept it from that."""
        return self.search.state

    def plot(self) -> Figure:
        """target | start | fit | difference."""
        return self.search.plot()

    def save(self, folder: PathLike) -> list[str]:
        """Writes camera.json, as load_camera reads it, and what PoseFit.save writes; gives the names. Raises OSError."""
        names = self.search.save(folder)
        save_camera(Path(folder) / "camera.json", self.camera)
        return ["camera.json", *names]

    def _repr_png_(self) -> bytes | None:
        return self.search._repr_png_()


def fit_camera(
    scene: Mesh | Scene,
    image: Tensor | None,
    camera: Camera,
    *,
    mask: Tensor | None = None,
    weight: Tensor | None = None,
    background: Tensor | float | None = None,
    focal: bool = True,
    principal: bool = False,
    distortion: int = 0,
    max_size: int = 512,
    steps: int = 60,
    spp: int = 16,
    tolerance: float = 3e-4,
    seed: int = 0,
    progress: bool = True,
    callback: Callable[[CameraFit], None] | None = None,
) -> CameraFit:
    """Pose and lens of the camera that took a picture of a known scene.

    scene       what the picture shows, where it is; unlit, or all colours as they are in the picture
    image       (H, W, C) linear radiance; None with a mask: that alone is compared
    camera      of size (H, W), where the fit starts: within about 30° and 15 % of the scene's size
    focal       also find the focal length: one factor for both of K
    principal   also find the principal point
    distortion  also find so many coefficients, in the order in which a Camera has them; those that the camera has beyond stay

    mask, weight, background and the rest are as for fit_pose(), whose search this is. What a picture does not show stays
    uncertain: focal length against distance where there is hardly any perspective, the principal point against a turn of the
    camera. Raises TypeError or ValueError that names the argument.
    """
    if not isinstance(camera, Camera):
        raise TypeError(f"camera: expected a Camera, got {type(camera).__name__}; make one with Camera.look_at(…)")
    count = check_int("distortion", distortion, 0, MOST_COEFFICIENTS)
    if count and camera.projection not in ("perspective", "fisheye"):
        raise ValueError(f"distortion: expected 0 for this projection, {camera.projection}, got {count}")
    if count and camera.projection == "fisheye" and count != 4:
        raise ValueError(f"distortion: expected 0 or 4 for a fisheye, got {count}")
    if count and camera.projection == "perspective" and count not in (4, 5, 8):
        raise ValueError(f"distortion: expected 0, 4, 5 or 8 for a perspective camera, got {count}")
    lens = Lens(False, _flag("focal", focal), _flag("principal", principal), count)
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: expected a function of a CameraFit, got {type(callback).__name__}")
    target: object = image
    if image is None:
        if mask is None:
            raise ValueError("image: expected a picture, or a mask, to compare with, got neither")
        scene, target = _bare(scene), mask

    def result(search: PoseFit) -> CameraFit:
        seen = search.camera
        # The scene moved by M before the camera W: W M sees the scene at rest alike.
        moved = camera.world_to_camera.detach().double() @ search.matrix
        return CameraFit(seen.replace(world_to_camera=moved.to(seen.world_to_camera)), search)

    def step(search: PoseFit) -> None:
        assert callback is not None
        callback(result(search))

    start = torch.eye(4, dtype=torch.float64)
    found = search_pose(
        scene, target, camera, mask, start, lens, background, weight, max_size=max_size, steps=steps, spp=spp,
        tolerance=tolerance, seed=seed, progress=progress, callback=None if callback is None else step,
    )  # fmt: skip
    return result(found)


def _bare(scene: Mesh | Scene) -> Scene:
    """Shapes alone."""
    meshes: Sequence[Mesh] = [scene] if isinstance(scene, Mesh) else scene.meshes
    return Scene([Mesh(mesh.verts, mesh.faces) for mesh in meshes])
