"""Whether fits of rigs know that they are right: cases from seeds, rates, calibration, and the coefficients of the confidence.

    python -m benchmarks.rig_confidence --train [--count 120] [--first 0]
    python -m benchmarks.rig_confidence [--count 60] [--first 1000]
    python -m benchmarks.rig_confidence --sensitivity [NAME …] [--count 12] [--first 0]

A seed draws rig, pose, distance of the start, number of views, masks or pictures, their size, and whether limbs are drawn anew.
A fit is right where all sought joints are within 2°. Seeds below 1000 train; --train prints what stands in
edgegrad/fit/rig/uncertainty.py. --sensitivity prints how results change at half and twice each number of RigSettings.
"""

from __future__ import annotations

import argparse
import math
import random
import time
from collections.abc import Sequence
from typing import NamedTuple

import arms
import figure
import roma
import torch
from torch import Tensor

from edgegrad.fit import FitOptions, fit_rig
from edgegrad.fit.rig.result import RigFit
from edgegrad.fit.rig.settings import RIG, RigSettings

from .poses.logistic import trained
from .poses.sensitivity import variants
from .poses.summary import SURE, bins, calibration_error

RIGHT = 2.0  # degrees
LIMB = ["left arm", "left elbow", "left hand"]  # of a figure, sought alone


class Trial(NamedTuple):
    words: str
    error: float  # degrees, of the worst joint
    fit: RigFit


def trial(seed: int) -> Trial:
    """Draw a case and fit it."""
    r, g = random.Random(seed), torch.Generator().manual_seed(seed)
    kind, count, size = r.choice(("arm", "arm", "arm", "figure")), r.randint(1, 4), r.choice((24, 32, 48, 64))
    pictures, search, most, distance = r.random() < 0.4, r.choice((0, 0, 6)), r.uniform(10, 60), r.uniform(0.2, 1.0)
    if kind == "arm":
        bones = r.randint(2, 4)
        rig, cameras = arms.arm(bones, colored=True), arms.views(size, count)
        seek = list(rig.deformer.names)
        truth = _turns(bones, most, g)
    else:
        rig, cameras, seek = figure.figure(3, colored=True), figure.cameras(size)[:count], LIMB
        truth = _turns(len(rig.deformer.names), most, g)
    rows = [rig.deformer.names.index(name) for name in seek]
    start = truth.clone()
    start[rows] *= 1.0 - distance
    shown = arms.shown(rig.posed(truth), cameras, "image" if pictures else "alpha")
    images, masks = (shown, None) if pictures else (None, shown)
    options = FitOptions(seed=seed, progress=False)
    fit = fit_rig(
        rig, images, cameras, masks=masks, init={"rotations": start}, seek=seek, search=search, options=options
    )
    R, S = (roma.rotvec_to_rotmat(turns[rows]) for turns in (fit.values["rotations"], truth))
    error = float(roma.rotmat_geodesic_distance(R, S).rad2deg().max())
    words = f"{kind} of {len(seek)}, {count} {'pictures' if pictures else 'masks'} at {size}², search={search}"
    return Trial(f"{words}, start {distance * most:.0f}° off", error, fit)


def _turns(count: int, most: float, g: torch.Generator) -> Tensor:
    axes = torch.randn(count, 3, generator=g, dtype=torch.float64)
    angles = math.radians(most) * torch.rand(count, 1, generator=g, dtype=torch.float64)
    return angles * axes / axes.norm(dim=1, keepdim=True)


def print_table(names: Sequence[str], seeds: Sequence[int]) -> None:
    """Print a Markdown table: right ones, median error and time of a fit, by default and at half and twice each number."""
    default = RigSettings()
    print(
        f"By default: {_cell(default, seeds)}.\n\n| setting | value | at half | at twice |\n|---|---|---|---|",
        flush=True,
    )
    for name, value, changed in variants(default):
        if not names or name in names:
            print(f"| `{name}` | {value:g} | {' | '.join(_cell(one, seeds) for one in changed)} |", flush=True)


def _cell(settings: RigSettings, seeds: Sequence[int]) -> str:
    for name, value in vars(settings).items():
        object.__setattr__(RIG, name, value)
    began = time.process_time()
    errors = torch.tensor([trial(seed).error for seed in seeds])
    seconds = (time.process_time() - began) / len(errors)
    return f"{int((errors < RIGHT).sum())} of {len(errors)} right, median {errors.median():.2f}°, {seconds:.1f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", action="store_true", help="print coefficients")
    parser.add_argument("--sensitivity", nargs="*", metavar="NAME", help="print a table of settings")
    parser.add_argument("--count", type=int, help="cases (120 with --train, 12 with --sensitivity, else 60)")
    parser.add_argument("--first", type=int, help="the first seed (1000 for the test, else 0)")
    told = parser.parse_args()
    tests = not told.train and told.sensitivity is None
    first = (1000 if tests else 0) if told.first is None else told.first
    if told.sensitivity is not None:
        return print_table(told.sensitivity, range(first, first + (told.count or 12)))
    features, right, sure, rests = [], [], [], []
    for seed in range(first, first + (told.count or (120 if told.train else 60))):
        began = time.process_time()
        words, error, fit = trial(seed)
        features.append(fit.features)
        right.append(error < RIGHT)
        sure.append(fit.confidence)
        rests.append(fit.converged)
        seconds = time.process_time() - began
        own = " ".join(f"{name} {value:.3f}" for name, value in fit.features.items())
        print(
            f"{seed}: {words}: {error:.2f}° off, confidence {fit.confidence:.2f}, {fit.reason[:20]}; {own}; {seconds:.1f} s",
            flush=True,
        )
    if told.train:
        found = trained(features, right, ridge=1.0)
        print(found)
        sure = [found.probability(one) for one in features]
    wrong = sum(p >= SURE and not ok for p, ok in zip(sure, right, strict=True))
    said = sum(ok and not good for ok, good in zip(rests, right, strict=True))
    print(f"right: {sum(right)} of {len(right)}; converged: {sum(rests)}, of which wrong {said}")
    print(f"confidence of {SURE} and more: {sum(p >= SURE for p in sure)}, of which wrong {wrong}")
    print(f"calibration error: {calibration_error(bins(list(zip(sure, right, strict=True)))):.3f}")


if __name__ == "__main__":
    main()
