"""Tracker: follows known meshes from frame to frame of a film or a live camera."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike as OsPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import as_tensor, check_shape
from ..files.image import read_image, srgb_to_linear
from ..files.paths import PathLike
from ..fit.measured import SIZE_FIX, measured_image
from ..fit.options import FitOptions, Settings
from ..fit.placement import Pose, pose_from_matrix
from ..fit.pose.inputs import check_in_front, warn_of_units, without_colors
from ..fit.pose.result import PoseFit
from ..fit.views import check_image
from ..kernel.tracking import Found, KernelTracker, Shape
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .confidence import confidence_of, features_of
from .recovery import Recovery, SearchThread, Sighting
from .result import TrackedPose
from .surface import shape_of

FrameLike = Tensor | np.ndarray | PathLike
Initial = PoseFit | Tensor
STATE_VERSION = 1


@dataclass(frozen=True)
class TrackerSettings:
    """Numbers of the tracker that are not of the kernel (csrc/track/settings.h)."""

    # A pose is lost below this confidence: more says so of right poses, less is late to say so of wrong ones.
    least_confidence: float = 0.5
    # Successive frames for which a lost object is followed alone; then every other frame starts where it was seen last, and goes
    # on elsewhere if that fails.
    patience: int = 2
    # Frames after which it is sought in a whole frame, and from the end of one search to the next.
    search_after: int = 4


TRACKER = TrackerSettings()


class _Followed:
    """One object: what does not change, and what the next update depends on besides the kernel's state."""

    def __init__(self, mesh: Mesh | Scene, name: str, init: object, camera: Camera) -> None:
        self.start = pose_from_matrix(name, getattr(init, "matrix", init))
        self.scene = (Scene([mesh]) if isinstance(mesh, Mesh) else mesh).to("cpu").detach()
        self.scale = float(self.start.scale)
        self.shape: Shape = shape_of(self.scene, self.scale)
        check_in_front(name, camera, self.start, torch.from_numpy(self.shape.center / self.scale))
        self.digest = hashlib.sha256(self.shape.verts.tobytes() + self.shape.faces.tobytes()).hexdigest()
        self.view = camera.world_to_camera.double().numpy()
        self.good = self.to_camera(self.start)  # the last pose that was likely
        self.poor = 0  # successive frames in which it was not
        self.aside: tuple[np.ndarray, np.ndarray] | None = None  # the kernel's state while a frame starts at `good`

    def to_camera(self, pose: Pose) -> tuple[np.ndarray, np.ndarray]:
        """Return the rotation from the mesh to the camera, and the centre in the camera's frame."""
        R = self.view[:3, :3] @ pose.R.double().numpy()
        c = R @ self.shape.center + self.view[:3, :3] @ pose.t.double().numpy() + self.view[:3, 3]
        return R, c

    def to_world(self, R: np.ndarray, c: np.ndarray) -> Pose:
        """Return the pose of the mesh in the world."""
        V = self.view[:3, :3]
        t = V.T @ (c - R @ self.shape.center - self.view[:3, 3])
        return Pose(torch.from_numpy(V.T @ R), torch.from_numpy(t), self.start.scale)

    def covariance(self, found: Found) -> Tensor:
        """Return the covariance along the world's axes."""
        J = np.kron(np.diag([1.0, self.shape.size]), self.view[:3, :3].T)
        return torch.from_numpy(J @ found.covariance @ J.T)


class Tracker:
    """Follows known meshes from frame to frame of a film or a live camera, some 100 frames a second.

    Lines across the contour of each mesh, points of its texture and depth are compared with a frame. Neither the light nor the
    background need be known, and a hand may pass over half of an object. `confidence` is the probability that a pose is right;
    below one half the object is `lost`, and it is sought where it was and, in a second thread, in the whole frame.

    Parameters
    ----------
    mesh : Mesh, Scene or sequence of these
        What the frames show; the meshes of a Scene move together. Several objects cover one another, and give a tuple of poses.
    camera : Camera
        The camera of all frames, of their size and of any lens. It does not move: poses are those of the meshes.
    init : PoseFit, Tensor or sequence of these
        The pose of each object in the first frame, within about 10° and 5 % of its size: an earlier fit, or mesh to world (4, 4).
    options : FitOptions, optional
        Of the search for a lost object: `max_size`, by default 256, `spp`, by default 8, and `seed`.
    wait : bool, default False
        Whether an update waits for the search, so that poses do not depend on its time.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong, or the camera sees no contour of an object at `init`.

    Examples
    --------
    >>> tracker = Tracker(mesh, camera, fit_pose(mesh, picture, camera))  # doctest: +SKIP
    >>> pose = tracker.update(frame)  # doctest: +SKIP
    """

    def __init__(
        self, mesh: Mesh | Scene | Sequence[Mesh | Scene], camera: Camera, init: Initial | Sequence[Initial], *,
        options: FitOptions | None = None, wait: bool = False,
    ) -> None:  # fmt: skip
        if not isinstance(camera, Camera) or camera.batch is not None:
            got = type(camera).__name__ if not isinstance(camera, Camera) else f"a batch of {camera.batch}"
            raise TypeError(f"camera: expected the one Camera of all frames, got {got}")
        self._single = isinstance(mesh, Mesh | Scene)
        meshes, inits = ([mesh], [init]) if self._single else _several(mesh, init)
        settings = Settings.from_options(options, "track", ("max_size", "spp"), spp=8)
        self._camera = camera.to("cpu").detach()
        names = ["init"] if self._single else [f"init[{k}]" for k in range(len(meshes))]
        self._objects: list[_Followed] = []
        self._kernel = KernelTracker(self._camera)
        for part, name, start in zip(meshes, names, inits, strict=True):
            if not isinstance(part, Mesh | Scene):
                raise TypeError(
                    f"mesh: expected a Mesh or a Scene, got {type(part).__name__}; load one with load_mesh(path)"
                )
            followed = _Followed(part, name, start, self._camera)
            self._kernel.add(followed.shape, *followed.good)
            self._objects.append(followed)
        for k, name in enumerate(names):
            if not self._kernel.is_in_view(k):
                raise ValueError(
                    f"{name}: expected a pose at which the camera sees the mesh and its contour, got one out of the picture, or "
                    "so near that the mesh fills it; start where it is"
                )
        recoveries = [Recovery(one.scene, self._camera, settings) for one in self._objects]
        self._searches = [SearchThread(recovery.search, wait) for recovery in recoveries]
        self._index, self._channels, self._had_depth = 0, 0, False
        self.times: tuple[dict[str, float], ...] = ()  # seconds of the parts of the last update, for each object

    def update(self, image: FrameLike, depth: Tensor | np.ndarray | None = None) -> Any:
        """Return the pose in the next frame, a TrackedPose, or a tuple with that of each object.

        Parameters
        ----------
        image : Tensor, array or path
            (H, W, 3) or (H, W, 1): uint8 as cameras and files have it, sRGB, in the order red, green, blue; or float, which is
            linear radiance, as read_image() gives it. A path is read.
        depth : Tensor or array, optional
            (H, W) float along the camera's axis, world units; NaN or 0 where nothing was measured.

        Raises
        ------
        TypeError, ValueError, OSError
            The frame cannot be used, which leaves the state as it was.
        """
        name = f"frames[{self._index}]"
        frame = self._frame(name, image)
        measured = None if depth is None else self._depth(depth)
        self._channels = frame.shape[-1]
        for k in range(len(self._objects)):
            self._return_to_last(k)
        rows = self._kernel.update(frame, None if measured is None else measured.numpy())
        if len(rows) == 1 and (one := self._objects[0]).aside is not None and not self._is_likely(0, rows[0]):
            # One object alone goes on in this frame; several do in the next one.
            self._kernel.load(0, *one.aside)
            one.aside = None
            rows = self._kernel.update(frame, None if measured is None else measured.numpy())
        self.times = tuple(found.times for found in rows)
        poses = tuple(self._judged(k, found) for k, found in enumerate(rows))
        for k in range(len(self._objects)):
            self._seek(k, frame, measured)
        self._index += 1
        return poses[0] if self._single else poses

    def _depth(self, given: object) -> Tensor:
        """Return a depth image (H, W) float32. The first one is checked, and warned of where it has other units than the scene.
        Raises TypeError or ValueError."""
        name = f"depths[{self._index}]"
        depth = as_tensor(name, given).detach().cpu()
        if self._had_depth and depth.dtype == torch.float32 and tuple(depth.shape) == self._camera.size:
            return depth  # The kernel leaves out what was not measured.
        depth = measured_image(name, depth, self._camera.size)[..., 0]
        if not self._had_depth:
            start = [one.to_world(*one.good) for one in self._objects]
            moved = [one.scene.transformed(p.R, p.t, p.scale) for one, p in zip(self._objects, start, strict=True)]
            meshes = [part for scene in moved for part in without_colors(scene).meshes]
            warn_of_units(Scene(meshes), [self._camera], [depth], "at the start")
        self._had_depth = True
        return depth

    def _return_to_last(self, k: int) -> None:
        """Move a lost object to where a search found it, or to where it was seen last."""
        one = self._objects[k]
        if one.poor < TRACKER.patience:
            return
        try:
            found = self._searches[k].result()
        except (MemoryError, RuntimeError, ValueError):  # A frame in which nothing can be compared finds nothing.
            found = None
        if found is not None:
            self._kernel.place(k, *one.to_camera(found))
        elif one.poor % 2 == 0:
            one.aside = self._kernel.save(k)
            self._kernel.place(k, *one.good)

    def _is_likely(self, k: int, found: Found) -> bool:
        features = features_of(found, len(self._objects[k].shape.textured.X) > 0)
        return confidence_of(features) >= TRACKER.least_confidence

    def _judged(self, k: int, found: Found) -> TrackedPose:
        """Return the result for an object, and note whether it is lost."""
        one = self._objects[k]
        features = features_of(found, len(one.shape.textured.X) > 0)
        confidence = confidence_of(features)
        lost = not confidence >= TRACKER.least_confidence
        one.poor = one.poor + 1 if lost else 0
        if lost and one.aside is not None:
            self._kernel.load(k, *one.aside)
        one.aside = None
        if not lost:
            one.good = found.R, found.c
        pose = one.to_world(*one.good)
        covariance, visible = one.covariance(found), features["visible"]
        return TrackedPose(self._index, pose.R, pose.t, one.scale, covariance, confidence, lost, visible, features)

    def _seek(self, k: int, frame: np.ndarray, depth: Tensor | None) -> None:
        """Begin the search for an object that is lost, unless one runs."""
        one, search = self._objects[k], self._searches[k]
        if one.poor == 0:
            return search.forget()
        if (
            one.poor < TRACKER.search_after
            or (one.poor - TRACKER.search_after) % TRACKER.search_after
            or not search.is_idle
        ):
            return None
        channels = (
            one.scene.channels if any(part.channels is not None for part in one.scene.meshes) else frame.shape[-1]
        )
        if channels != frame.shape[-1]:
            return None
        linear = torch.from_numpy(frame.copy())
        linear = srgb_to_linear(linear.float() / 255.0) if frame.dtype == np.uint8 else linear
        measured = None if depth is None else torch.where(depth > 0.0, depth, torch.nan)
        return search.begin(Sighting(self._index, linear, measured, one.to_world(*one.good)))

    def _frame(self, name: str, image: object) -> np.ndarray:
        """Return a frame (H, W, C) as uint8 or float32. Raises TypeError, ValueError or OSError."""
        if isinstance(image, (str, OsPath)):
            try:
                image = read_image(image, channels=3)
            except (OSError, ValueError) as error:
                raise type(error)(f"{name}: {error}") from error
        if getattr(image, "dtype", None) in (torch.uint8, np.uint8):
            frame = as_tensor(name, image).detach().cpu()
            frame = frame[..., None] if frame.dim() == 2 else frame
            check_shape(name, frame, (*self._camera.size, "C"), fix=SIZE_FIX)
        else:
            frame = check_image(name, image, self._camera.size)
        C = frame.shape[-1]
        if self._channels and self._channels != C:
            raise ValueError(f"{name}: expected {self._channels} channels as of the frames before, got {C}")
        if C not in (1, 3):
            raise ValueError(f"{name}: expected 1 or 3 channels, got {C}; leave out alpha by image[..., :3]")
        return frame.contiguous().numpy() if frame.dtype == torch.uint8 else frame.float().contiguous().numpy()

    def state_dict(self) -> dict[str, Any]:
        """Return all that the next update depends on, as tensors and numbers, for torch.save(). Searches are not kept."""
        objects = []
        for k, one in enumerate(self._objects):
            numbers, colors = (torch.from_numpy(part) for part in self._kernel.save(k))
            R, c = (torch.from_numpy(part.copy()) for part in one.good)
            objects.append({"numbers": numbers, "colors": colors, "R": R, "c": c, "poor": one.poor, "mesh": one.digest})
        return {"version": STATE_VERSION, "index": self._index, "channels": self._channels, "objects": objects}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from the state of a tracker of the same meshes and camera. Raises ValueError."""
        if not isinstance(state, Mapping) or state.get("version") != STATE_VERSION:
            raise ValueError(f"state: expected what state_dict() returned, of version {STATE_VERSION}")
        if len(state["objects"]) != len(self._objects):
            raise ValueError(f"state: expected {len(self._objects)} objects, got {len(state['objects'])}")
        for k, (one, saved) in enumerate(zip(self._objects, state["objects"], strict=True)):
            if saved["mesh"] != one.digest:
                raise ValueError(f"state: expected objects[{k}] to be of this tracker's mesh, got another mesh's")
        for k, (one, saved) in enumerate(zip(self._objects, state["objects"], strict=True)):
            self._kernel.load(k, saved["numbers"].numpy(), saved["colors"].numpy())
            one.good, one.poor = (saved["R"].numpy(), saved["c"].numpy()), int(saved["poor"])
            self._searches[k].forget()
        self._index, self._channels = int(state["index"]), int(state["channels"])


def _several(mesh: object, init: object) -> tuple[list[Any], list[Any]]:
    """Return the objects and their poses. Raises TypeError or ValueError."""
    if not isinstance(mesh, Sequence) or not mesh:
        got = "none" if isinstance(mesh, Sequence) else type(mesh).__name__
        raise TypeError(
            f"mesh: expected a Mesh, a Scene or a sequence of them, got {got}; load one with load_mesh(path)"
        )
    if not isinstance(init, (Sequence, Tensor)) or len(init) != len(mesh):
        got = len(init) if isinstance(init, (Sequence, Tensor)) else type(init).__name__
        raise ValueError(f"init: expected a pose for each of {len(mesh)} meshes, got {got}")
    return list(mesh), list(init)
