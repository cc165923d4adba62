"""fit_pose by colours in pictures that a lens, a file or a cover has changed: steps, processor time, and how far off it ends.

OMP_NUM_THREADS=1 python -m benchmarks.fit_worn
"""

from __future__ import annotations

import time

import torch
from test_fit import BACKGROUND, START, bracket, camera, errors, picture
from test_fit_robust import blurred, compressed, covered

from edgegrad.fit import fit_pose


def main() -> None:
    view = camera(96)
    sharp = picture(view)
    worn = {
        "sharp": sharp, "blurred by 1 px": blurred(sharp, 1.0), "JPEG 85": compressed(sharp, 85),
        "JPEG 70": compressed(sharp, 70),
        "blurred, JPEG 70": compressed(blurred(sharp, 1.0), 70),
        "blurred, JPEG 70, a quarter covered": compressed(blurred(covered(view, sharp)[0], 1.0), 70),
        "noise": torch.rand(96, 96, 3, generator=torch.Generator().manual_seed(0)),
    }  # fmt: skip
    fit_pose(bracket(), sharp, view, init=START, background=BACKGROUND, steps=2, search=False, progress=False)
    for name, image in worn.items():
        began = time.process_time()
        fit = fit_pose(bracket(), image, view, init=START, background=BACKGROUND, progress=False)
        taken = time.process_time() - began
        degrees, percent = errors(fit)
        print(
            f"{name:36s} {fit.steps:4d} steps {taken:5.1f} s  {degrees:6.2f}° {percent:6.2f} %  {fit.reason[:40]}",
            flush=True,
        )


if __name__ == "__main__":
    main()
