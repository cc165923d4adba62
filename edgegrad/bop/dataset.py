"""Data sets in BOP's layout, whose files are read when they are asked for.

    DATASET/models/models_info.json, obj_000001.ply …           millimetres; diameter and symmetries
    DATASET/models_eval/…                                       likewise, coarser: errors are measured on these
    DATASET/test_targets_bop19.json                             which objects are to be found where
    DATASET/SPLIT/000001/scene_camera.json                      K and the scale of depth, by image
    DATASET/SPLIT/000001/scene_gt.json, scene_gt_info.json      poses, and the visible share of each, by image
    DATASET/SPLIT/000001/rgb/000000.png (or gray/, .jpg, .tif), depth/000000.png, mask/000000_000000.png, mask_visib/…

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from ..files.paths import PathLike
from .frame import Frame, SceneFiles
from .json_files import by_number, listed, numbers, read_json
from .model import Model

TARGETS = "test_targets_bop19.json"
INFO, EVALUATION = "models_info.json", "models_eval"
LEAST_VISIBLE = 0.1  # visible share of BOP19's targets
KEPT_SCENES = 4  # whose files stay in memory; each may have thousands of poses


class Target(NamedTuple):
    """A number of instances of an object to find in an image."""

    scene_id: int
    im_id: int
    obj_id: int
    instances: int


class Dataset:
    """A data set in a folder, whose files are read when they are asked for.

    Parameters
    ----------
    folder : str or Path
        With models/ and one folder for each split.
    split : str, default "test", or the only one that begins with it, or the only one
        Name, such as "test", "val" or "train_pbr".
    models : str, default "models", or the only one but "models_eval"
        Folder of meshes, such as "models_cad" or "models_reconst" of T-LESS.

    Raises
    ------
    FileNotFoundError, ValueError
        The message names what is missing and lists what is there.
    """

    def __init__(self, folder: PathLike, split: str | None = None, models: str | None = None) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected the folder of a BOP data set, got no such folder")
        self.split, self._models_name = self._chosen(split), models
        self._paths = {int(path.name): path for path in _scene_folders(self.folder / self.split)}
        self._scenes: dict[int, SceneFiles] = {}
        self._models: dict[tuple[int, bool], Model] = {}

    def _chosen(self, split: str | None) -> str:
        """Return the name of a split. Raises ValueError that lists them."""
        names = sorted(path.name for path in self.folder.iterdir() if path.is_dir() and _scene_folders(path))
        if not names:
            raise ValueError(
                f"{self.folder}: expected folders of splits, such as test/000001/scene_camera.json, got none; is it the folder "
                "that has models/ in it?"
            )
        if split is not None:
            if split not in names:
                raise ValueError(
                    f"{self.folder}: expected the split {split!r}, got {', '.join(names)}; name one of these"
                )
            return split
        tests = [name for name in names if name.startswith("test")]
        for some in (["test"] if "test" in names else [], tests, names):
            if len(some) == 1:
                return some[0]
        raise ValueError(f"{self.folder}: expected the name of a split, got {', '.join(names)}; name one of these")

    # -- objects ----------------------------------------------------------------------------------------------------------

    @cached_property
    def objects(self) -> list[int]:
        """Return the ids of the objects in models/models_info.json."""
        return sorted(self._model_infos(self._models_folder(False)))

    def model(self, obj_id: int, evaluation: bool = False) -> Model:
        """Return an object; with `evaluation` from models_eval/, if that exists. Raises ValueError that lists the objects."""
        if (obj_id, evaluation) not in self._models:
            folder = self._models_folder(evaluation)
            infos, path = self._model_infos(folder), folder / INFO
            if obj_id not in infos:
                raise ValueError(f"{path}: expected object {obj_id} in it, got {listed(infos)}; choose one of these")
            ply = folder / f"obj_{obj_id:06d}.ply"
            self._models[obj_id, evaluation] = Model(obj_id, ply, infos[obj_id], f"{path}, object {obj_id}")
        return self._models[obj_id, evaluation]

    def _models_folder(self, evaluation: bool) -> Path:
        """Return the folder of meshes. Raises FileNotFoundError that lists what is there."""
        if evaluation and (self.folder / EVALUATION).is_dir():
            return self.folder / EVALUATION
        names = sorted(path.parent.name for path in self.folder.glob(f"*/{INFO}"))
        others = [name for name in names if name != EVALUATION]
        chosen = self._models_name or ("models" if "models" in others or len(others) != 1 else others[0])
        if chosen not in names:
            raise FileNotFoundError(
                f"{self.folder}: expected {chosen}/{INFO}, got {', '.join(names) or 'no folder with such a file'}; download the "
                "models, or name their folder by models="
            )
        return self.folder / chosen

    def _model_infos(self, folder: Path) -> dict[int, Any]:
        path = folder / INFO
        return by_number(path, read_json(path, dict))

    # -- images -----------------------------------------------------------------------------------------------------------

    @property
    def scenes(self) -> list[int]:
        """Return the ids of the split's scenes."""
        return sorted(self._paths)

    def images(self, scene_id: int) -> list[int]:
        """Return the ids of a scene's images. Raises ValueError."""
        return sorted(self._scene(scene_id).cameras)

    def frame(self, scene_id: int, im_id: int) -> Frame:
        """Return an image. Raises ValueError that lists the scenes, or the images."""
        return Frame(self._scene(scene_id), im_id)

    def _scene(self, scene_id: int) -> SceneFiles:
        if scene_id not in self._paths:
            raise ValueError(
                f"{self.folder / self.split}: expected scene {scene_id}, got {listed(self._paths)}; choose one of these"
            )
        scene = self._scenes.pop(scene_id, None) or SceneFiles(self._paths[scene_id])
        self._scenes[scene_id] = scene  # the last one used stands last
        while len(self._scenes) > KEPT_SCENES:
            del self._scenes[next(iter(self._scenes))]
        return scene

    # -- targets ------------------------------------------------------------------------------------------------------------

    def targets(self, file: str = TARGETS) -> list[Target]:
        """Return the targets of a file in the data set's folder, which lists those of test splits.

        Without the file, or for another split, these are all instances of which at least 10 % are visible, as BOP19 chose them.
        Raises FileNotFoundError or ValueError.
        """
        path = self.folder / file
        if path.exists() and (file != TARGETS or self.split.startswith("test")):
            keys = "scene_id", "im_id", "obj_id", "inst_count"
            found = [
                Target(*(int(numbers(f"{path}, entry {i}", entry, key)) for key in keys))
                for i, entry in enumerate(read_json(path, list))
            ]
            return [target for target in found if target.scene_id in self._paths]
        if file != TARGETS:
            raise FileNotFoundError(f"{path}: expected a list of targets, got no such file; leave out its name")
        counts: dict[tuple[int, int, int], int] = {}
        for scene_id in self.scenes:
            for im_id in self.images(scene_id):
                for truth in self.frame(scene_id, im_id).truths:
                    if truth.visible is None or truth.visible >= LEAST_VISIBLE:
                        key = scene_id, im_id, truth.obj_id
                        counts[key] = counts.get(key, 0) + 1
        return [Target(*key, count) for key, count in sorted(counts.items())]

    def __repr__(self) -> str:
        return f"Dataset({str(self.folder)!r}, split {self.split!r}, {len(self._paths)} scenes)"


def _scene_folders(folder: Path) -> list[Path]:
    return [path for path in folder.iterdir() if path.name.isdecimal() and (path / "scene_camera.json").is_file()]
