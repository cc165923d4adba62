"""The search of fit_pose in photographs: Gauss-Newton over their terms, from coarse to fine and from several starts.

Colours are counted anew after each step, inside and around the silhouette as it is then; where the way from the start does not
end at edges of the picture, it begins again from poses that are turned aside. Where the light turns out to leave the mesh's
colours as they are, the search that compares them as they are has the last word, which is more precise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..journal import Journal, Way
from ..pose import Pose, angle
from ..result import Step
from ..search import Search, distinct, norms_of
from ..task import Level, PoseTask
from ..uncertainty import TOGETHER
from .cover import SIDES, WHOLE, at_one_side, covers, left, weighted
from .level import PhotoLevel, photo_levels
from .nearby import comparable, nearby, turns

ENOUGH = 0.65  # share of the render's edges: wrong poses reach 0.57, right ones 0.83 and more
DOUBTFUL = 0.75  # the same, of objects with colours: of twenty poses a wrong one reached 0.73, right ones 0.79 and more
# The same of a contour alone: wrong places in clutter reach 0.81, right ones show 0.87 and more.
ALONE_ENOUGH = 0.85
SURE = 0.85  # the same, where a picture before an even background shows less than enough of the edges of colours as they are
# Of the curvature's diagonal, where colours are still counted beside the object and where it is found, and of its largest entry.
DAMPING, LAST_DAMPING, FLOOR = 0.1, 0.01, 1e-5
LONGEST = 0.1  # of any entry of a step
COARSE_STEPS, FINE_STEPS, LAST_STEPS, USUAL = (
    12,
    8,
    20,
    40,
)  # on a level, of the USUAL `steps`; more of these make it more
FULL_STEPS = 8  # of full length on the last level
GAIN = 0.1  # a step that makes the pictures more likely by a smaller factor than exp(this / 2) is short: noise moves poses as far
FOLLOWED, COVERS_FOLLOWED = 3, 4  # of other starts, the best on the coarsest level
NEARBY_FOLLOWED = 6  # of the poses that the picture shows around the start
HOPELESS = 0.1  # of the edges there: noise shows none at all, clutter 0.3
ROUNDS = 2  # of the last level, each without what covers the object in the light of the round before
APART = 0.05  # radians between poses that are followed both
AS_THEY_ARE = 0.05  # mean change of colours, in parts of them, by light that leaves them as they are
UNCOVERED = 0.85  # of the object's pixels: with fewer, something covers it
COVERED_ENOUGH = 0.7  # of the edges, where a way that leaves out a side of the object ends
NEAR = 0.1  # radians: a polished pose that is farther off is another one
# Of a contour alone: other ends may be the answer if they are within so many radians of the start. One that is less likely by a
# smaller factor than exp(this) looks alike.
REACH, ALIKE = 0.7, 3.0


class _End(NamedTuple):
    """Where a way down ended."""

    explained: float
    pose: Pose
    short: bool  # the last step
    left: float = 1.0  # of the object, by what covers it


class PhotoSearch:
    """The state of a search, as Search has it."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], max_size: int, spp: int, steps: int,
        tolerance: float, seed: int, journal: Journal | None = None, further: bool = True,
    ) -> None:  # fmt: skip
        """`further`: whether other starts follow where the way down from the given one does not end well."""
        self.task, self.start, self.depths = task, start, depths
        self.enough = ALONE_ENOUGH if task.colourless else ENOUGH
        # Before an even background colours are compared as they are first.
        self.colours_first = not task.clutter and "alpha" not in task.aovs and all(depth is None for depth in depths)
        self.levels = photo_levels(task, start, depths, max_size, spp, seed)
        self.max_size, self.spp, self.steps, self.tolerance = max_size, spp, steps, tolerance
        self.seed, self.further = seed, further
        self.best, self.loss, self.converged, self.explained = start, math.nan, False, math.nan
        self.curvature: Tensor | None = None  # JᵀJ of the terms of photographs at the answer, where it is theirs
        self.history: list[Step] = []
        self.journal = journal or Journal()
        self.after_step: Callable[[], Any] = lambda: None
        self.alike: list[Pose] = []  # others, which the pictures hardly tell from the answer
        self._answered = False  # later ways do not show until they win

    @property
    def planned(self) -> int:
        """Steps of the first way at most."""
        return sum(self._most(level) for level in self.levels)

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the pose."""
        if self.colours_first:
            self._colours_first()
        else:
            self._photograph_first()
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _colours_first(self) -> None:
        """The terms of photographs decide where colours do not fit as they are, if they are sure."""
        colours = self._by_colours(self.start, self.task.pyramid(self.start, self.max_size, self.spp), self.further)
        self._adopt(colours)
        if colours.explained >= colours.enough or not self.further:
            return
        begins = len(self.history)
        best = self._photograph()
        lost = slice(0, begins) if best.explained >= SURE else slice(begins, None)
        self._forget(lost)
        if best.explained >= SURE:
            self._take(best)

    def _photograph_first(self) -> None:
        """Colours as they are have the last word where the light leaves them so, and in a mask where its terms find nothing."""
        task, best = self.task, self._photograph()
        if best.explained >= self.enough and not task.colourless and self._as_they_are(best.pose):
            colours = self._by_colours(best.pose, task.pyramid(best.pose, self.max_size, self.spp)[-2:], False)
            better = colours.converged and angle(colours.best.R, best.pose.R) < NEAR
        elif best.explained < self.enough and not task.clutter and self.further:
            colours = self._by_colours(self.start, task.pyramid(self.start, self.max_size, self.spp), True)
            better = colours.converged
        else:
            return
        if better:
            self._adopt(colours)
        else:
            self._forget(slice(len(self.history) - len(colours.history) + 1, None))

    def _photograph(self) -> _End:
        """The best end by the terms of photographs."""
        begins = len(self.history)
        found = self._judge(*self._down(self.start, self.levels))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view?"
            )
        stays = found.short and len(distinct([found.pose, self.start], 2, APART)) == 1
        start = self._judge(self.start, stays)
        best = max(found, start, key=lambda end: end.explained)
        if not self.colours_first:
            self._take(best)
        if self.further and best.explained < self.enough:
            best = self._from_covers(best, begins)
        if self.further and best.explained < max(self.enough, DOUBTFUL) and comparable(self.task, self.start):
            best = self._from_nearby(best, begins)
        if self.further and best.explained < self.enough:
            best = self._from_aside(best, begins)
        if best.explained < self.enough:
            return best
        if best is not start:
            best = self._surrounded(best)
            if self.further and best.explained < SURE and best.left < UNCOVERED:
                again = self._from_covers(best, begins)
                best = best if again is best else self._surrounded(again)
        if self.further and self.task.colourless and all(depth is None for depth in self.depths):
            best = self._of_alike(best, begins)
        return best

    def first_end(self) -> float:
        """The share of the render's edges that the pictures show where the way down from the start alone ends."""
        return self._judge(*self._down(self.start, self.levels)).explained

    def _from_aside(self, best: _End, begins: int) -> _End:
        """Ways from other starts, until one ends where the pictures show the render's edges. Those of this search begin in the
        history at `begins`."""
        coarse, *finer = self.levels
        answered = self._answered
        self._answered = True
        ends = [self._follow(coarse, self.task.moved(self.start, *turn))[0] for turn in turns()]
        scores = self.journal.numbers(lambda: [coarse.explained(pose, self.seed) for pose in ends])
        order = sorted((k for k in range(len(ends)) if scores[k] >= HOPELESS), key=lambda k: -scores[k])
        for pose in distinct([ends[k] for k in order], FOLLOWED, APART):
            before = len(self.history)
            best = self._better(best, self._judge(*self._down(pose, finer)), slice(begins, before), answered)
            if best.explained >= self.enough:
                break
        return best

    def _of_alike(self, best: _End, begins: int) -> _End:
        """Of poses whose contours look alike, the one that makes the pictures most likely. Seen from afar, an object and what it
        is behind a mirror have one contour, so an object that is its own mirror image has it in two poses."""
        coarse, *finer = self.levels
        turned = [self.task.moved(self.start, *turn) for turn in turns()]
        before = len(self.history)
        self._answered = True
        here, *ends = (self._follow(coarse, pose)[0] for pose in [best.pose, *turned])
        costs = self.journal.numbers(lambda: [coarse.unlikely(pose, self.seed) for pose in ends])
        ends = [ends[k] for k in sorted(range(len(ends)), key=costs.__getitem__)]
        found = [best]
        for pose in distinct([here, *ends], 1 + FOLLOWED, APART)[1:]:
            end = self._judge(*self._down(pose, finer))
            if end.explained >= self.enough and angle(end.pose.R, self.start.R) < REACH:
                found.append(end)
        costs = self.journal.numbers(lambda: [self.levels[-1].unlikely(end.pose, self.seed) for end in found])
        sure = ALIKE * TOGETHER**2
        least = min(costs)
        # One that is hardly likelier is no better an answer, but answers would then depend on the start.
        won = costs[0] - least > sure
        answer = found[costs.index(least)] if won else best
        self.alike = [
            end.pose for end, cost in zip(found, costs, strict=True) if end is not answer and cost - least < sure
        ]
        if not won:
            self._forget(slice(before, None))
            return best
        self._forget(slice(begins, len(self.history)))
        self._take(answer)
        return self._surrounded(answer)

    def _better(self, best: _End, found: _End, earlier: slice, answered: bool) -> _End:
        """The one that explains more of the edges. Of the other one the history keeps no steps; those `earlier` than the steps to
        the found one led to the best."""
        if found.explained <= best.explained:
            self._forget(slice(earlier.stop, None))
            return best
        self._forget(earlier)
        if answered:
            self._take(found)
        return found

    def _from_covers(self, best: _End, begins: int) -> _End:
        """Ways that leave out what may cover the object at one side, until the pictures show an end's edges for sure."""
        answered = self._answered
        self._answered = True
        coarse = self.levels[0]
        first = coarse.see(self.start, self.seed)
        ways = [[at_one_side(seen.alpha, side) for seen in first] for side in range(SIDES)]
        ends = [self._follow(weighted(coarse, weights), self.start)[0] for weights in ways]
        scores = self.journal.numbers(
            lambda: [
                weighted(coarse, weights).explained(pose, self.seed) for pose, weights in zip(ends, ways, strict=True)
            ]
        )
        hopeful = [k for k in range(SIDES) if scores[k] >= HOPELESS]
        order = sorted(hopeful, key=lambda k: -scores[k])[:COVERS_FOLLOWED]
        return self._of_covered(best, ((ends[k], ways[k]) for k in order), begins, answered)

    def _from_nearby(self, best: _End, begins: int) -> _End:
        """Ways from poses around the start that the picture shows, as a whole or at all sides but one."""
        answered = self._answered
        self._answered = True
        coarse, first, *_ = self.levels
        size = len(self.start.numbers)

        def hopeful(pose: Pose) -> bool:
            return coarse.explained(pose, self.seed) >= HOPELESS

        def compared() -> list[float]:
            if not (hopeful(self.start) or hopeful(best.pose)):
                return []
            found = nearby(self.task, self.start, self.seed)[:NEARBY_FOLLOWED]
            return [number for pose, side in found if hopeful(pose) for number in (*pose.numbers, float(side))]

        def starts() -> Iterator[tuple[Pose, list[Tensor]]]:
            flat = self.journal.numbers(compared)
            for at in range(0, len(flat), size + 1):
                pose, side = Pose.of(flat[at : at + size]), int(flat[at + size])
                yield pose, [at_one_side(seen.alpha, side) for seen in first.see(pose, self.seed)]

        return self._of_covered(best, starts(), begins, answered)

    def _of_covered(
        self, best: _End, starts: Iterable[tuple[Pose, list[Tensor]]], begins: int, answered: bool
    ) -> _End:  # fmt: skip
        """The best of the ways down from poses, with weights (h, w) of the pictures at first, until one is sure."""
        for pose, weights in starts:
            before = len(self.history)
            found = self._uncovered(pose, weights, self.levels[1:])
            # Of so many ways, one may end where something is alike by chance.
            if found.explained < COVERED_ENOUGH:
                self._forget(slice(before, None))
                continue
            best = self._better(best, found, slice(begins, before), answered)
            if best.explained >= SURE:
                break
        return best

    def _uncovered(self, pose: Pose, weights: list[Tensor], levels: list[PhotoLevel]) -> _End:
        """Down from a pose, with `weights` (h, w) of each picture until the light tells what covers the object."""
        short, last = False, levels[-1]
        for level in levels:
            if level.last:
                weights = covers(weighted(level, weights).see(pose, self.seed)) or weights
            pose, short = self._follow(last := weighted(level, weights), pose)
        weights = covers(last.see(pose, self.seed)) or weights
        share, kept = self.journal.numbers(
            lambda: [
                weighted(levels[-1], weights).explained(pose, self.seed),
                left(levels[-1].see(pose, self.seed), weights),
            ]
        )
        return _End(share * min(1.0, kept / WHOLE), pose, short, kept)

    def _surrounded(self, best: _End) -> _End:
        """The end, once more with what surrounds the object where it is now, and without what covers it: it does not depend
        on the start any more."""
        last = photo_levels(self.task, best.pose, self.depths, self.max_size, self.spp, self.seed)[-1]
        before = len(self.history)
        found = self._uncovered(best.pose, [torch.ones(picture.size) for picture in last.pictures], [last] * ROUNDS)
        if found.explained < self.enough:
            self._forget(slice(before, None))
            return best
        self.levels = [*self.levels[:-1], last]
        if not self.colours_first:
            self._take(found)
        return found

    def _down(self, pose: Pose, levels: list[PhotoLevel]) -> tuple[Pose, bool]:
        """Through the levels; the pose, and whether the last step was short."""
        short = False
        for level in levels:
            pose, short = self._follow(level, pose)
        return pose, short

    def _follow(self, level: PhotoLevel, origin: Pose) -> tuple[Pose, bool]:
        """Steps on one level; the pose, and whether the last step was short."""
        way = self.journal.entered() or Way(origin, origin, math.inf, search={})
        for step in way.steps:
            self._note(step)
        while not way.done:
            # The same samples at each step, so that steps come to rest.
            normal, loss = level.equations(way.pose, self.seed)
            move = normal.damped(LAST_DAMPING if level.last else DAMPING, FLOOR, LONGEST)
            if move is None:
                self.journal.keep(way := way._replace(done=True))
                break
            if level.last and len(way.steps) > FULL_STEPS:
                move = 0.5 * move  # weights that are solved anew at each step make full ones go to and fro
            far = float(move.abs().max()) >= self.tolerance * level.plain.coarseness
            short = not far or float(move @ normal.curvature @ move) < GAIN
            step = Step(level.size, loss, way.pose, True, norms_of(level.plain.free, normal.gradient))
            steps = (*way.steps, step)
            way = way._replace(
                pose=self.task.moved(way.pose, level.plain.free, move), here=way.pose, lowest=loss, short=short,
                done=short or len(steps) >= self._most(level), steps=steps,
            )  # fmt: skip
            self.journal.keep(way)
            self._note(step)
            self.after_step()
        return way.pose, way.short

    def _most(self, level: PhotoLevel) -> int:
        return most_steps(self.steps, level.last, level.plain.coarseness == self.levels[0].plain.coarseness)

    def _note(self, step: Step) -> None:
        if not self._answered:
            self.best, self.loss = step.pose, step.loss
        self.history.append(step)

    def _forget(self, lost: slice) -> None:
        self.history[lost] = [step._replace(best=False) for step in self.history[lost]]

    def _judge(self, pose: Pose, short: bool) -> _End:
        (share,) = self.journal.numbers(lambda: [self.levels[-1].explained(pose, self.seed)])
        return _End(share, pose, short)

    def _take(self, end: _End) -> None:
        self.loss, *curvature = self.journal.numbers(lambda: self._at(end.pose))
        self.curvature = torch.tensor(curvature, dtype=torch.float64).reshape((len(self.task.free),) * 2)
        self.explained, self.best, self._answered = end.explained, end.pose, True
        self.converged = end.short and end.explained >= self.enough

    def _at(self, pose: Pose) -> list[float]:
        """The loss, and the curvature by rows."""
        normal, loss = self.levels[-1].equations(pose, self.seed)
        return [loss, *normal.curvature.flatten().tolist()]

    def _as_they_are(self, pose: Pose) -> bool:
        """Whether the light leaves the mesh's colours as they are."""
        (most,) = self.journal.numbers(lambda: [self._change(pose)])
        return most < AS_THEY_ARE

    def _change(self, pose: Pose) -> float:
        """How far colours in the light are from those of the mesh, in parts of these, of all pictures the farthest."""
        seen = self.levels[-1].see(pose, self.seed)
        return max(math.inf if one.lit is None else one.lit.change(self.task.white) for one in seen)

    def _by_colours(self, start: Pose, levels: list[Level], further: bool) -> Search:
        """The search that compares colours as they are, from a start; its steps follow in the history."""
        search = Search(self.task, levels, start, self.steps, self.tolerance, self.seed, self.journal, further)
        before = list(self.history)

        def after_step() -> None:
            self.history = [*before, *search.history]
            if not before:
                self.best, self.loss, self.explained = search.best, search.loss, search.explained
            self.after_step()

        search.after_step = after_step
        search.run()
        self.history = [*before, *search.history[:-1]]  # the last is no step, but the final comparison
        return search

    def _adopt(self, search: Search) -> None:
        self.best, self.loss, self._answered = search.best, search.loss, True
        self.explained, self.converged, self.curvature = search.explained, search.converged, None


def most_steps(steps: int, last: bool, coarsest: bool) -> int:
    """On a level, of what the user allows. Few lead from one level to the next, and where they do not come to rest, more do not
    help either, unless somebody asks for them."""
    usual = LAST_STEPS if last else COARSE_STEPS if coarsest else FINE_STEPS
    return min(steps, round(usual * max(1.0, steps / USUAL)))
