"""Images as means of finer ones.

A lit face is shaded about once for the 16 samples of a pixel. Of many small pixels, each is shaded at a point of its own.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.render import render
from edgegrad.scene.scene import Scene


def supersampled(scene: Scene, camera: Camera, times: int, **options: Any) -> Tensor:
    """Return the image (H, W, C), float64, as means over times × times pixels of a finer one. `options` go to render()."""
    (H, W), scale = camera.size, camera.K.new_tensor([[times], [times], [1.0]])
    fine = camera.replace(K=camera.K * scale, size=(times * H, times * W))
    return render(scene, fine, **options).double().reshape(H, times, W, times, -1).mean((1, 3))
