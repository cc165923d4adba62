"""Images as means of finer ones: a face in the light is shaded about once for 16 samples of a pixel, of many small pixels each
in a place of its own."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.render import render
from edgegrad.scene.scene import Scene


def finer_image(scene: Scene, camera: Camera, times: int, **options: Any) -> Tensor:
    """(H, W, C) float64: the mean over times × times pixels for each, of the other arguments of render()."""
    (H, W), scale = camera.size, camera.K.new_tensor([[times], [times], [1.0]])
    fine = camera.replace(K=camera.K * scale, size=(times * H, times * W))
    return render(scene, fine, **options).double().reshape(H, times, W, times, -1).mean((1, 3))
