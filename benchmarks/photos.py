"""fit_pose and fit_camera in photographs: how often they find the pose, how exactly, and whether they know.

    python -m benchmarks.photos [FOLDER] [--parts lit squirrel …] [--starts 20] [--first 0] [--meshes FILE …]
        [--pictures out/photos] [--json out/photos.json]

Without FOLDER, in pictures made here (photo_cases.py), numbered from --first on, of which each has a seed, a mesh and a start of
its own: of the stone of the examples, or of --meshes by turns, before --backgrounds, the photographs of FOLDER, or a clutter of
boards. With it, in real photographs, whose cameras are OpenCV's (x right, y down, z
forward, pixels, X_cam = R X + t):

    squirrel/frame.png, squirrel_demo_low.obj (mm, without colours), camera_and_init.json: K, cam_R_model_init,
        cam_t_model_init_mm, mesh_centre_to_subtract_mm
    gelatin_box/000001-color.png, 000001-depth.png (16 bits, 0.1 mm), 009_gelatin_box_textured.gltf (m),
        009_gelatin_box_tex1024.png, reference.json: {"009_gelatin_box": K, cam_R_mesh, cam_t_mesh_m}
    cracker_box/image_rgb.png, 003_cracker_box_textured.gltf (m), 003_cracker_box_tex1024.png, reference.json: K, a start
        cam_R_bop, cam_t_bop_m, and gltf_to_bop_R, gltf_to_bop_t_m
    bottle/_sequence/color_camera_image_200.png, …_201.png, depth_camera_image_200.png, …_201.png, depth_camera.yaml (of M3T),
        bottle/_body/schauma.obj (m), reference.json: K, {"schauma": cam_R_body, cam_t_body_m, geometry_offset_z_m}

In the parts `camera` and `focal` the object stays, and fit_camera looks for the camera, which was moved as the object is in the
others; in `focal` also for a focal length that is off by FOCAL.

Errors are the angle, and how far the object's centre is off, as a part of the object's size, the diagonal of its bounding box, or
in its mesh's units; of real photographs also how far the contour is from their edges, in the middle (photo_edges.py). `falsely`
counts fits that say `converged` and are more than three times the limits off. `work` is processor time of all threads, `first`
that of the first, about what a fit takes where nothing else runs.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from objects import pebble
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_camera, fit_pose, fit_poses
from edgegrad.fit.pose.result import PoseFit

from . import photo_edges, photo_folder
from .photo_cases import Case, Kind, Placed, clutter, rendered, several

FAR_OFF = 3.0  # limits: beyond, a fit must not say that it has converged
FOCAL = 1.06  # by this factor or its inverse
NEAR = 6.0  # pixels around a contour where edges of a real photograph are looked for
STONE = "stone"  # the mesh of the examples
RIM = 0.3  # share of a pixel by which a neighbour's alpha is higher on a contour


@dataclass(frozen=True)
class Limits:
    """Largest errors of a fit that counts as right, and the share of fits that must be."""

    degrees: float
    shift: float  # of the object's size
    share: float = 0.0  # of the fits; 0 where that is not asked
    apart: float = 0.0  # degrees to the fits' own middle; 0 where that is not asked


class Work(NamedTuple):
    """Seconds of processor time."""

    every: float  # of all threads
    first: float  # of the first one, about what a fit takes where nothing else runs

    @staticmethod
    def now() -> Work:
        return Work(time.process_time(), time.thread_time())

    @staticmethod
    def since(began: Work) -> Work:
        now = Work.now()
        return Work(now.every - began.every, now.first - began.first)


@dataclass
class Trial:
    """One fit."""

    case: str
    start_degrees: float
    start_shift: float  # of the object's size, as `shift`
    degrees: float
    shift: float
    length: float  # of the shift, in the mesh's units
    explained: float
    converged: bool
    steps: int
    seconds: float
    work: float  # as Work.every
    first: float
    right: bool
    falsely: bool
    matrix: list[list[float]]
    edges: list[float] = field(
        default_factory=list
    )  # of real ones: middle, 90 % of the contour's distances to edges, pixels

    def line(self) -> str:
        verdict = "falsely converged" if self.falsely else "" if self.right else "missed"
        return (
            f"  {self.case:28s} {self.start_degrees:5.1f}° {self.start_shift:5.1%} → {self.degrees:6.2f}° {self.shift:6.2%} "
            f"({self.length:.3g})  explained {self.explained:.2f}  {'converged' if self.converged else '-':9s} "
            f"{self.steps:3d} steps {self.seconds:5.1f} s, {self.work:.1f} of work  "
            f"{''.join(f'{value:.2f} px ' for value in self.edges)} {verdict}"
        )


@dataclass
class Part:
    """Fits of one kind, and what they must reach."""

    name: str
    limits: Limits
    trials: list[Trial] = field(default_factory=list)
    spread: float | None = None  # degrees: the largest angle to the middle one of the ends

    def cells(self) -> tuple[str, ...]:
        count = len(self.trials)
        right = sum(trial.right for trial in self.trials)
        known = sum(trial.converged and trial.right for trial in self.trials)
        falsely = sum(trial.falsely for trial in self.trials)
        must = (
            f"{self.limits.share:.0%} in {self.limits.degrees:g}°, {self.limits.shift:.2g}" if self.limits.share else ""
        )
        met = "" if not self.limits.share else "met" if right >= self.limits.share * count and not falsely else "missed"
        if self.limits.apart and self.spread is not None:
            must += f", {self.limits.apart:g}° apart"
            met = met if self.spread <= self.limits.apart else "missed"
        middle = [statistics.median(getattr(trial, name) for trial in self.trials) for name in ("degrees", "shift")]
        return (
            self.name, f"{right} of {count}", f"{known}", f"{falsely}", f"{middle[0]:.2f}°", f"{middle[1]:.2%}",
            "" if self.spread is None else f"{self.spread:.2f}°",
            f"{statistics.fmean(t.steps for t in self.trials):.0f}",
            *(f"{statistics.fmean(getattr(t, name) for t in self.trials):.1f}" for name in ("work", "first")),
            "" if not self.trials[0].edges else f"{statistics.median(t.edges[0] for t in self.trials):.2f}", must, met,
        )  # fmt: skip


TABLE = (
    "part", "right", "of them converged", "falsely", "angle", "shift", "apart", "steps", "work/s", "first/s", "edges/px",
    "must", "",
)  # fmt: skip
WIDTHS = (22, 10, 17, 7, 7, 7, 7, 5, 6, 7, 8, 34, 6)


@dataclass(frozen=True)
class Run:
    """Settings of all parts."""

    starts: int
    first: int  # number of the first picture that is made here
    pictures: Path | None
    meshes: Sequence[tuple[str, eg.Mesh]]
    backgrounds: Sequence[Tensor]

    def made(self, kind: Kind, seeds: int) -> Iterator[tuple[int, Case]]:
        """Pictures of a kind, of the meshes by turns, with their numbers, to which `seeds` is added."""
        for k in range(self.starts):
            name, mesh = self.meshes[k % len(self.meshes)]
            number = self.first + k
            seed = 0 if kind == "easy" else seeds + number
            yield number, rendered(f"{kind} {name} {seed}", mesh, self.backgrounds, kind, seed)

    def fitted(
        self, part: Part, case: Case, start: Placed | None, truth: Placed, label: str,
        mask: Tensor | None = None, search: bool = True,
    ) -> tuple[Trial, PoseFit]:  # fmt: skip
        """Fit a pose from a start, or without one by a global search."""
        began = Work.now()
        fit = fit_pose(
            case.mesh, case.picture, case.camera, mask, None if start is None else start.matrix, depths=case.depth,
            search="global" if start is None else search, options=FitOptions(seed=0, progress=False),
        )  # fmt: skip
        found = Placed(fit.R, fit.t)
        trial = self.noted(part, case, start, found, truth, fit, Work.since(began))
        self.drawn(label, outlined(case, start, found))
        return trial, fit

    def together(self, part: Part, cases: Sequence[Case], starts: Sequence[Placed], label: str) -> None:
        """Several objects of one picture in one fit."""
        first = cases[0]
        init = [start.matrix for start in starts]
        began = Work.now()
        options = FitOptions(seed=0, progress=False)
        fits = fit_poses([case.mesh for case in cases], first.picture, first.camera, init=init, options=options)
        work = Work.since(began)
        image = first.picture
        for case, start, fit in zip(cases, starts, fits, strict=True):
            found = Placed(fit.R, fit.t)
            self.noted(part, case, start, found, case.truth, fit, work)
            image = outlined(replace(case, picture=image), start, found)
        self.drawn(label, image)

    def drawn(self, label: str, image: Tensor) -> None:
        if self.pictures is not None:
            self.pictures.mkdir(parents=True, exist_ok=True)
            eg.write_image(self.pictures / f"{label}.png", image)

    def noted(
        self, part: Part, case: Case, start: Placed | None, found: Placed, truth: Placed, fit: PoseFit, work: Work
    ) -> Trial:  # fmt: skip
        limits = part.limits
        before = (math.nan, math.nan) if start is None else case.apart(start, truth)
        after = case.apart(found, truth)
        off = max(after[0] / limits.degrees, after[1] / case.size / limits.shift)
        trial = Trial(
            case.name, before[0], before[1] / case.size, after[0], after[1] / case.size, after[1], fit.explained,
            fit.converged, fit.steps, fit.seconds, *work, off <= 1.0, fit.converged and off > FAR_OFF,
            found.matrix.tolist(),
        )  # fmt: skip
        if case.real:
            trial.edges = photo_edges.across(case.picture, case.alpha(found), NEAR).quantiles()
        part.trials.append(trial)
        print(trial.line(), flush=True)
        if not trial.right or not trial.converged:
            print(f"    {fit.reason}", flush=True)
        return trial


def outlined(case: Case, start: Placed | None, found: Placed, camera: eg.Camera | None = None) -> Tensor:
    """Return the photograph (H, W, 3) with the contours of the start (blue) and of the fit by its own camera (yellow)."""
    image = case.picture
    for pose, seen, color in (
        (start, case.camera, (0.1, 0.3, 1.0)), (found, camera or case.camera, (1.0, 0.9, 0.0)),
    ):  # fmt: skip
        if pose is None:
            continue
        alpha = case.alpha(pose, seen)[..., None]
        highest = F.max_pool2d(alpha.movedim(-1, 0)[None], 3, 1, 1)[0].movedim(0, -1)
        image = torch.where(highest - alpha > RIM, torch.tensor(color), image)
    return image


def _scenes(kind: Kind, degrees: float, shift: float, limits: Limits) -> Callable[[Run, str], Part]:
    """Starts at random, up to `degrees` and a `shift` of the object's size in one easy picture, and that far in others."""

    def run(run: Run, name: str) -> Part:
        part = Part(name, limits)
        for k, case in run.made(kind, 100):
            rng = np.random.default_rng([k, round(degrees)])
            share = (rng.uniform(1 / 3, 1.0), rng.uniform()) if kind == "easy" else (1.0, 1.0)
            start = case.perturbed(case.truth, degrees * share[0], shift * case.size * share[1], rng)
            run.fitted(part, case, start, case.truth, f"{name}-{k:02d}")
        return part

    return run


def _several(count: int, limits: Limits) -> Callable[[Run, str], Part]:
    """So many objects that cover one another, each from a start of its own."""

    def run(run: Run, name: str) -> Part:
        part = Part(name, limits)
        for k in range(run.first, run.first + run.starts):
            meshes = [run.meshes[(k + n) % len(run.meshes)][1] for n in range(count)]
            cases = several(meshes, run.backgrounds, 300 + k)
            rng = np.random.default_rng([k, count])
            starts = [case.perturbed(case.truth, 15.0, 0.05 * case.size, rng) for case in cases]
            run.together(part, cases, starts, f"{name}-{k:02d}")
        return part

    return run


def _cameras(focal: bool, limits: Limits) -> Callable[[Run, str], Part]:
    """Cameras 10° and 5 % of the object's size off the right one, and with `focal` through a lens that is off."""

    def run(run: Run, name: str) -> Part:
        part = Part(name, limits)
        for k, case in run.made("lit", 100):
            rng = np.random.default_rng([k, 10])
            start = case.perturbed(case.truth, 10.0, 0.05 * case.size, rng)
            # The camera that sees the object at rest as the case's camera sees it at the start.
            moved = start.matrix @ torch.linalg.inv(case.truth.matrix)
            W, K = case.camera.world_to_camera.double(), case.camera.K.clone()
            if focal:
                K[[0, 1], [0, 1]] *= FOCAL if k % 2 else 1.0 / FOCAL
            given = case.camera.replace(world_to_camera=(W @ moved).float(), K=K)
            still = case.mesh.transformed(case.truth.R.float(), case.truth.t.float())
            began = Work.now()
            fit = fit_camera(still, case.picture, given, focal=focal, options=FitOptions(seed=0, progress=False))
            work = Work.since(began)
            # As a pose of the object before the case's camera.
            back = torch.linalg.inv(W) @ fit.camera.world_to_camera.double() @ case.truth.matrix
            found, seen = Placed(back[:3, :3], back[:3, 3]), case.camera.replace(K=fit.camera.K)
            run.noted(part, case, start, found, case.truth, fit.search, work)
            run.drawn(f"{name}-{k:02d}", outlined(case, start, found, seen))
            if focal:
                ratio = [float(one.K[0, 0] / case.camera.K[0, 0]) for one in (given, fit.camera)]
                print(f"    focal length {ratio[0] - 1:+.1%} → {ratio[1] - 1:+.1%}", flush=True)
        return part

    return run


def _anywhere(masked: bool) -> Callable[[Run, str], Part]:
    """Lit pictures without a start, with a mask or without."""

    def run(run: Run, name: str) -> Part:
        part = Part(name, Limits(1.0, 0.01, 0.90))
        for k, case in run.made("lit", 200):
            placed, mask = case.mesh.transformed(case.truth.R, case.truth.t), None
            if masked:
                mask = (eg.render_aovs(placed, case.camera, ["alpha"], 16)["alpha"] >= 0.5).float()
            run.fitted(part, case, None, case.truth, f"{name}-{k:02d}", mask)
        return part

    return run


def _around(run: Run, part: Part, case: Case, truth: Placed, turns: tuple[float, float], shift: float) -> Part:
    """Starts at random around a pose: by angles of a range, and by up to a shift, in the mesh's units."""
    ends = []
    for k in range(run.starts):
        rng = np.random.default_rng([7, k])
        start = case.perturbed(truth, rng.uniform(*turns), rng.uniform(0.0, shift), rng)
        fit = run.fitted(part, case, start, truth, f"{part.name.replace(',', '').replace(' ', '-')}-{k:02d}")[1]
        ends.append(Placed(fit.R, fit.t))
    middle = ends[int(np.argmin([statistics.median(case.apart(end, other)[0] for other in ends) for end in ends]))]
    part.spread = max(case.apart(end, middle)[0] for end in ends)
    return part


def _squirrel(run: Run, folder: Path) -> Iterator[Part]:
    case = photo_folder.squirrel(folder)
    first = Part("squirrel, given start", Limits(90.0, 1.0))
    fit = run.fitted(first, case, case.truth, case.truth, "squirrel")[1]
    yield first
    answer = Placed(fit.R, fit.t)
    yield _around(run, Part("squirrel, back", Limits(0.3, 0.5 / case.size, 1.0)), case, answer, (3.0, 15.0), 20.0)


def _gelatin_box(run: Run, folder: Path) -> Iterator[Part]:
    for with_depth in (False, True):
        case = photo_folder.gelatin_box(folder, with_depth)
        part = Part("gelatin box" + " with depth" * with_depth, Limits(1.5, 0.03, 0.95, 0.5))
        yield _around(run, part, case, case.truth, (5.0, 12.0), 0.05 * case.size)


def _cracker_box(run: Run, folder: Path) -> Iterator[Part]:
    case = photo_folder.cracker_box(folder)
    part = Part("cracker box, start", Limits(90.0, 1.0))
    run.fitted(part, case, case.truth, case.truth, "cracker-box")
    yield part


def _bottle(run: Run, folder: Path) -> Iterator[Part]:
    for with_depth in (False, True):
        case = photo_folder.bottle(folder, 200, with_depth)
        limits = Limits(1.0, 0.003 / case.size, 1.0) if with_depth else Limits(2.0, 0.01, 1.0)
        for frame in (200, 201):
            case = photo_folder.bottle(folder, frame, with_depth)
            part = Part(f"bottle {frame}" + " with depth" * with_depth, limits)
            yield _around(run, part, case, case.truth, (5.0, 12.0), 0.05 * case.size)


MADE: dict[str, Callable[[Run, str], Part]] = {
    "easy": _scenes("easy", 15.0, 0.05, Limits(0.5, 0.003, 0.97)),
    "far": _scenes("easy", 30.0, 0.10, Limits(0.5, 0.003, 0.90)),
    "lit": _scenes("lit", 15.0, 0.05, Limits(1.0, 0.01, 0.90)),
    "shadow": _scenes("shadow", 15.0, 0.05, Limits(1.5, 0.03)),
    "covered": _scenes("covered", 15.0, 0.05, Limits(1.5, 0.03, 0.80)),
    "two": _several(2, Limits(2.0, 0.03, 0.80)),
    "three": _several(3, Limits(2.0, 0.03, 0.80)),
    "plain": _scenes("plain", 15.0, 0.05, Limits(2.0, 0.03, 0.80)),
    "camera": _cameras(False, Limits(1.0, 0.01, 0.90)),
    "focal": _cameras(True, Limits(1.5, 0.1, 0.80)),  # its distance goes with the focal length
    "global": _anywhere(False),
    "global-mask": _anywhere(True),
}
REAL: dict[str, Callable[[Run, Path], Iterator[Part]]] = {
    "squirrel": _squirrel, "gelatin_box": _gelatin_box, "cracker_box": _cracker_box, "bottle": _bottle,
}  # fmt: skip


def _mesh(given: str) -> tuple[str, eg.Mesh]:
    """Return the name and mesh of a file, or of FILE,TEXTURE."""
    if given == STONE:
        return STONE, pebble()
    file, _, texture = given.partition(",")
    if texture:
        return Path(file).stem, photo_folder.textured(Path(file), Path(texture))
    return Path(file).stem, eg.load_mesh(file)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, metavar="FOLDER", help="real photographs")
    parser.add_argument("--parts", nargs="+", choices=[*MADE, *REAL], metavar="PART", help=", ".join([*MADE, *REAL]))
    parser.add_argument("--starts", type=int, default=20, metavar="N", help="of each part")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first picture made here")
    parser.add_argument(
        "--meshes", nargs="+", default=[STONE], metavar="FILE",
        help=f"for pictures made here; with a texture FILE,IMAGE; {STONE}: that of the examples",
    )  # fmt: skip
    parser.add_argument("--backgrounds", nargs="+", default=[], metavar="FILE", help="photographs behind them")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="contours over the photographs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every fit")
    given = parser.parse_args()
    parts = given.parts or list(REAL if given.folder else MADE)
    if given.folder is None and (needed := [part for part in parts if part in REAL]):
        parser.error(f"--parts {needed[0]} needs FOLDER")
    backgrounds = [eg.read_image(path, channels=3) for path in given.backgrounds]
    if not backgrounds and given.folder is not None:
        backgrounds = photo_folder.photographs(given.folder)
    backgrounds = backgrounds or [clutter(seed) for seed in range(4)]
    run = Run(given.starts, given.first, given.pictures, [_mesh(one) for one in given.meshes], backgrounds)
    done: list[Part] = []
    for name in parts:
        print(name, flush=True)
        found = [MADE[name](run, name)] if name in MADE else REAL[name](run, given.folder)  # type: ignore[arg-type]
        for part in found:
            done.append(part)
            if given.json is not None:
                given.json.parent.mkdir(parents=True, exist_ok=True)
                given.json.write_text(json.dumps([asdict(one) for one in done], indent=1) + "\n", encoding="utf-8")
    for cells in (TABLE, *(part.cells() for part in done)):
        print("  ".join(f"{cell:{width}s}" for cell, width in zip(cells, WIDTHS, strict=True)).rstrip())


if __name__ == "__main__":
    main()
