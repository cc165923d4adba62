"""Find where a camera stands by masks of a robot whose joint angles are known: hand–eye calibration without a board.

    python examples/robot.py [ARM.urdf] [--postures 8] [--size 256] [--seed 0] [--out robot.png]

Without a file it writes a seven-joint arm. One camera at rest sees the arm in some postures. Its pose is found by
Gauss-Newton from where it was thought to be: derivatives of the masks by the pose, in forward mode.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path

import arm
import roma
import torch
from torch import Tensor

import edgegrad as eg

SIZE = 256
STEPS = 10  # at each size
TURN, SHIFT = 3.0, 0.05  # degrees and metres: how far the first guess is off
EYE, TARGET = (0.9, -1.3, 1.0), (0.0, 0.0, 0.55)
F64 = torch.float64


def camera(size: int) -> eg.Camera:
    found = eg.Camera.look_at(EYE, TARGET, up=(0, 0, 1), fov_y=50, size=(size, size))
    return found.replace(world_to_camera=found.world_to_camera.double(), K=found.K.double())


def postures(robot: eg.rig.Rig, count: int, seed: int) -> Tensor:
    """Return angles (count, m), well within the limits."""
    control, generator = robot.controls["angles"], torch.Generator().manual_seed(seed)
    share = torch.rand(count, len(control.rest), generator=generator, dtype=F64)
    low, high = control.low.clamp(min=-2.0), control.high.clamp(max=2.0)
    return 0.5 * (low + high) + 0.6 * (share - 0.5) * (high - low)


def masks(scenes: list[eg.Scene], seen_by: eg.Camera, spp: int, seed: int) -> list[Tensor]:
    with torch.no_grad():
        return [
            eg.render_aovs(scene, seen_by, ["alpha"], spp=spp, seed=seed + k)["alpha"] for k, scene in enumerate(scenes)
        ]


def moved(start: eg.Camera, twist: Tensor) -> eg.Camera:
    """Return the camera rotated and shifted in its own coordinates, by radians and metres."""
    motion = torch.eye(4, dtype=F64)
    motion[:3, :3], motion[:3, 3] = roma.rotvec_to_rotmat(twist[:3]), twist[3:]
    return start.replace(world_to_camera=motion @ start.world_to_camera)


def errors(found: eg.Camera, truth: eg.Camera) -> tuple[float, float]:
    """Return millimetres between the eyes, and degrees."""
    A, B = found.world_to_camera, truth.world_to_camera
    eyes = [-(W[:3, :3].T @ W[:3, 3]) for W in (A, B)]
    return 1000.0 * float((eyes[0] - eyes[1]).norm()), math.degrees(
        float(roma.rotmat_geodesic_distance(A[:3, :3], B[:3, :3]))
    )


def fit(
    scenes: list[eg.Scene], targets: list[Tensor], start: eg.Camera, steps: int = STEPS, spp: int = 16
) -> eg.Camera:
    """Solve (JᵀJ + λ diag JᵀJ) δ = −Jᵀr (Levenberg and Marquardt), from masks at a quarter of the size, a half and the
    whole."""
    best = start
    for level, factor in enumerate((0.25, 0.5, 1.0)):
        size = max(16, round(start.size[0] * factor)), max(16, round(start.size[1] * factor))
        wanted = [torch.nn.functional.adaptive_avg_pool2d(t.movedim(-1, 0), size).movedim(0, -1) for t in targets]
        damping, least, at, places = 1e-2, math.inf, best, []
        equations = torch.eye(6, dtype=F64), torch.zeros(6, dtype=F64)
        for step in range(steps):
            loss, JTJ, JTr = normal_equations(scenes, wanted, at.resized(size), spp, 1000 * level + 10 * step)
            if loss <= 1.1 * least:  # but for the noise of samples
                best, least, damping = at, min(loss, least), max(damping / 4.0, 1e-4)
                equations = JTJ, JTr
            else:
                damping *= 8.0
            at = moved(best, step_of(*equations, damping))
            places.append(at.world_to_camera)
    # The last steps go to and fro about the minimum by the noise of their samples.
    mean = torch.stack(places[-steps // 2 :]).mean(0)
    mean[:3, :3] = roma.special_procrustes(mean[:3, :3])
    return best.replace(world_to_camera=mean)


def step_of(JTJ: Tensor, JTr: Tensor, damping: float) -> Tensor:
    return -torch.linalg.solve(JTJ + damping * torch.diag(JTJ.diagonal()), JTr)


def normal_equations(
    scenes: list[eg.Scene], targets: list[Tensor], seen_by: eg.Camera, spp: int, seed: int
) -> tuple[float, Tensor, Tensor]:
    """Return Σ r², JᵀJ and Jᵀr of the masks by a rotation and a shift of the camera, about its eye and in its axes."""
    pose = seen_by.world_to_camera
    tangents = torch.zeros(6, 4, 4, dtype=F64)  # of exp(δ) W by δ at 0
    for k, (i, j) in enumerate(((2, 1), (0, 2), (1, 0))):
        tangents[k, i, j], tangents[k, j, i] = 1.0, -1.0
        tangents[3 + k, k, 3] = 1.0
    tangents = tangents @ pose
    loss, JTJ, JTr = 0.0, torch.zeros(6, 6, dtype=F64), torch.zeros(6, dtype=F64)
    for k, (scene, target) in enumerate(zip(scenes, targets, strict=True)):
        alpha, J = eg.jvp(scene, seen_by, {pose: tangents}, spp, seed + k, aovs=["alpha"])
        r, rows = (alpha["alpha"] - target).flatten().double(), J["alpha"].reshape(6, -1).double()
        loss, JTJ, JTr = loss + float(r.square().sum()), JTJ + rows @ rows.T, JTr + rows @ r
    return loss, JTJ, JTr


def trial(
    robot: eg.rig.Rig, count: int, size: int, seed: int
) -> tuple[eg.Camera, eg.Camera, eg.Camera, list[eg.Scene], list[Tensor]]:
    """Return truth, start and fit, the scenes and their masks."""
    truth = camera(size)
    scenes = robot.posed(angles=postures(robot, count, seed))
    targets = masks(scenes, truth, 64, 5000)
    generator = torch.Generator().manual_seed(seed + 1)
    axis, shift = (torch.randn(3, generator=generator, dtype=F64) for _ in range(2))
    start = moved(truth, torch.cat([math.radians(TURN) * axis / axis.norm(), SHIFT * shift / shift.norm()]))
    return truth, start, fit(scenes, targets, start), scenes, targets


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("urdf", nargs="?", type=Path)
    parser.add_argument("--postures", type=int, default=8)
    parser.add_argument("--size", type=int, default=SIZE, help="pixels")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", default="robot.png")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        robot = eg.rig.load(args.urdf or arm.write(Path(folder) / "arm.urdf"))
    began = time.perf_counter()
    truth, start, found, scenes, targets = trial(robot, args.postures, args.size, args.seed)
    for name, one in (("start", start), ("fit", found)):
        millimetres, degrees = errors(one, truth)
        print(f"{name}: {millimetres:.2f} mm, {degrees:.3f}° off")
    print(f"{time.perf_counter() - began:.0f} s")
    rows = [torch.cat([masks(scenes[:1], one, 64, 7)[0] for one in (start, found)] + [targets[0]], 1)]
    eg.write_image(args.out, torch.cat(rows).expand(-1, -1, 3).contiguous())


if __name__ == "__main__":
    main()
