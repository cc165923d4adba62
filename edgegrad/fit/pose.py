"""fit_pose(): where a known mesh stands in a picture.

The loss is the mean squared difference between picture and render, both blurred, on an image pyramid from coarse to fine.
Each step of a Gauss-Newton search moves the pose by a rotation about the object's centre, a shift in units of the object's
size, and logarithms of scale and focal length, and starts anew from the pose that it reached.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch
from torch import Tensor
from tqdm import tqdm

from .._check import check_int, check_positive_int
from ..camera import Camera
from ..mesh import Mesh
from ..scene import Scene
from .gauss_newton import NOISE, GaussNewton
from .result import PoseFit, Step, pose_from_matrix
from .task import TURN, PoseTask, zoomed

ASIDE, ASIDE_STEPS = 0.2, 20  # radians between the starts on the coarsest level, and steps from each
FINAL_SPP = 64  # samples a pixel when start and end are compared


@torch.inference_mode(False)
@torch.enable_grad()
def fit_pose(
    mesh: Mesh | Scene,
    target: Tensor,
    camera: Camera,
    mask: Tensor | None = None,
    init: PoseFit | Tensor | None = None,
    *,
    fit_scale: bool = False,
    fit_focal: bool = False,
    background: Tensor | float | None = None,
    max_size: int = 256,
    steps: int = 40,
    spp: int = 16,
    tolerance: float = 3e-4,
    seed: int = 0,
    progress: bool = True,
    callback: Callable[[PoseFit], None] | None = None,
) -> PoseFit:
    """Rotation and translation (and scale, and focal length) of a known mesh in a picture.

    mesh        what the picture shows, with its colours; the meshes of a Scene move together
    target      (H, W, C) linear radiance, as read_image gives it, with the mesh's channels
    camera      the camera of the picture, of size (H, W); with fit_focal, its focal length is where the fit starts
    mask        (H, W) or (H, W, 1), 1 on the object and 0 elsewhere. Then the colours inside the mask and the mask itself
                are compared; a plain mesh, which has no colours to compare, is fitted to the mask alone
    init        the pose to start from, within about 20° and 15 % of the object's size of the true one: an earlier fit, or
                mesh to world as a matrix (4, 4) for column vectors; the identity when None
    fit_scale   also find the mesh's scale. One picture shows size over distance only, so the centre then keeps its depth
    fit_focal   also find the focal length: one factor for both of K
    background  without a mask, what stands behind the object: a number, (C,) or (H, W, C); when None, the scene's own, or
                else the median colour of the picture's border
    max_size    a larger picture is reduced to so many pixels on its longer side
    steps       at most so many on each level of the pyramid
    spp         samples a pixel of each render on the finest level; the others take as many in all
    tolerance   converged when a step on the finest level is shorter: in radians, object sizes (the diagonal of the bounding
                box), and logarithms of scale and focal length
    seed        the same seed gives the same fit
    progress    show a bar with the loss on standard error
    callback    called after each step with the best fit so far

    KeyboardInterrupt, also from the callback, ends the fit and returns the best so far with `interrupted` set.
    Works in torch.no_grad() and torch.inference_mode() too. Raises TypeError or ValueError that names the argument, also when
    the object leaves no trace in the picture at the start.
    """
    began = time.perf_counter()
    for name, count in (("max_size", max_size), ("steps", steps), ("spp", spp)):
        check_positive_int(name, count)
    check_int("seed", seed, 0, 2**32 - 1)
    for name, flag in (("fit_scale", fit_scale), ("fit_focal", fit_focal)):
        if not isinstance(flag, bool):
            raise TypeError(f"{name}: expected True or False, got {type(flag).__name__} ({flag!r})")
    if not isinstance(tolerance, (int, float)):
        raise TypeError(f"tolerance: expected a number, got {type(tolerance).__name__} ({tolerance!r})")
    if not tolerance > 0.0:
        raise ValueError(f"tolerance: expected a number above 0, got {tolerance:g}")
    if callback is not None and not callable(callback):
        raise TypeError(f"callback: expected a function of a PoseFit, got {type(callback).__name__}")
    start = best = pose_from_matrix("init", torch.eye(4) if init is None else getattr(init, "matrix", init))
    task = PoseTask.of(mesh, target, camera, mask, background, start, fit_scale, fit_focal)
    levels = task.pyramid(start, max_size, spp)
    generator = torch.Generator().manual_seed(seed)
    history: list[Step] = []
    loss, converged, interrupted = math.nan, False, False

    def result() -> PoseFit:
        view = camera.replace(K=zoomed(camera.K, best.focal.to(camera.K))) if fit_focal else camera
        seconds = time.perf_counter() - began
        return PoseFit(
            best.R, best.t, float(best.scale), view, loss, len(history), seconds, converged, interrupted, list(history), task
        )  # fmt: skip

    # The way down from the start may end at a wrong pose that looks alike, such as one tilted the other way. The coarsest
    # level costs little: there, search also from beside the start, tilted about the camera's axes.
    tilts = ASIDE * torch.tensor([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]], dtype=torch.float64)
    starts = [start, *(task.moved(start, [TURN, TURN + 1], tilt) for tilt in tilts)]
    total = len(starts) * min(steps, ASIDE_STEPS) + steps * (len(levels) - 1)
    bar = tqdm(total=total, desc="fit", unit="step", disable=not progress, leave=False)
    try:
        for level in levels:
            first, size, lowest = level is levels[0], level.camera.size, math.inf
            for origin in starts if first else [best]:
                search, pose, here = GaussNewton(generator), origin, origin
                most = min(steps, ASIDE_STEPS) if first else steps
                while search.seen < most:
                    p = torch.zeros(len(level.free), dtype=torch.float64, requires_grad=True)
                    moved = task.moved(pose, level.free, p)
                    residual = task.image(level, moved, level.spp, seed + len(history)) - level.target
                    if search.observe(p, residual):
                        here = pose
                        if search.loss <= NOISE * lowest:
                            best, loss, lowest = pose, search.loss, search.loss
                    if search.blind:
                        break
                    step = search.step()
                    converged = float(step.abs().max()) < tolerance * level.coarseness
                    history.append(Step(size, float(residual.detach().square().mean()), pose, pose is best))
                    bar.set_postfix_str(f"{size[1]} × {size[0]} px, loss {loss:.2e}", refresh=False)
                    bar.update()
                    if callback is not None:
                        callback(result())
                    if converged:
                        break
                    pose = task.moved(here, level.free, step)
                bar.total -= most - search.seen
            if not history:
                raise ValueError(
                    "init: expected a pose at which the picture changes when the object moves, got one at which it does "
                    "not; is the object out of view, or of the background's colour?"
                )
        # The same many samples for both: a fit never ends at a worse pose than its start.
        final = levels[-1]
        with torch.no_grad():
            images = [(task.image(final, end, FINAL_SPP, seed), end) for end in (best, start)]
        ends = [(float((image - final.target).square().mean()), end) for image, end in images]
        loss, best = min(ends, key=lambda end: end[0])
        history.append(Step(final.camera.size, loss, best, True))
    except KeyboardInterrupt:
        interrupted, converged = True, False
    finally:
        bar.close()
    return result()
