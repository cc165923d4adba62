"""Pictures of a fit: what was compared, and how the mesh moved."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont

from ...files.paths import PathLike, replacing
from ..plots import comparison
from ..result import chosen
from ..views import displayed
from .photo.overlay import overlay
from .result import PoseFit, Step
from .task import PoseTask

PANEL_SIDE, FRAME_SIDE = 512, 256  # largest side of a panel in pixels, in sheet and in draw_animation
MAX_FRAMES = 30
FIGURE_SPP = 64


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


def draw_animation(path: PathLike, fit: PoseFit) -> None:
    """Write target | fit | difference from start to end as an animated WebP. Raises ValueError for a fit that did not take a
    step or came from JSON, OSError when the file cannot be written."""
    task = _task(fit)
    frames = []
    best = _best_steps(fit)
    for step in (best[k] for k in chosen(len(best), MAX_FRAMES)):
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
