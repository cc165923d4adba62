"""A data set in BOP's layout, read as it is asked for.

    DATASET/models/models_info.json, obj_000001.ply …           millimetres; diameter and symmetries
    DATASET/models_eval/…                                       likewise, coarser: of these are errors measured
    DATASET/test_targets_bop19.json                             which objects are to be found where
    DATASET/SPLIT/000001/scene_camera.json                      K and the scale of depth, by image
    DATASET/SPLIT/000001/scene_gt.json, scene_gt_info.json      poses, and how much is seen of each, by image
    DATASET/SPLIT/000001/rgb/000000.png (or gray/, .jpg, .tif), depth/000000.png, mask/000000_000000.png, mask_visib/…

https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..files.formats.part import Wanted, naming
from ..files.image import read_image, read_size, read_stored
from ..files.load import load_mesh
from ..files.mask import read_mask
from ..files.parts import read_model
from ..files.paths import PathLike
from ..scene.mesh import Mesh
from ..scene.symmetries import Symmetries
from .json_files import by_number, listed, numbers, read_json, rigid

TARGETS = "test_targets_bop19.json"
INFO, EVALUATION = "models_info.json", "models_eval"
PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")
LEAST_VISIBLE = 0.1  # BOP19's targets are objects of which so much is seen
KEPT = 4  # scenes whose files stay in memory; each may have thousands of poses
ROUNDED = 1e-2  # how far R Rᵀ may be from 1 in files


class Target(NamedTuple):
    """What is to be found: how many instances of an object in an image."""

    scene_id: int
    im_id: int
    obj_id: int
    instances: int


@dataclass(frozen=True, eq=False)
class Truth:
    """An instance of an object in an image, as scene_gt.json has it."""

    index: int  # its place in the image's list, by which masks are named
    obj_id: int
    pose: Tensor  # (4, 4) float64, mesh to camera, mm
    visible: float | None  # the share of its silhouette that is seen, 0 … 1; None without scene_gt_info.json


class Model:
    """An object: its mesh in millimetres, its diameter and its symmetries.

    obj_id; path of its PLY; diameter in mm, the largest distance between two vertices; symmetries
    """

    def __init__(self, obj_id: int, path: Path, info: dict[str, Any], where: str) -> None:
        self.obj_id, self.path = obj_id, path
        self.diameter = float(numbers(where, info, "diameter"))
        try:
            self.symmetries = Symmetries.from_bop(info)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{where}: {error}") from None

    @cached_property
    def mesh(self) -> Mesh:
        """With its colours or texture, as radiance. Read once. Raises what load_mesh raises."""
        return load_mesh(self.path)

    @cached_property
    def points(self) -> Tensor:
        """(N, 3) float64, mm: the vertices as the file has them, also where it repeats one, for means over them. Raises what
        load_mesh raises."""
        with naming(self.path):
            model = read_model(self.path, Wanted(materials=False))
        return torch.cat([torch.from_numpy(part.verts).double() for part in model.parts])

    def __repr__(self) -> str:
        return f"Model({self.obj_id}, diameter {self.diameter:.4g} mm, {self.symmetries!r})"


class Frame:
    """An image of a scene: what is known of it, and its files, read when they are asked for.

    scene_id, im_id; truths: the instances in it, in the order of scene_gt.json
    """

    def __init__(self, scene: _Scene, im_id: int) -> None:
        self._scene, self.scene_id, self.im_id = scene, scene.scene_id, im_id
        path = scene.folder / "scene_camera.json"
        if im_id not in scene.cameras:
            raise ValueError(f"{path}: expected image {im_id} in it, got {listed(scene.cameras)}; choose one of these")
        self._where, self._camera = f"{path}, image {im_id}", scene.cameras[im_id]

    @property
    def K(self) -> Tensor:
        """(3, 3) float64 as the file has it: the centre of the first pixel at (0, 0)."""
        return numbers(self._where, self._camera, "cam_K", 3, 3)

    @cached_property
    def camera(self) -> Camera:
        """At the origin, looking along +Z, in float64: poses are from the mesh to it. Its size is that of the picture."""
        one = torch.eye(3, dtype=torch.float64)
        return Camera.from_opencv(one, one.new_zeros(3), self.K, read_size(self.picture_path))

    @cached_property
    def truths(self) -> list[Truth]:
        """Raises FileNotFoundError where the split has no public poses."""
        return self._scene.truths(self.im_id)

    def truths_of(self, obj_id: int) -> list[Truth]:
        """Of one object."""
        return [truth for truth in self.truths if truth.obj_id == obj_id]

    @property
    def picture_path(self) -> Path:
        """Of the colour image, or else the grey one, or else the depth image. Raises FileNotFoundError."""
        return self._file(("rgb", "gray", "depth"), f"{self.im_id:06d}")

    def picture(self) -> Tensor:
        """(H, W, 3) linear radiance, also of a grey image. Raises FileNotFoundError, or what read_image raises."""
        return read_image(self._file(("rgb", "gray"), f"{self.im_id:06d}"), channels=3)

    def depth(self) -> Tensor:
        """(H, W) float64 along the optical axis, mm; 0 where the sensor measured none. Raises FileNotFoundError or ValueError."""
        path = self._file(("depth",), f"{self.im_id:06d}")
        color, _, largest = read_stored(path)
        if largest is None or color.shape[-1] != 1:
            raise ValueError(f"{path}: expected depth as whole numbers in one channel, got something else")
        scale = float(numbers(self._where, self._camera, "depth_scale"))
        return (color[..., 0].double() * largest).round() * scale

    def mask(self, index: int) -> Tensor:
        """(H, W), 1 on the silhouette of truths[index], also where something covers it. Raises FileNotFoundError."""
        return read_mask(self._file(("mask",), f"{self.im_id:06d}_{index:06d}"))

    def mask_visible(self, index: int) -> Tensor:
        """(H, W), 1 where truths[index] is seen. Raises FileNotFoundError."""
        return read_mask(self._file(("mask_visib",), f"{self.im_id:06d}_{index:06d}"))

    def _file(self, folders: tuple[str, ...], name: str) -> Path:
        for folder in folders:
            for suffix in PICTURES:
                if (path := self._scene.folder / folder / (name + suffix)).is_file():
                    return path
        raise FileNotFoundError(
            f"{self._scene.folder}: expected {name}.png (or .jpg, .tif) in {' or '.join(folders)}, got no such file; "
            "download the images of this split"
        )

    def __repr__(self) -> str:
        return f"Frame(scene {self.scene_id}, image {self.im_id})"


class _Scene:
    """The JSON files of a scene."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.scene_id = folder, int(folder.name)

    @cached_property
    def cameras(self) -> dict[int, Any]:
        path = self.folder / "scene_camera.json"
        return by_number(path, read_json(path, dict))

    @cached_property
    def _poses(self) -> dict[int, Any]:
        path = self.folder / "scene_gt.json"
        if not path.exists():
            raise FileNotFoundError(
                f"{path}: expected the poses of the objects, got no such file; some test splits keep them secret: take another "
                "split, such as val"
            )
        return by_number(path, read_json(path, dict))

    @cached_property
    def _info(self) -> dict[int, Any] | None:
        path = self.folder / "scene_gt_info.json"
        return by_number(path, read_json(path, dict)) if path.exists() else None

    def truths(self, im_id: int) -> list[Truth]:
        path = self.folder / "scene_gt.json"
        if im_id not in self._poses:
            raise ValueError(f"{path}: expected image {im_id} in it, got {listed(self._poses)}; choose one of these")
        info = None if self._info is None else self._info.get(im_id)
        found = []
        for i, entry in enumerate(self._poses[im_id]):
            where = f"{path}, image {im_id}, entry {i}"
            R, t = numbers(where, entry, "cam_R_m2c", 3, 3), numbers(where, entry, "cam_t_m2c", 3)
            visible = None
            if info is not None and i < len(info):
                at = f"{self.folder / 'scene_gt_info.json'}, image {im_id}, entry {i}"
                visible = float(numbers(at, info[i], "visib_fract"))
            obj_id = int(numbers(where, entry, "obj_id"))
            found.append(Truth(i, obj_id, rigid(f"{where}, cam_R_m2c", R, t, ROUNDED), visible))
        return found


class Dataset:
    """A data set in a folder. Nothing but names of folders is read before it is asked for.

    folder  with models/ and one folder a split
    split   its name, such as "test", "val" or "train_pbr"; when None "test", or the only one that begins with it, or the only one
    models  the folder of meshes, such as "models_cad" or "models_reconst" of T-LESS; when None "models", or the only one but
            "models_eval"

    Raises FileNotFoundError or ValueError that names what is missing and lists what is there; so does what is asked for later.
    """

    def __init__(self, folder: PathLike, split: str | None = None, models: str | None = None) -> None:
        self.folder = Path(folder)
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{folder}: expected the folder of a BOP data set, got no such folder")
        splits = sorted(
            path.name for path in self.folder.iterdir() if path.is_dir() and any(_scene_folders(path))
        )  # fmt: skip
        tests = [name for name in splits if name.startswith("test")]
        chosen = split or ("test" if "test" in tests else next(iter(tests if len(tests) == 1 else splits), ""))
        if chosen not in splits or (split is None and chosen not in tests and len(splits) > 1):
            if not splits:
                raise ValueError(
                    f"{folder}: expected folders of splits, such as test/000001/scene_camera.json, got none; is it the folder "
                    "that has models/ in it?"
                )
            wish = f"the split {split!r}" if split else "the name of a split"
            raise ValueError(f"{folder}: expected {wish}, got {', '.join(splits)}; name one of these")
        self.split, self._models_name = chosen, models
        self._paths = {int(path.name): path for path in _scene_folders(self.folder / chosen)}
        self._scenes: dict[int, _Scene] = {}
        self._models: dict[tuple[int, bool], Model] = {}

    # -- objects ----------------------------------------------------------------------------------------------------------

    @cached_property
    def objects(self) -> list[int]:
        """Ids of the objects in models/models_info.json."""
        return sorted(self._model_infos(self._models_folder(False)))

    def model(self, obj_id: int, evaluation: bool = False) -> Model:
        """An object; with `evaluation` from models_eval/, if there is such a folder. Raises ValueError that lists the objects."""
        if (obj_id, evaluation) not in self._models:
            folder = self._models_folder(evaluation)
            infos, path = self._model_infos(folder), folder / INFO
            if obj_id not in infos:
                raise ValueError(f"{path}: expected object {obj_id} in it, got {listed(infos)}; choose one of these")
            ply = folder / f"obj_{obj_id:06d}.ply"
            self._models[obj_id, evaluation] = Model(obj_id, ply, infos[obj_id], f"{path}, object {obj_id}")
        return self._models[obj_id, evaluation]

    def _models_folder(self, evaluation: bool) -> Path:
        """Raises FileNotFoundError that lists what is there."""
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
        """Ids of the split's scenes."""
        return sorted(self._paths)

    def images(self, scene_id: int) -> list[int]:
        """Ids of a scene's images. Raises ValueError."""
        return sorted(self._scene(scene_id).cameras)

    def frame(self, scene_id: int, im_id: int) -> Frame:
        """Raises ValueError that lists the scenes, or the images."""
        return Frame(self._scene(scene_id), im_id)

    def _scene(self, scene_id: int) -> _Scene:
        if scene_id not in self._paths:
            raise ValueError(
                f"{self.folder / self.split}: expected scene {scene_id}, got {listed(self._paths)}; choose one of these"
            )
        scene = self._scenes.pop(scene_id, None) or _Scene(self._paths[scene_id])
        self._scenes[scene_id] = scene  # the last one used stands last
        while len(self._scenes) > KEPT:
            del self._scenes[next(iter(self._scenes))]
        return scene

    # -- what is to be found ------------------------------------------------------------------------------------------------

    def targets(self, file: str = TARGETS) -> list[Target]:
        """Those of a file beside the splits; without it, all instances of which at least 10 % are seen, as BOP19 chose them.
        Only of the scenes of this split. Raises ValueError."""
        path = self.folder / file
        if path.exists():
            entries = read_json(path, list)
            found = []
            for i, entry in enumerate(entries):
                ids = [
                    int(numbers(f"{path}, entry {i}", entry, key))
                    for key in ("scene_id", "im_id", "obj_id", "inst_count")
                ]
                found.append(Target(*ids))
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
