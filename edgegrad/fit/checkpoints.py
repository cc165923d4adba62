"""Checkpoints of fits: files that are written whole or not at all, and refused by any other fit than the one that wrote them."""

from __future__ import annotations

import dataclasses
import hashlib
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..camera.camera import Camera
from ..files.paths import PathLike, replacing
from ..warnings import warn
from .options import Options, Parameter
from .placement import Placement
from .views import Observation

FORMAT = 9
STEP_OPTIONS = (  # options that steps depend on
    "loss", "mask_loss", "method", "views_per_step", "spp", "seed", "patience", "tolerance", "render",
)  # fmt: skip


class Checkpoint:
    """The file of one fit, which the fit resumes from if `resumes` is True. `given` are the fit's arguments by name: tensors,
    numbers, or dataclasses of them. Another fit is one with other arguments; functions are not compared."""

    def __init__(self, path: PathLike | None, resumes: bool, given: Mapping[str, Any]) -> None:
        self.path, self._resumes = path, resumes
        self._given = {} if path is None else {name: _digest(value) for name, value in given.items()}

    @staticmethod
    def from_fit(options: Options, views: Sequence[Observation], given: Mapping[str, Any]) -> Checkpoint:
        """Return the checkpoint of a descent; `given` are the arguments that options and views do not hold."""
        of_views = {
            "cameras": [traits(view.camera) for view in views],
            "images": [view.image for view in views],
            "masks": [view.mask for view in views],
            "weights": [view.weight for view in views],
        }
        if any(view.measured for view in views):
            of_views["measured"] = [dict(view.measured) for view in views]
        of_options = {name: getattr(options, name) for name in STEP_OPTIONS}
        return Checkpoint(options.checkpoint, options.resume, {**given, **of_views, **of_options})

    def read(self) -> dict[str, Any] | None:
        """Return the state to go on from, or None to begin. Raises ValueError for a file that is no checkpoint, or another
        fit's."""
        if not self._resumes or self.path is None or not Path(self.path).exists():
            return None
        try:
            state = torch.load(self.path, weights_only=True)
        except Exception as error:  # torch raises errors of many kinds for a damaged file
            raise ValueError(
                f"{self.path}: expected a checkpoint of a fit, got something else ({type(error).__name__}); "
                "remove it, or leave out resume"
            ) from error
        made = state.get("format") if isinstance(state, dict) else None
        if isinstance(made, int) and made != FORMAT:
            raise ValueError(
                f"{self.path}: expected a checkpoint of format {FORMAT}, got {made}, which another version of edgegrad wrote; go "
                "on with that version, or remove it to begin anew"
            )
        found = state.get("given") if made == FORMAT else None
        if not isinstance(found, dict) or "state" not in state:
            raise ValueError(
                f"{self.path}: expected a checkpoint of a fit, got something else; remove it, or leave out resume"
            )
        if other := [name for name in {**self._given, **found} if self._given.get(name) != found.get(name)]:
            raise ValueError(
                f"resume: expected {self.path} to be a checkpoint of this fit, got one that was made with another "
                f"{', '.join(other)}; give what it was made with, or remove it to begin anew"
            )
        return state["state"]

    def write(self, state: dict[str, Any]) -> None:
        """Write the state. If that fails, as on a full disk, the fit goes on with a warning."""
        if self.path is None:
            return
        content = io.BytesIO()  # torch's own errors of writing do not give the reason
        torch.save({"format": FORMAT, "given": self._given, "state": state}, content)
        try:
            with replacing(self.path) as temporary:
                temporary.write_bytes(content.getbuffer())
        except OSError as error:
            warn(
                f"checkpoint {self.path}",
                f"checkpoint: expected to write {self.path}, got: {error.strerror or error}; the fit goes on without",
            )


def traits(camera: Camera) -> tuple[Any, ...]:
    """Return all that a camera consists of, for Checkpoint."""
    return camera, camera.size, camera.projection, camera.lens


def _digest(value: Any) -> str:
    """Hash the tensors and plain values in it."""
    digest = hashlib.sha256()
    for part in _parts(value):
        digest.update(f"{len(part)}:".encode())  # so that 1, 23 and 12, 3 differ
        digest.update(part)
    return digest.hexdigest()


def _parts(value: Any) -> Any:
    if isinstance(value, float) and value.is_integer():
        value = int(value)  # 0 and 0.0 are the same
    if isinstance(value, (str, int, float, type(None))):
        yield repr(value).encode()
    elif isinstance(value, Mapping):
        for name in sorted(value):
            yield name.encode()
            yield from _parts(value[name])
    elif isinstance(value, Parameter):
        yield from _parts((value.lr, value.value, value.low, value.high, value.uniform))
    elif isinstance(value, Placement):
        yield from _parts((value.coordinates, value.start, value.center, value.size))
    elif isinstance(value, (tuple, list)):
        for part in value:
            yield from _parts(part)
    elif isinstance(value, np.ndarray):
        yield f"{value.dtype} {value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, torch.Tensor):
        yield f"{value.dtype} {tuple(value.shape)}".encode()
        yield value.detach().cpu().contiguous().numpy().tobytes()
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        yield type(value).__name__.encode()
        for field in dataclasses.fields(value):
            if field.name != "name":  # a mesh's name changes nothing
                yield field.name.encode()
                yield from _parts(getattr(value, field.name))
