"""The search of fit_pose in photographs: Gauss-Newton over their terms, from coarse to fine and from several starts.

Colours are counted anew after each step, inside and around the silhouette as it is then; where the way from the start does not
end at edges of the picture, it begins again from poses that are turned aside. Where the light turns out to leave the mesh's
colours as they are, the search that compares them as they are has the last word, which is more precise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from ..journal import Journal
from ..pose import Pose, angle
from ..result import Step
from ..search import Search, distinct
from ..task import Level, PoseTask
from ..uncertainty import TOGETHER, Uncertainty
from .cover import SIDES, at_one_side, covers, left, weighted
from .level import PhotoLevel, photo_levels
from .nearby import comparable, nearby, turns
from .ways import End, Ways

DOUBTFUL = 0.75  # share of the edges, of objects with colours: of twenty poses a wrong one reached 0.73, right ones 0.79 and more
SURE = 0.85  # the same, where a picture before an even background shows less than enough of the edges of colours as they are
FOLLOWED, COVERS_FOLLOWED = 3, 4  # of other starts, the best on the coarsest level
NEARBY_FOLLOWED = 6  # of the poses that the picture shows around the start
HOPELESS = 0.1  # of the edges there: noise shows none at all, clutter 0.3
ROUNDS = 2  # of the last level, each without what covers the object in the light of the round before
APART = 0.05  # radians between poses that are followed both
AS_THEY_ARE = 0.05  # mean change of colours, in parts of them, by light that leaves them as they are
UNCOVERED = 0.85  # of the object's pixels: with fewer, something covers it
COVERED_ENOUGH = 0.7  # of the edges, where a way that leaves out a side of the object ends
SAME = 0.01  # radians, and object sizes, between a way and the place where another one came to rest: it will, too
NEAR = 0.1  # radians: a polished pose that is farther off is another one
# Other ends may be the answer if they are within so many radians of the start. One that is less likely by a smaller factor than
# exp(this) looks alike.
REACH, ALIKE = 0.7, 3.0
# The same of contours alone, where the other one has come to rest: ends that were wrong were up to exp(19) times less likely than
# the right pose, which no way had come to, and exp(5) times likelier than the next; beside right ones, others were exp(10) less.
ALONE_ALIKE = 8.0
SHARP = 1.0  # degrees: of objects with colours whose rotation is known less exactly than this, others that look alike are sought


class PhotoSearch(Ways):
    """The state of a search, as Search has it."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], max_size: int, spp: int, steps: int,
        tolerance: float, seed: int, journal: Journal | None = None, further: bool = True,
    ) -> None:  # fmt: skip
        """`further`: whether other starts follow where the way down from the given one does not end well."""
        super().__init__(task, start, depths, max_size, spp, steps, tolerance, seed, journal)
        # Before an even background colours are compared as they are first.
        self.colours_first = not task.clutter and "alpha" not in task.aovs and all(depth is None for depth in depths)
        self.further = further
        self._judged_poses: list[Pose] = []  # where the first descent began and ended
        self.alike: list[Pose] = []  # others, which the pictures hardly tell from the answer

    def run(self) -> None:
        """Raises ValueError when nothing in the pictures depends on the pose."""
        if self.colours_first:
            self._colours_first()
        else:
            self._photograph_first()
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _colours_first(self) -> None:
        """The terms of photographs decide where colours do not fit as they are."""
        colours = self._by_colours(self.start, self.task.pyramid(self.start, self.max_size, self.spp), self.further)
        self._adopt(colours)
        if colours.explained >= colours.enough or not self.further:
            return
        begins = len(self.history)
        best = self._photograph()
        won = best.explained >= self.enough
        self._forget(slice(0, begins) if won else slice(begins, None))
        if won:
            # To have converged: the terms of photographs explain much that is no photograph.
            self.enough = SURE
            self._take(best)
        else:
            self.alike = []

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

    def _photograph(self) -> End:
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
        self._judged_poses = [found.pose, start.pose]
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
        alone = self.further and all(depth is None for depth in self.depths)
        if alone and (self.task.colourless or self._vague(best.pose)):
            best = self._of_alike(best, begins)
        return best

    def _from_aside(self, best: End, begins: int) -> End:
        """Ways from other starts, until one ends where the pictures show the render's edges. Those of this search begin in the
        history at `begins`."""
        first, *finer = self._of_turned()
        answered = self._answered
        self._answered = True
        ends = [self._follow(first, self.task.moved(self.start, *turn))[0] for turn in turns()]
        scores = self.journal.numbers(lambda: [first.explained(pose, self.seed) for pose in ends])
        order = sorted((k for k in range(len(ends)) if scores[k] >= HOPELESS), key=lambda k: -scores[k])
        for pose in distinct([ends[k] for k in order], FOLLOWED, APART):
            before = len(self.history)
            best = self._better(best, self._judge(*self._down(pose, finer)), slice(begins, before), answered)
            if best.explained >= self.enough:
                break
        return best

    def _of_turned(self) -> list[PhotoLevel]:
        """The levels that ways from poses turned aside go through. Those of an object with colours begin on the coarsest one,
        which tells the light. Of a contour it shows so little that ways which begin apart end in one place there."""
        return self.levels[1:] if self.task.colourless else self.levels

    def likeliest(self, pose: Pose, short: bool) -> tuple[End | None, list[Pose]]:
        """Of poses that look like one that was found otherwise, whose last step was `short` or not, the one that makes the
        pictures likelier, if there is one, and the others that these hardly tell from the answer."""
        last = photo_levels(self.task, pose, self.depths, self.max_size, self.spp, self.seed)[-1]
        views = last.see(pose, self.seed)
        last, weights = last.focused(views), covers(views)
        self.levels = [*self.levels[:-1], last]
        kept = 1.0 if weights is None else left(views, weights)
        here = self._judge(pose, short, last if weights is None else weighted(last, weights))._replace(left=kept)
        answer = self._of_alike(here, 0)
        return None if answer is here else answer, self.alike

    def _of_alike(self, best: End, begins: int) -> End:
        """Of poses that look alike, the one that makes the pictures most likely. An object that is its own mirror image has, from
        afar, the contour that it has behind a mirror, and so one contour in two poses; a bottle that shows hardly more than its
        bottom, a disc of one colour, looks alike in many."""
        plain = self.task.colourless
        first, *finer = self._of_turned()
        turned = [self.task.moved(self.start if plain else best.pose, *turn) for turn in turns()]
        before = len(self.history)
        self._answered = True
        here, *ends = (self._follow(first, pose)[0] for pose in [best.pose, *turned])
        costs = self.journal.numbers(lambda: first.unlikely([here, *ends], self.seed))
        sure, doubt = ALIKE * TOGETHER**2, (ALONE_ALIKE if plain else ALIKE) * TOGETHER**2
        order = sorted(range(len(ends)), key=lambda k: costs[1 + k])
        if not plain:  # where colours tell the others from this one in so few pixels, they do in more
            order = [k for k in order if costs[1 + k] - costs[0] < sure]
        found = [best]
        level = self._left_of(best)
        for pose in distinct([here, *(ends[k] for k in order)], 1 + FOLLOWED, APART)[1:]:
            if (way := self._apart(pose, finer, best.pose)) is None:
                continue
            end = self._judge(*way, level)
            if end.explained >= min(self.enough, DOUBTFUL) and angle(end.pose.R, self.start.R) < REACH:
                found.append(end)
        costs = self.journal.numbers(lambda: level.unlikely([end.pose for end in found], self.seed))
        k = min((k for k, end in enumerate(found) if end.explained >= self.enough), key=costs.__getitem__, default=0)
        # One that is hardly likelier is no better an answer, but answers would then depend on the start.
        won = costs[0] - costs[k] > sure and (plain or found[k].explained > best.explained)
        answer, cost = (found[k], costs[k]) if won else (best, costs[0])
        self.alike = [
            end.pose for end, other in zip(found, costs, strict=True) if end is not answer and other - cost < doubt
        ]
        if not won:
            self._forget(slice(before, None))
            return best
        self._forget(slice(begins, len(self.history)))
        if not self.colours_first:
            self._take(answer)
        return self._surrounded(answer)

    def _apart(self, pose: Pose, levels: list[PhotoLevel], other: Pose) -> tuple[Pose, bool] | None:
        """As _down(), but None as soon as the way comes to the other pose."""

        def there(pose: Pose) -> bool:
            return angle(pose.R, other.R) < SAME and self.task.between(pose, other) < SAME

        short = False
        for level in levels:
            pose, short = self._follow(level, pose, there)
            if there(pose) or (not self.task.colourless and angle(pose.R, other.R) < APART):
                return None
        return pose, short

    def _left_of(self, end: End) -> PhotoLevel:
        """The last level, without what covers the object at an end, if something does."""
        last = self.levels[-1]
        weights = covers(last.see(end.pose, self.seed)) if end.left < UNCOVERED else None
        return last if weights is None else weighted(last, weights)

    def _vague(self, pose: Pose) -> bool:
        """Whether the pictures show the pose's rotation so little that others may look alike."""
        (degrees,) = self.journal.numbers(lambda: [self._degrees(pose)])
        return degrees > SHARP

    def _degrees(self, pose: Pose) -> float:
        curvature = self.levels[-1].equations(pose, self.seed)[0].curvature
        return Uncertainty.of(self.task, pose, curvature, self.task.free, None).degrees

    def _better(self, best: End, found: End, earlier: slice, answered: bool) -> End:
        """The one that explains more of the edges. Of the other one the history keeps no steps; those `earlier` than the steps to
        the found one led to the best."""
        if found.explained <= best.explained:
            self._forget(slice(earlier.stop, None))
            return best
        self._forget(earlier)
        if answered:
            self._take(found)
        return found

    def _from_covers(self, best: End, begins: int) -> End:
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

    def _from_nearby(self, best: End, begins: int) -> End:
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
                pose, side = Pose.from_numbers(flat[at : at + size]), int(flat[at + size])
                yield pose, [at_one_side(seen.alpha, side) for seen in first.see(pose, self.seed)]

        return self._of_covered(best, starts(), begins, answered)

    def _of_covered(
        self, best: End, starts: Iterable[tuple[Pose, list[Tensor]]], begins: int, answered: bool
    ) -> End:  # fmt: skip
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

    def _surrounded(self, best: End) -> End:
        """The end, once more with what surrounds the object where it is now, and without what covers it: it does not depend
        on the start any more."""
        *_, coarser, last = photo_levels(self.task, best.pose, self.depths, self.max_size, self.spp, self.seed)
        last = last.focused(last.see(best.pose, self.seed))
        before = len(self.history)
        weights = covers(last.see(best.pose, self.seed)) or [torch.ones(picture.size) for picture in last.pictures]
        # On the last level steps are small, and may come to rest on the way; from nearer, those of the one before, which compares
        # colours inside, lead on.
        levels = [last] * ROUNDS if self.task.colourless else [coarser, *[last] * ROUNDS]
        found = self._uncovered(best.pose, weights, levels)
        if found.explained < self.enough:
            self._forget(slice(before, None))
            return best
        self.levels = [*self.levels[:-1], last]
        if not self.colours_first:
            self._take(found)
        return found

    def _as_they_are(self, pose: Pose) -> bool:
        """Return whether the light leaves the mesh's colours as they are.

        That is so of the pictures, not of a pose. At a wrong pose a light is found that makes up for a part of the error, so the
        least change counts: at this pose, and where the first descent began and ended."""
        poses = [pose, *self._judged_poses]
        (least,) = self.journal.numbers(lambda: [min(self._change(one) for one in poses)])
        return least < AS_THEY_ARE

    def _change(self, pose: Pose) -> float:
        """How far colours in the light are from those of the mesh, in parts of these, of all pictures the farthest."""
        seen = self.levels[-1].see(pose, self.seed)
        return max(math.inf if one.lit is None else one.lit.change() for one in seen)

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
        self.explained, self.converged, self.curvature = search.explained, search.converged, search.curvature
