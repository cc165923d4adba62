"""Find the pose of a body of twenty joints from four masks.

    python examples/body.py [--degrees 40] [--size 192] [--seed 0] [--search 40] [--view] [--out body.png]

It starts at rest. Errors are those of rotations, and of the directions in which limbs point: a rotation of a limb about its own
axis hardly changes its outline.
"""

from __future__ import annotations

import argparse
import contextlib
import time
from pathlib import Path
from typing import Any, NamedTuple

import figure
import roma
import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_rig
from edgegrad.fit.rig.result import RigFit

SIZE = 192
LIMIT = 0.75  # radians, of each component of a rotation


class Errors(NamedTuple):
    """Degrees of each joint."""

    rotation: Tensor  # about its own axes
    direction: Tensor  # in the world

    @staticmethod
    def of(rig: eg.rig.Rig, found: Tensor, truth: Tensor) -> Errors:
        """Return the errors of rotation vectors (20, 3)."""
        R, S = roma.rotvec_to_rotmat(found), roma.rotvec_to_rotmat(truth)
        along = torch.tensor(figure.BONES_ALONG, dtype=torch.float64)[..., None]
        a, b = ((rig.joints.world(turns)[:, :3, :3] @ along)[..., 0] for turns in (R, S))
        angle = torch.atan2(torch.linalg.cross(a, b).norm(dim=1), (a * b).sum(1))
        return Errors(roma.rotmat_geodesic_distance(R, S).rad2deg(), angle.rad2deg())

    def __str__(self) -> str:
        parts = (f"{n} {e.median():.2f}° median, {e.quantile(0.9):.2f}° 90 %" for n, e in self._asdict().items())
        return "; ".join(parts)


def trial(
    seed: int, degrees: float = 40.0, size: int = SIZE, search: int = 40, **options: Any
) -> tuple[eg.rig.Rig, Tensor, list[Tensor], RigFit]:
    """Return the rig, its true pose, its masks, and what is found."""
    rig = figure.figure(colored=True).with_limits(rotations=(-LIMIT, LIMIT))
    cameras, truth = figure.cameras(size), figure.pose(seed, degrees)
    masks = [eg.render_aovs(rig.posed(truth), camera, ["alpha"], spp=64, seed=5)["alpha"] for camera in cameras]
    given = FitOptions(seed=seed, **options)
    return rig, truth, masks, fit_rig(rig, None, cameras, masks=masks, search=search, options=given)


def pictures(rig: eg.rig.Rig, truth: Tensor, fit: RigFit, size: int) -> list[dict[str, Tensor]]:
    """Return pictures of two cameras: the true pose, where the fit starts, what it finds."""
    shown = {"target": rig.posed(truth), "start": rig.posed(), "fit": fit.posed()}
    white = torch.ones(3)
    return [
        {name: eg.render(eg.Scene(mesh, background=white), camera, 64) for name, mesh in shown.items()}
        for camera in figure.cameras(size)[:2]
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--degrees", type=float, default=40.0, help="of each joint, at most")
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--search", type=int, default=40)
    parser.add_argument("--view", action="store_true", help="in a browser")
    parser.add_argument("--out", type=Path, default=Path("body.png"))
    options = parser.parse_args()
    with contextlib.ExitStack() as stack:
        view = stack.enter_context(eg.viewer()) if options.view else None
        if view is not None:
            print(view.url, flush=True)
        began = time.perf_counter()
        rig, truth, _, fit = trial(options.seed, options.degrees, options.size, options.search, callback=view)
        print(f"{fit.reason} after {time.perf_counter() - began:.0f} s")
        print("start:", Errors.of(rig, torch.zeros_like(truth), truth))
        print("fit:  ", Errors.of(rig, fit.values["rotations"], truth))
        rows = [torch.cat(list(row.values()), 1) for row in pictures(rig, truth, fit, max(options.size, 256))]
        eg.write_image(options.out, torch.cat(rows, 0))
        print(f"wrote {options.out}: true pose, start, fit")
        if view is not None:
            view.show(fit)
            view.wait()


if __name__ == "__main__":
    main()
