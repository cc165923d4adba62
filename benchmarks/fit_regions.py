"""fit_scene(loss="region") from one photograph without a mask: how often it finds a pose, or a shape and its place, and knows.

    python -m benchmarks.fit_regions [--what bracket vase] [--methods adam gauss-newton] [--seeds 2 3 4 5 6 7 8 9]

bracket  the pose of a bracket without colours at 128², from 12.3° and 8.4 % of its size off
vase     four radii and the pose of a vase at 96², from 20 % and 3 % of its size off
"""

from __future__ import annotations

import argparse
import time

import torch
from brackets import START, bracket, camera, errors
from photographs import photograph
from vases import RADII, VIEW, vase

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, PoseParameter, fit_scene, losses
from edgegrad.fit.descent.result import Fit
from edgegrad.fit.placement import Pose

OFF = torch.tensor([1.2, 0.8, 1.2, 0.8])


def of_bracket(method: str, seed: int) -> tuple[Fit, str]:
    view = camera(128)
    image = photograph(view, seed=seed, sampling=eg.Sampling(lights=16))
    sought = {"pose": PoseParameter(Pose(START[:3, :3], START[:3, 3]))}
    options = FitOptions(seed=0, loss="region", method=method, spp=8, progress=False)
    fit = fit_scene(bracket(plain=True), image, view, sought, options=options)
    degrees, percent = errors(fit.poses["pose"])
    return fit, f"{degrees:5.2f}° {percent:5.2f} %"


def of_vase(method: str, seed: int) -> tuple[Fit, str]:
    colors = 0.45 + 0.25 * torch.sin(3.0 * vase(RADII).verts)
    image = photograph(VIEW, vase(RADII).replace(colors=colors), seed=seed, sampling=eg.Sampling(lights=16))
    start = Pose(torch.eye(3), torch.tensor([0.06, -0.04, 0.0]))
    sought = {
        "radii": Parameter(0.01, RADII * OFF, low=0.05),
        "pose": PoseParameter(start, of=vase(RADII), rotation=0.01, shift=0.005),
    }

    def scene(values):
        return vase(values["radii"]).transformed(values["pose"].R, values["pose"].t)

    fit = fit_scene(
        scene, image, VIEW, sought, options=FitOptions(seed=0, loss="region", method=method, spp=8, progress=False)
    )
    shown = eg.render_aovs(vase(RADII), VIEW, ["alpha"], spp=64)["alpha"]
    return fit, f"IoU {1.0 - float(losses.iou(fit.render(), shown)):.3f}"


KINDS = {"bracket": of_bracket, "vase": of_vase}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--what", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--methods", nargs="+", choices=("adam", "gauss-newton"), default=["adam", "gauss-newton"])
    parser.add_argument("--seeds", nargs="+", type=int, default=range(2, 10), help="of pictures")
    given = parser.parse_args()
    for what in given.what:
        for method in given.methods:
            for seed in given.seeds:
                began = time.process_time()
                fit, off = KINDS[what](method, seed)
                verdict = "converged" if fit.converged else fit.reason.split(":")[0]
                print(
                    f"{what:8s} {method:12s} {seed:3d}  {off:16s} explained {fit.explained:.2f}  {fit.steps:3d} steps "
                    f"{time.process_time() - began:4.1f} s  {verdict}",
                    flush=True,
                )


if __name__ == "__main__":
    main()
