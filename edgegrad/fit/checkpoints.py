"""Checkpoints of fits: files that are written whole or not at all, and refused by any other fit than the one that wrote
them."""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import torch

from ..camera.camera import Camera
from ..check import check_flag, check_positive_int
from ..files.paths import PathLike, replacing
from ..warnings import warn
from .placement import Placement
from .views import Observation

FORMAT = 14


@dataclass(frozen=True)
class Checkpoint:
    """The file in which a fit keeps its state.

    Parameters
    ----------
    path : str or Path
        The file, in a folder that exists. It is written whole or not at all.
    every : int, default 25
        Steps from one writing to the next. The state at the end is written too.
    resume : bool, default False
        Whether the fit goes on from the file, so that it ends as if it had never stopped. The file of a fit with other
        arguments is refused. Where there is none, the fit begins anew and warns.

    Raises
    ------
    TypeError, ValueError, FileNotFoundError
        An argument has another type or range, or the folder does not exist.
    """

    path: PathLike
    every: int = 25
    resume: bool = False

    def __post_init__(self) -> None:
        if not isinstance(self.path, (str, PurePath)):
            raise TypeError(f"checkpoint: expected a path, got {type(self.path).__name__} ({self.path!r})")
        check_positive_int("checkpoint.every", self.every)
        check_flag("checkpoint.resume", self.resume)
        if not (folder := Path(self.path).absolute().parent).is_dir():
            raise FileNotFoundError(f"checkpoint: expected the folder {folder} to exist; make it first with Path.mkdir")

    def of_part(self, k: int) -> Checkpoint:
        """Return the checkpoint of part k of a fit, with its number in the file's name.

        Only the first must be there to go on from: a fit may end before the others begin.
        """
        whole = Path(self.path)
        path = whole.with_name(f"{whole.stem}-{k + 1:04d}{whole.suffix}")
        return replace(self, path=path, resume=self.resume and (k == 0 or path.exists()))


def checkpoint_of(given: Checkpoint | PathLike | None) -> Checkpoint | None:
    """Return the checkpoint with a path, or the given one. Raises as Checkpoint does."""
    return given if given is None or isinstance(given, Checkpoint) else Checkpoint(given)


class CheckpointFile:
    """The file of one fit. `given` are the fit's arguments by name: tensors, numbers, or dataclasses of them. Another fit is
    one with other arguments; functions are not compared."""

    def __init__(self, checkpoint: Checkpoint | None, given: Mapping[str, Any]) -> None:
        self.checkpoint, self._seed = checkpoint, given.get("seed")
        self._given = {} if checkpoint is None else {name: _digest(value) for name, value in given.items()}

    @staticmethod
    def from_views(
        checkpoint: Checkpoint | None, views: Sequence[Observation], given: Mapping[str, Any]
    ) -> CheckpointFile:
        """Return the file of a descent; `given` are the arguments that the views do not hold."""
        of_views = {
            "cameras": [traits(view.camera) for view in views],
            "images": [view.image for view in views],
            "masks": [view.mask for view in views],
            "weights": [view.weight for view in views],
            "measured": [dict(view.measured) for view in views],
        }
        return CheckpointFile(checkpoint, {**given, **of_views})

    def read(self) -> dict[str, Any] | None:
        """Return the state to go on from, or None to begin. Raises ValueError for a folder, for a file that is no checkpoint, and
        where a fit is to go on from another's."""
        if self.checkpoint is None:
            return None
        path = self.checkpoint.path
        if Path(path).is_dir():
            raise ValueError(f"checkpoint: expected a file name, got the folder {path}; add a name to it")
        if not self.checkpoint.resume:
            _check_replaceable(path)
            return None
        if (content := _content(path)) is None:
            warn(
                f"no checkpoint {path}",
                f"checkpoint: expected {path} to go on from, got no such file; the fit begins anew and writes it",
            )
            return None
        found = content["given"]
        if other := [name for name in {**self._given, **found} if self._given.get(name) != found.get(name)]:
            raise ValueError(
                f"checkpoint: expected {path} to be of this fit, got one that was made with another {', '.join(other)}; give "
                "what it was made with, or remove it to begin anew"
            )
        return content["state"]

    def write(self, state: dict[str, Any]) -> None:
        """Write the state. If that fails, as on a full disk, the fit goes on with a warning."""
        if self.checkpoint is None:
            return
        path, content = self.checkpoint.path, io.BytesIO()  # torch's own errors of writing do not give the reason
        torch.save({"format": FORMAT, "given": self._given, "seed": self._seed, "state": state}, content)
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(content.getbuffer())
        except OSError as error:
            warn(
                f"checkpoint {path}",
                f"checkpoint: {path}: {error.strerror or error}; the fit goes on without",
            )


def saved_seed(checkpoint: Checkpoint | None) -> int | None:
    """Return the seed of the fit that goes on, or None. Raises ValueError for a file that is no checkpoint."""
    content = None if checkpoint is None or not checkpoint.resume else _content(checkpoint.path)
    return None if content is None else content["seed"]


def _check_replaceable(path: PathLike) -> None:
    """Raise ValueError where a file is neither empty nor a checkpoint of any fit, which a new one would overwrite."""
    if not Path(path).exists() or Path(path).stat().st_size == 0:
        return
    try:
        content = torch.load(path, weights_only=True, map_location="cpu", mmap=True)
    except Exception:  # torch raises errors of many kinds for other files
        content = None
    if not isinstance(content, dict) or not {"format", "given", "state"} <= content.keys():
        raise ValueError(
            f"checkpoint: expected {path} to be a checkpoint or no file yet, got another file, which the fit would overwrite; "
            "give another name, or remove it"
        )


def _content(path: PathLike) -> dict[str, Any] | None:
    """Return what a checkpoint holds, or None where there is no file. Raises ValueError."""
    if not Path(path).exists():
        return None
    fix = "remove it, or leave out resume"
    try:
        content = torch.load(path, weights_only=True)
    except Exception as error:  # torch raises errors of many kinds for a damaged file
        raise ValueError(
            f"{path}: expected a checkpoint of a fit, got something else ({type(error).__name__}); {fix}"
        ) from error
    made = content.get("format") if isinstance(content, dict) else None
    if isinstance(made, int) and made != FORMAT:
        raise ValueError(
            f"{path}: expected a checkpoint of format {FORMAT}, got {made}, which another version of edgegrad wrote; go on with "
            "that version, or remove it to begin anew"
        )
    if made != FORMAT or not isinstance(content.get("given"), dict) or not {"state", "seed"} <= content.keys():
        raise ValueError(f"{path}: expected a checkpoint of a fit, got something else; {fix}")
    return content


def traits(camera: Camera) -> tuple[Any, ...]:
    """Return all that a camera consists of, for CheckpointFile."""
    return camera, camera.size, camera.projection, camera.lens


def _digest(value: Any) -> str:
    """Hash the tensors and plain values in it."""
    return hashlib.sha256(repr(_plain(value)).encode()).hexdigest()


def _plain(value: Any) -> Any:
    """Return what it consists of in plain values, arrays as their hashes; functions as None."""
    if isinstance(value, torch.Tensor):
        value = value.detach().cpu().contiguous().numpy()
    if isinstance(value, np.ndarray):
        return str(value.dtype), value.shape, hashlib.sha256(value.tobytes()).hexdigest()
    if isinstance(value, float) and value.is_integer():
        return int(value)  # 0 and 0.0 are the same
    if isinstance(value, str | int | float):
        return value
    if isinstance(value, Mapping):
        return {name: _plain(value[name]) for name in sorted(value)}
    if isinstance(value, Placement):
        return _plain((value.coordinates, value.start, value.center, value.size))
    if isinstance(value, tuple | list):
        return [_plain(part) for part in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [
            field.name for field in dataclasses.fields(value) if field.name != "name"
        ]  # a mesh's name changes nothing
        return type(value).__name__, {name: _plain(getattr(value, name)) for name in names}
    return None
