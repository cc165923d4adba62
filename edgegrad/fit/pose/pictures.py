"""Pictures of a fit: what was compared, how the loss fell, and how the mesh moved."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from ...files.paths import PathLike, replacing
from ..plots import comparison, loss_figure
from ..result import chosen
from ..views import displayed
from .photo.overlay import overlay
from .result import PoseFit, Step
from .task import PoseTask

PANEL_SIDE, FRAME_SIDE = 512, 256  # largest side of a panel in pixels, in sheet and in draw_animation
MAX_FRAMES = 30
FIGURE_SPP = 64
GREY = "#c4c4c4"


def sheet(*fits: PoseFit, most: int | None = None) -> Figure:
    """Draw target | start | fit | difference, a row for each picture of one fit or several, or for at most so many; with a mask
    all over black, as they were compared. Raises ValueError for a fit that did not take a step or came from JSON."""
    rows = []
    for fit in fits:
        task = _task(fit)
        start, end = (
            overlay(task, PANEL_SIDE, FIGURE_SPP, step.pose) for step in (fit.history[0], _best_steps(fit)[-1])
        )
        rows += [(target, a, b) for (target, a), (_, b) in zip(start, end, strict=True)]
    return comparison([rows[k] for k in chosen(len(rows), len(rows) if most is None else most)])


def curves_of(fit: PoseFit) -> Figure:
    """Draw the loss of every step, one colour a level of the image pyramid, grey where a search failed, and the norms of the
    gradient. Raises ValueError for a fit that did not take a step or came from JSON."""
    _task(fit)
    # The last entry of a whole fit is the final comparison, which has less noise.
    history = fit.history[:-1] if len(fit.history) > 1 and not fit.interrupted else fit.history
    begins = [k for k, step in enumerate(history) if k == 0 or step.size != history[k - 1].size]
    sizes = sorted({step.size for step in history})
    figure, above = loss_figure([step.gradient for step in history])
    above.plot(range(1, len(history) + 1), [step.loss for step in history], ".", color=GREY, markersize=4)
    labelled = set()
    for begin, end in zip(begins, [*begins[1:], len(history)], strict=True):
        best = [k for k in range(begin, end) if history[k].best]
        h, w = history[begin].size
        color = colormaps["viridis"](0.85 * sizes.index((h, w)) / max(1, len(sizes) - 1))
        label = None if (h, w) in labelled else f"{w} × {h} px"  # Later ones belong to restarts.
        labelled.add((h, w))
        above.plot([k + 1 for k in best], [history[k].loss for k in best], ".-", color=color, label=label)
    if min(step.loss for step in history) > 0.0:  # Log likelihood ratios are not.
        above.set_yscale("log")
    above.legend(frameon=False, fontsize=8, title="best so far", title_fontsize=8)
    return figure


def draw_animation(path: PathLike, fit: PoseFit) -> None:
    """Write target | fit | difference from start to end as an animated WebP. Raises ValueError for a fit that did not take a
    step or came from JSON, OSError when the file cannot be written."""
    task = _task(fit)
    frames = []
    for step in _frames(_best_steps(fit)):
        target, image = (displayed(one).numpy() for one in overlay(task, FRAME_SIDE, FIGURE_SPP, step.pose)[0])
        font = ImageFont.load_default(max(9, round(0.05 * target.shape[0])))
        panels = np.concatenate([target, image, np.clip(2.0 * np.abs(image - target), 0, 1)], 1)
        frame = Image.fromarray((panels * 255.0).round().astype(np.uint8))
        edge = round(0.03 * frame.height)
        for k, title in enumerate(("target", f"fit at {max(step.size)} px", "difference x 2")):
            place = k * frame.width // 3 + edge, edge
            ImageDraw.Draw(frame).text(place, title, "white", font, stroke_width=1, stroke_fill="black")
        frames.append(frame)
    durations = [1000, *[200] * (len(frames) - 2), 2500][-len(frames) :]  # milliseconds
    with replacing(path) as temporary:
        frames[0].save(temporary, save_all=True, append_images=frames[1:], duration=durations, loop=0, quality=85)


def _task(fit: PoseFit) -> PoseTask:
    if fit.task is None or not fit.history:
        raise ValueError(
            "fit: expected one that took a step, got one without; draw what fit_pose returns, not from_json"
        )
    return fit.task


def _best_steps(fit: PoseFit) -> list[Step]:
    """Return the best poses in turn; the last one is what the fit returned."""
    return [step for step in fit.history if step.best]


def _frames(steps: list[Step]) -> list[Step]:
    """Return the ends, and the steps between that moved the mesh by more than a MAX_FRAMES-th of the whole."""
    poses = torch.stack([step.pose.matrix[:3] for step in steps])
    remaining = poses - poses[-1]
    # Rotation and translation count equally, each in proportion to the whole motion.
    turn, shift = (part.flatten(1).norm(dim=1) for part in (remaining[..., :3], remaining[..., 3:]))
    far = turn / (turn.max() + 1e-30) + shift / (shift.max() + 1e-30)
    kept = [0]
    for k in range(1, len(steps) - 1):
        if abs(float(far[k] - far[kept[-1]])) > 2.0 / MAX_FRAMES:
            kept.append(k)
    return [steps[k] for k in kept] + ([steps[-1]] if len(steps) > 1 else [])
