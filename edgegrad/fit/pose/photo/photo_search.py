"""The search of fit_pose in photographs: Gauss-Newton over their terms, from coarse to fine and from several starts.

Where the start does not lead to edges of the picture, the search restarts from poses rotated aside. Where the light leaves the
mesh's colours unchanged, ColorSearch has the last word, which is more precise.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

import torch
from torch import Tensor

from ...options import Settings
from ..color_search import ColorSearch, distinct
from ..pose import Pose, angle
from ..replay_log import ReplayLog
from ..result import Step
from ..task import PoseTask, PyramidLevel
from ..uncertainty import CORRELATION_LENGTH, Uncertainty, information_of
from .level import PhotoLevel, photo_levels
from .nearby import comparable, nearby, turns
from .occluders import OCCLUDER_SIDES, at_one_side, occluder_weights, visible_share, weighted
from .photo_descent import SURE_SUPPORT, UNOCCLUDED, PhotoCandidate, PhotoDescent

DOUBTFUL_SUPPORT = 0.75  # Of twenty poses with colours, a wrong one reached 0.73, right ones 0.79 and more.
REFINED_STARTS, REFINED_OCCLUDERS = 3, 4  # best ones on the coarsest level
REFINED_MATCHES = 6  # best poses around the start
MIN_SUPPORT = 0.1  # Noise shows no edges at all on the coarsest level, clutter 0.3.
LAST_LEVEL_ROUNDS = 2  # Each round leaves out what covers the object in the light of the one before.
DISTINCT_ANGLE = 0.05  # radians between distinct poses
UNCHANGED_COLORS = 0.05  # largest mean relative change of colours that counts as none
OCCLUDED_SUPPORT = 0.7  # least share of edges where a side of the object is left out
ARRIVED = 0.01  # A descent this near to another one's end, in radians and object sizes, will end there, too.
SAME_POSE_ANGLE = 0.1  # A refined pose further off, in radians, is another one.
# Other poses may be the answer if they are within so many radians of the start. They are ambiguous if they are less likely by a
# smaller factor than exp(this).
AMBIGUITY_REACH, AMBIGUITY_NATS = 0.7, 3.0
# The same for contours alone, after convergence: wrong results were up to exp(19) times less likely than the right pose, which no
# descent had reached, and exp(5) times likelier than the next; next to right results, others were exp(10) times less likely.
CONTOUR_AMBIGUITY_NATS = 8.0
SHARP_DEGREES = 1.0  # With colours, ambiguous poses are sought where the rotation is known less exactly.


class PhotoSearch(PhotoDescent):
    """The state of a search, with the attributes of ColorSearch."""

    def __init__(
        self, task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings,
        log: ReplayLog | None = None, further: bool = True,
    ) -> None:  # fmt: skip
        """`further`: try other starts where the refinement of the given one does not end well."""
        super().__init__(task, start, depths, settings, log)
        self.further = further
        # Before a uniform background, unlit colours are compared first.
        self.colors_first = not task.clutter and "alpha" not in task.aovs and all(depth is None for depth in depths)
        self.ambiguous: list[Pose] = []  # poses that may be the answer, too
        self._judged_poses: list[Pose] = []  # ends of the first descent

    def run(self) -> None:
        """Search; raise ValueError when nothing in the pictures depends on the pose."""
        if self.colors_first:
            self._colors_first()
        else:
            self._photograph_first()
        self.history.append(Step(self.levels[-1].size, self.loss, self.best, True, {}))

    def _colors_first(self) -> None:
        """Search by unlit colours, and by the terms of photographs where these do not fit."""
        colors = self._by_colors(self.start, self.task.pyramid(self.start, self.settings), self.further)
        self._adopt(colors)
        if colors.edge_support >= colors.enough or not self.further:
            self.enough = colors.enough
            return
        begins = len(self.history)
        best = self._photograph()
        won = best.edge_support >= self.enough
        self._forget(slice(0, begins) if won else slice(begins, None))
        if won:
            # Convergence then needs more, since the terms of photographs match much that is no photograph.
            self.enough = SURE_SUPPORT
            self._take(best)
        else:
            self.enough, self.ambiguous = colors.enough, []

    def _photograph_first(self) -> None:
        """Search by the terms of photographs; colours refine an unlit result, or search a mask where the terms find
        nothing."""
        task, best = self.task, self._photograph()
        if best.edge_support >= self.enough and not task.colorless and self._is_unlit(best.pose):
            colors = self._by_colors(best.pose, task.pyramid(best.pose, self.settings)[-2:], False)
            better = colors.converged and angle(colors.best.R, best.pose.R) < SAME_POSE_ANGLE
        elif best.edge_support < self.enough and not task.clutter and self.further:
            colors = self._by_colors(self.start, task.pyramid(self.start, self.settings), True)
            better = colors.converged
        else:
            return
        if better:
            self._adopt(colors)
            self.enough = colors.enough
        else:
            self._forget(slice(len(self.history) - len(colors.history) + 1, None))

    def _photograph(self) -> PhotoCandidate:
        """Return the best candidate by the terms of photographs."""
        begins = len(self.history)
        found = self._judge(*self._down(self.start, self.levels))
        if not self.history:
            raise ValueError(
                f"{self.task.names.init}: expected a pose at which the picture changes when the object moves, got one at which "
                "it does not; is the object out of view?"
            )
        stays = found.short and len(distinct([found.pose, self.start], 2, DISTINCT_ANGLE)) == 1
        start = self._judge(self.start, stays)
        best = max(found, start, key=lambda end: end.edge_support)
        self._judged_poses = [found.pose, start.pose]
        if not self.colors_first:
            self._take(best)
        if self.further and best.edge_support < self.enough:
            best = self._from_occluders(best, begins)
        if (
            self.further
            and best.edge_support < max(self.enough, DOUBTFUL_SUPPORT)
            and comparable(self.task, self.start)
        ):
            best = self._from_nearby(best, begins)
        if self.further and best.edge_support < self.enough:
            best = self._from_aside(best, begins)
        if best.edge_support < self.enough:
            return best
        if best is not start:
            best = self._refine_surrounded(best)
            if self.further and best.edge_support < SURE_SUPPORT and best.visible_share < UNOCCLUDED:
                again = self._from_occluders(best, begins)
                best = best if again is best else self._refine_surrounded(again)
        alone = self.further and all(depth is None for depth in self.depths)
        if alone and (self.task.colorless or self._vague(best.pose)):
            best = self._resolve_ambiguity(best, begins)
        return best

    def _from_aside(self, best: PhotoCandidate, begins: int) -> PhotoCandidate:
        """Refine other starts until the pictures show an end's edges. Steps of this search begin in the history at
        `begins`."""
        first, *finer = self._of_turned()
        answered = self._answered
        self._answered = True
        ends = [self._follow(first, self.task.moved(self.start, *turn))[0] for turn in turns()]
        scores = self.log.replay(lambda: [first.edge_support(pose, self.seed) for pose in ends])
        order = sorted((k for k in range(len(ends)) if scores[k] >= MIN_SUPPORT), key=lambda k: -scores[k])
        for pose in distinct([ends[k] for k in order], REFINED_STARTS, DISTINCT_ANGLE):
            before = len(self.history)
            best = self._better(best, self._judge(*self._down(pose, finer)), slice(begins, before), answered)
            if best.edge_support >= self.enough:
                break
        return best

    def _of_turned(self) -> list[PhotoLevel]:
        """Return the levels for starts rotated aside. With colours they begin on the coarsest level, which shows the light. A
        contour shows so little there that different starts would meet."""
        return self.levels[1:] if self.task.colorless else self.levels

    def likeliest(self, pose: Pose, short: bool) -> tuple[PhotoCandidate | None, list[Pose]]:
        """Compare a pose that was found otherwise with ambiguous ones; `short` as of its last step. Return the one that makes
        the pictures likelier, if there is one, and the others that these hardly separate from the answer."""
        last = photo_levels(self.task, pose, self.depths, self.settings)[-1]
        views = last.comparisons(pose, self.seed)
        last, weights = last.focused(views), occluder_weights(views)
        self.levels = [*self.levels[:-1], last]
        kept = 1.0 if weights is None else visible_share(views, weights)
        here = self._judge(pose, short, last if weights is None else weighted(last, weights))._replace(
            visible_share=kept
        )
        answer = self._resolve_ambiguity(here, 0)
        return None if answer is here else answer, self.ambiguous

    def _resolve_ambiguity(self, best: PhotoCandidate, begins: int) -> PhotoCandidate:
        """Return the most likely of ambiguous poses. From afar, a mirror-symmetric object has the contour that it has behind a
        mirror, so one contour in two poses. A bottle that shows hardly more than its bottom, a disc of one colour, is
        ambiguous in many."""
        colorless = self.task.colorless
        first, *finer = self._of_turned()
        turned = [self.task.moved(self.start if colorless else best.pose, *turn) for turn in turns()]
        before = len(self.history)
        self._answered = True
        here, *ends = (self._follow(first, pose)[0] for pose in [best.pose, *turned])
        costs = self.log.replay(lambda: first.negative_log_likelihoods([here, *ends], self.seed))
        sure, doubt = (
            AMBIGUITY_NATS * CORRELATION_LENGTH**2,
            (CONTOUR_AMBIGUITY_NATS if colorless else AMBIGUITY_NATS) * CORRELATION_LENGTH**2,
        )
        order = sorted(range(len(ends)), key=lambda k: costs[1 + k])
        if not colorless:  # Colours that separate poses in so few pixels do so in more.
            order = [k for k in order if costs[1 + k] - costs[0] < sure]
        found = [best]
        level = self._unoccluded_level(best)
        for pose in distinct([here, *(ends[k] for k in order)], 1 + REFINED_STARTS, DISTINCT_ANGLE)[1:]:
            if (reached := self._apart(pose, finer, best.pose)) is None:
                continue
            end = self._judge(*reached, level)
            if (
                end.edge_support >= min(self.enough, DOUBTFUL_SUPPORT)
                and angle(end.pose.R, self.start.R) < AMBIGUITY_REACH
            ):
                found.append(end)
        costs = self.log.replay(lambda: level.negative_log_likelihoods([end.pose for end in found], self.seed))
        k = min((k for k, end in enumerate(found) if end.edge_support >= self.enough), key=costs.__getitem__, default=0)
        # Taking one that is hardly likelier would make answers depend on the start.
        won = costs[0] - costs[k] > sure and (colorless or found[k].edge_support > best.edge_support)
        answer, cost = (found[k], costs[k]) if won else (best, costs[0])
        self.ambiguous = [
            end.pose for end, other in zip(found, costs, strict=True) if end is not answer and other - cost < doubt
        ]
        if not won:
            self._forget(slice(before, None))
            return best
        self._forget(slice(begins, len(self.history)))
        if not self.colors_first:
            self._take(answer)
        return self._refine_surrounded(answer)

    def _apart(self, pose: Pose, levels: list[PhotoLevel], other: Pose) -> tuple[Pose, bool] | None:
        """Refine like _down(), but return None as soon as the other pose is reached."""

        def there(pose: Pose) -> bool:
            return angle(pose.R, other.R) < ARRIVED and self.task.between(pose, other) < ARRIVED

        short = False
        for level in levels:
            pose, short = self._follow(level, pose, there)
            if there(pose) or (not self.task.colorless and angle(pose.R, other.R) < DISTINCT_ANGLE):
                return None
        return pose, short

    def _vague(self, pose: Pose) -> bool:
        """Return whether the pictures show the pose's rotation so little that it may be ambiguous."""
        (degrees,) = self.log.replay(lambda: [self._degrees(pose)])
        return degrees > SHARP_DEGREES

    def _degrees(self, pose: Pose) -> float:
        curvature = self.levels[-1].equations(pose, self.seed)[0].curvature
        return Uncertainty.from_information(self.task, pose, information_of(curvature), self.task.dofs, None).degrees

    def _from_occluders(self, best: PhotoCandidate, begins: int) -> PhotoCandidate:
        """Refine with possible occluders at one side left out, until the pictures surely show an end's edges."""
        answered = self._answered
        self._answered = True
        coarse = self.levels[0]
        first = coarse.comparisons(self.start, self.seed)
        all_weights = [[at_one_side(seen.alpha, side) for seen in first] for side in range(OCCLUDER_SIDES)]
        ends = [self._follow(weighted(coarse, weights), self.start)[0] for weights in all_weights]
        scores = self.log.replay(
            lambda: [
                weighted(coarse, weights).edge_support(pose, self.seed)
                for pose, weights in zip(ends, all_weights, strict=True)
            ]
        )
        hopeful = [k for k in range(OCCLUDER_SIDES) if scores[k] >= MIN_SUPPORT]
        order = sorted(hopeful, key=lambda k: -scores[k])[:REFINED_OCCLUDERS]
        return self._refine_occluded(best, ((ends[k], all_weights[k]) for k in order), begins, answered)

    def _from_nearby(self, best: PhotoCandidate, begins: int) -> PhotoCandidate:
        """Refine poses around the start that the picture shows, as a whole or at all sides but one."""
        answered = self._answered
        self._answered = True
        coarse, first, *_ = self.levels
        size = len(self.start.numbers)

        def hopeful(pose: Pose) -> bool:
            return coarse.edge_support(pose, self.seed) >= MIN_SUPPORT

        def compared() -> list[float]:
            if not (hopeful(self.start) or hopeful(best.pose)):
                return []
            found = nearby(self.task, self.start, self.seed)[:REFINED_MATCHES]
            return [number for pose, side in found if hopeful(pose) for number in (*pose.numbers, float(side))]

        def starts() -> Iterator[tuple[Pose, list[Tensor]]]:
            flat = self.log.replay(compared)
            for at in range(0, len(flat), size + 1):
                pose, side = Pose.from_numbers(flat[at : at + size]), int(flat[at + size])
                yield pose, [at_one_side(seen.alpha, side) for seen in first.comparisons(pose, self.seed)]

        return self._refine_occluded(best, starts(), begins, answered)

    def _refine_occluded(
        self, best: PhotoCandidate, starts: Iterable[tuple[Pose, list[Tensor]]], begins: int, answered: bool
    ) -> PhotoCandidate:  # fmt: skip
        """Refine poses with initial weights (h, w) of the pictures, until one is sure; return the best."""
        for pose, weights in starts:
            before = len(self.history)
            found = self._unoccluded(pose, weights, self.levels[1:])
            # Of so many candidates, one may match something by chance.
            if found.edge_support < OCCLUDED_SUPPORT:
                self._forget(slice(before, None))
                continue
            best = self._better(best, found, slice(begins, before), answered)
            if best.edge_support >= SURE_SUPPORT:
                break
        return best

    def _refine_surrounded(self, best: PhotoCandidate) -> PhotoCandidate:
        """Refine once more by the surroundings of the end, and without occluders, so that the result does not depend on the
        start."""
        *_, coarser, last = photo_levels(self.task, best.pose, self.depths, self.settings)
        last = last.focused(last.comparisons(best.pose, self.seed))
        before = len(self.history)
        weights = occluder_weights(last.comparisons(best.pose, self.seed)) or [
            torch.ones(picture.size, dtype=torch.float32) for picture in last.pictures
        ]
        # On the last level steps are small and may stop early. From nearer, those of the level before lead on by colours inside.
        levels = [last] * LAST_LEVEL_ROUNDS if self.task.colorless else [coarser, *[last] * LAST_LEVEL_ROUNDS]
        found = self._unoccluded(best.pose, weights, levels)
        if found.edge_support < self.enough:
            self._forget(slice(before, None))
            return best
        self.levels = [*self.levels[:-1], last]
        if not self.colors_first:
            self._take(found)
        return found

    def _is_unlit(self, pose: Pose) -> bool:
        """Return whether the light leaves the mesh's colours as they are. This holds for pictures, not for a pose. At a wrong
        pose the fitted light makes up for a part of the error, so the least change counts: at this pose, and where the first
        descent began and ended."""
        poses = [pose, *self._judged_poses]
        (least,) = self.log.replay(lambda: [min(self._change(one) for one in poses)])
        return least < UNCHANGED_COLORS

    def _change(self, pose: Pose) -> float:
        """Return the largest change of the mesh's colours by the light over the pictures, relative to the colours."""
        seen = self.levels[-1].comparisons(pose, self.seed)
        return max(math.inf if one.lit is None else one.lit.change() for one in seen)

    def _by_colors(self, start: Pose, levels: list[PyramidLevel], further: bool) -> ColorSearch:
        """Search by unlit colours from a start, with its steps added to the history."""
        search = ColorSearch(self.task, levels, start, self.settings, self.log, further)
        before = list(self.history)

        def after_step() -> None:
            self.history = [*before, *search.history]
            if not before:
                self.best, self.loss, self.edge_support = search.best, search.loss, search.edge_support
            self.after_step()

        search.after_step = after_step
        search.run()
        self.history = [*before, *search.history[:-1]]  # The last entry is the final comparison.
        return search

    def _adopt(self, search: ColorSearch) -> None:
        self.best, self.loss, self._answered = search.best, search.loss, True
        self.edge_support, self.converged, self.information = search.edge_support, search.converged, search.information

    def first_end(self) -> float:
        """Return the share of the render's edges that the pictures show where the start alone leads."""
        return self._judge(*self._down(self.start, self.levels)).edge_support
