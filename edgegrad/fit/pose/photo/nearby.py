"""Other starts around one, and where an object might be near it, if something covers one of its sides.

What covers an object pulls steps away from it, and at low resolution light and colours explain wrong places nearly as well as the
right one. So poses around the start are compared with the picture as match.py has it, each as a whole and with one side after
the other left out: what is left out tells nothing, for a pose or against it, so all of them are ranked together.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from ..pose import Pose, angle
from ..task import SHIFT, TURN, PoseTask
from .cover import EVERYWHERE, SIDES
from .match import RARE, SIZED, Matches, Mips, Round, closer, fitted
from .views import across, ball, seen_at

TURNED = 0.2, 0.4  # radians
SAME = 1e-6  # of scales
STARTS, BALL = 64, 0.4  # rotations, and radians that they are turned by at most
# From the start, at most: radians, shares of the object's size in the picture, and a factor of it.
FARTHEST, ASIDE, LARGER = 0.45, 0.13, 1.12
FIRST = Round(20, 0.0, 0.07, 60, 0.1, 0.05)
ROUNDS = (
    Round(20, 0.12, 0.07, 40, 0.1, 0.05),
    Round(32, 0.1, 0.05, 20, 0.1, 0.05),
    Round(32, 0.06, 0.03, 12, 0.1, 0.05),
    Round(48, 0.04, 0.02, 12, 0.1, 0.05),
)  # fmt: skip


def turns() -> list[tuple[list[int], Tensor]]:
    """Entries of a step and their values, of each other start, turned about an axis of the camera."""
    found = []
    for size in TURNED:
        for axis in range(TURN, SHIFT):
            for sign in (1.0, -1.0):
                found.append(([axis], torch.tensor([sign * size], dtype=torch.float64)))
    return found


def comparable(task: PoseTask, start: Pose) -> bool:
    """Whether nearby() can look: for colours, where no mask tells more, at the size that the mesh has."""
    masked = "alpha" in task.aovs and not task.clutter
    if masked or task.colourless:
        return False
    return task.shots[0].camera.projection == "perspective" and abs(float(start.scale) - 1.0) < SAME


def nearby(task: PoseTask, start: Pose, seed: int) -> list[tuple[Pose, int]]:
    """Poses and the side that is left out at each, as at_one_side() counts them; distinct, the likeliest first."""
    R, position, depth = seen_at(task, start)
    if depth <= 0.0:
        return []
    pixels = across(task, task.shots[0].camera, depth)
    sides = torch.tensor([EVERYWHERE, *range(SIDES)])
    n = len(sides)
    here = Matches(
        R.expand(n, 3, 3), position.expand(n, 2), torch.full((n,), pixels, dtype=torch.float64), torch.zeros(n), sides
    )

    def kept(found: Matches, one: Round) -> Matches:
        turned = torch.tensor([angle(R, other) for other in found.rotations])
        near = turned < FARTHEST
        near &= (found.positions - position).norm(dim=1) < ASIDE * pixels
        near &= (found.pixels / pixels).log().abs() < math.log(LARGER)
        return found.of(near.nonzero()[:, 0]).distinct(one.kept, one.turned, one.placed, SIZED)

    mips = Mips(task, max(one.across for one in ROUNDS))
    found = kept(fitted(task, here.turned(ball(STARTS, BALL)), mips, FIRST, RARE[0], seed), FIRST)
    for one in ROUNDS:
        if not len(found.scores):
            return []
        found = kept(closer(task, found, mips, one, RARE[0], seed), one)
    sides = [] if found.sides is None else found.sides.tolist()
    return [(start._replace(R=pose.R, t=pose.t), side) for pose, side in zip(found.poses(task), sides, strict=True)]
