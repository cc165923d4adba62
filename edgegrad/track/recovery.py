"""The search for a lost object in a whole frame: hypotheses of fit_pose, verified by its likelihood, in a second thread."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import NamedTuple

from torch import Tensor

from ..camera.camera import Camera
from ..fit.modes import in_full_precision
from ..fit.options import Settings
from ..fit.placement import Pose
from ..fit.pose.hypotheses import HypothesisSearch
from ..fit.pose.inputs import ArgumentNames
from ..fit.pose.likelihood.objective import pose_levels
from ..fit.pose.likelihood.support import enough_support, evidence_of
from ..fit.pose.task import PoseTask, Unknowns
from ..fit.pose.track import matches
from ..scene.mesh import Mesh
from ..scene.scene import Scene


class Sighting(NamedTuple):
    """A frame (H, W, C) of linear radiance in which an object is sought, its depth (H, W), and where the object was seen last."""

    frame: int
    picture: Tensor
    depth: Tensor | None
    last: Pose


class Recovery:
    """Seeks one lost object."""

    def __init__(self, mesh: Mesh | Scene, camera: Camera, settings: Settings) -> None:
        self._mesh, self._camera, self._settings = mesh, camera, settings

    @in_full_precision
    def search(self, sighting: Sighting) -> Pose | None:
        """Return the pose in the frame, or None where the likelihood of fit_pose finds too few of the render's edges."""
        last, depths = sighting.last, [sighting.depth]
        names = ArgumentNames(images=f"frames[{sighting.frame}]")
        task = PoseTask.from_arguments(
            self._mesh, sighting.picture, self._camera, None, None, Unknowns(), float(last.scale), names
        )
        # The background counts as unknown, since a film shows more than one.
        task = replace(task, clutter=True, shots=[task.shots[0]._replace(background=None)])
        groups = [(last, [last]), *((pose, [pose]) for pose in matches(task, last, self._settings.seed))]
        modes = HypothesisSearch(task, groups, depths, self._settings, further=False).run()
        if not modes:
            return None
        level = pose_levels(task, modes[0].pose, depths, self._settings)[-1]
        share = evidence_of(level, modes[0].pose).edges
        return modes[0].pose if share >= enough_support(task) else None


class SearchThread:
    """Runs one search after the other in a second thread, while frames go on."""

    def __init__(self, search: Callable[[Sighting], Pose | None], wait: bool) -> None:
        """`wait`: the search ends before begin() returns, so that results do not depend on its time."""
        self._search, self._wait = search, wait
        self._pool: ThreadPoolExecutor | None = None
        self._running: Future[Pose | None] | None = None

    @property
    def is_idle(self) -> bool:
        return self._running is None

    def begin(self, sighting: Sighting) -> None:
        """Begin a search."""
        self._pool = self._pool or ThreadPoolExecutor(1, thread_name_prefix="edgegrad-search")
        self._running = self._pool.submit(self._search, sighting)
        if self._wait:
            self._running.exception()

    def result(self) -> Pose | None:
        """Return what a finished search found; None too while it runs. An error in it is raised here."""
        if self._running is None or not self._running.done():
            return None
        done, self._running = self._running, None
        return done.result()

    def forget(self) -> None:
        """Leave out the result of a search that runs."""
        self._running = None
