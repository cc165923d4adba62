"""Other starts around one, and poses near it that the picture shows although something covers one side of the object.

An occluder pulls steps away from the object, and at low resolution light and colours match wrong places nearly as well as the
right one. So poses around the start are compared with the picture by match.py, each as a whole and with one side after the
other left out. What is left out counts neither for nor against a pose, so all of them are ranked together.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..pose import Pose, angle
from ..task import ROTATION, TRANSLATION, PoseTask
from .match import RARE_COLOR_WEIGHTS, SIZE_SPACING, Matches, Mips, Round, closer, fitted
from .occluders import EVERYWHERE, OCCLUDER_SIDES
from .template_views import across, ball, seen_at

TURN_ANGLES = 0.2, 0.4  # radians
SCALE_TOLERANCE = 1e-6
NEARBY_ROTATIONS, NEARBY_RADIUS = 64, 0.4  # number of rotations, and their largest angle in radians
# Largest distances from the start: radians, shares of the object's size in the picture, and a factor of it.
MAX_TURN, MAX_OFFSET, MAX_ENLARGEMENT = 0.45, 0.13, 1.12
NEARBY_COARSE_ROUND = Round(20, 0.0, 0.07, 60, 0.1, 0.05)
NEARBY_ROUNDS = (
    Round(20, 0.12, 0.07, 40, 0.1, 0.05),
    Round(32, 0.1, 0.05, 20, 0.1, 0.05),
    Round(32, 0.06, 0.03, 12, 0.1, 0.05),
    Round(48, 0.04, 0.02, 12, 0.1, 0.05),
)  # fmt: skip


def turns() -> list[tuple[list[int], Tensor]]:
    """Return the entries of a step and their values for each other start, rotated about an axis of the camera."""
    found = []
    for size in TURN_ANGLES:
        for axis in range(ROTATION, TRANSLATION):
            for sign in (1.0, -1.0):
                found.append(([axis], torch.tensor([sign * size], dtype=torch.float64)))
    return found


def comparable(task: PoseTask, start: Pose) -> bool:
    """Return whether nearby() applies: with colours, without a mask, at the mesh's own size, and in perspective."""
    masked = "alpha" in task.aovs and not task.clutter
    if masked or task.colorless:
        return False
    return task.shots[0].camera.projection == "perspective" and abs(float(start.scale) - 1.0) < SCALE_TOLERANCE


def nearby(task: PoseTask, start: Pose, seed: int) -> list[tuple[Pose, int]]:
    """Return distinct poses, the likeliest first, with the side that each leaves out, see at_one_side()."""
    R, position, depth = seen_at(task, start)
    if depth <= 0.0:
        return []
    pixels = across(task, task.shots[0].camera, depth)
    sides = torch.tensor([EVERYWHERE, *range(OCCLUDER_SIDES)])
    n = len(sides)
    pixels_of, scores = torch.full((n,), pixels, dtype=torch.float64), torch.zeros(n, dtype=torch.float32)
    here = Matches(R.expand(n, 3, 3), position.expand(n, 2), pixels_of, scores, sides)

    def kept(found: Matches, one: Round) -> Matches:
        turned = torch.tensor([angle(R, other) for other in found.rotations], dtype=torch.float32)
        near = turned < MAX_TURN
        near &= (found.positions - position).norm(dim=1) < MAX_OFFSET * pixels
        near &= (found.pixels / pixels).log().abs() < math.log(MAX_ENLARGEMENT)
        return found.select(near.nonzero()[:, 0]).distinct(one.kept, one.turned, one.spacing, SIZE_SPACING)

    mips = Mips(task, max(one.across for one in NEARBY_ROUNDS))
    first = here.turned(ball(NEARBY_ROTATIONS, NEARBY_RADIUS))
    found = fitted(task, first, mips, NEARBY_COARSE_ROUND, RARE_COLOR_WEIGHTS[0], seed)
    found = kept(found, NEARBY_COARSE_ROUND)
    for one in NEARBY_ROUNDS:
        if not len(found.scores):
            return []
        found = kept(closer(task, found, mips, one, RARE_COLOR_WEIGHTS[0], seed), one)
    sides = [] if found.sides is None else found.sides.tolist()
    return [(start._replace(R=pose.R, t=pose.t), side) for pose, side in zip(found.poses(task), sides, strict=True)]
