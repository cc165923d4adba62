"""Descents of an objective of views, by the optimiser that the options name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from torch import Tensor

from ...optim.adam import AdamDescent, AdamSettings
from ...optim.gauss_newton import GaussNewtonDescent
from ...optim.levenberg_marquardt import LevenbergMarquardtSettings
from ...optim.loop import nothing
from ...optim.parameter import Parameter
from ...optim.tensors import DescentResult, Ending, Record, TensorDescent, descend
from ..checkpoints import CheckpointFile
from ..losses import REGION
from .curvature import MAX_NUMBERS, check_pointwise, curvature
from .objective import Objective
from .settings import DESCENT

# No number moves by more than ten learning rates in a step.
GAUSS_NEWTON = LevenbergMarquardtSettings(trust_radius=10.0, settled_steps=6)
Save = Callable[[dict[str, Any]], Any]


def descend_views(
    objective: Objective,
    parameters: Mapping[str, Parameter],
    save: Save = nothing,
    saved: Mapping[str, Any] | None = None,
    title: str | None = "fit",
    report: Callable[[Record, dict[str, Tensor]], Record] = lambda record, values: record,
    gauss_newton: LevenbergMarquardtSettings = GAUSS_NEWTON,
) -> DescentResult:
    """Descend from the parameters' values as the objective's options say.

    save, saved  get the descent's state every few steps, and give such a state to go on from
    report       makes what the callback gets, of a step's record and the tensors after the step
    Raises ValueError where the options' method cannot serve.
    """
    options, descent = objective.options, _optimizer(objective, parameters, gauss_newton)
    callback, every = options.callback, None if options.checkpoint is None else options.checkpoint.every

    def after_step() -> None:
        if callback is not None:
            callback(report(descent.history[-1], descent.values))

    title = title if options.progress else None
    return descend(descent, options.steps, after_step, save=save, every=every, saved=saved, title=title)


def descend_levels(
    checkpoint: CheckpointFile,
    values: dict[str, Tensor],
    count: int,
    descend_level: Callable[[dict[str, Tensor], int, Save, Mapping[str, Any] | None], DescentResult],
    between: Callable[[dict[str, Tensor], int], dict[str, Tensor]] = lambda values, level: values,
) -> DescentResult:
    """Descend on so many levels, each from where the one before ended.

    descend_level  of values, level, and the arguments `save` and `saved` of descend_views()
    between        makes the values from which a further level starts
    """
    saved, level, history, seconds = checkpoint.read(), 0, [], 0.0
    if saved is not None:
        level, values, seconds = saved["level"], saved["values"], saved["seconds"]
        history = [Record(*record) for record in saved["history"]]
    while True:
        stage = {"level": level, "values": values, "history": [tuple(r) for r in history], "seconds": seconds}

        def save(loop: dict[str, Any], stage: dict[str, Any] = stage) -> None:
            checkpoint.write({**stage, "loop": loop})

        found: DescentResult = descend_level(values, level, save, None if saved is None else saved["loop"])
        saved, values = None, found.values
        history = continued(history, found.history)
        seconds += found.seconds
        if found.ending is Ending.INTERRUPTED or level == count - 1:
            return DescentResult(values, history, seconds, found.ending)
        level += 1
        values = between(values, level)


def continued(history: Sequence[Record], later: Sequence[Record]) -> list[Record]:
    """Return a history with the records of a further descent, numbered on."""
    return [*history, *(record._replace(step=len(history) + k) for k, record in enumerate(later))]


def _optimizer(
    objective: Objective, parameters: Mapping[str, Parameter], gauss_newton: LevenbergMarquardtSettings
) -> TensorDescent:
    options = objective.options
    if options.method == "adam":
        return AdamDescent(objective, parameters, AdamSettings(options.loss_tolerance, options.patience))
    if (count := sum(p.value.numel() for p in parameters.values() if p.value is not None)) > MAX_NUMBERS:
        raise ValueError(
            f'options.method: expected at most {MAX_NUMBERS} numbers to be sought by "gauss-newton", got {count}; '
            'give method="adam"'
        )
    if options.views_per_step is not None:
        raise ValueError(
            'options.views_per_step: expected None for method="gauss-newton", which compares losses of all views'
        )
    check_pointwise(objective)
    tolerance = options.loss_tolerance
    settings = replace(
        gauss_newton, steps=options.steps + 1, tolerance=tolerance,
        settled_steps=gauss_newton.settled_steps if tolerance > 0.0 else None,
        start_damping=DESCENT.region_damping if options.loss == REGION else gauss_newton.start_damping,
    )  # fmt: skip
    return GaussNewtonDescent(objective, partial(curvature, objective), parameters, settings)
