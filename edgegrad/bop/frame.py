"""An image of a scene: its camera, the poses in it, and its files."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ..camera.camera import Camera
from ..files.image import read_image, read_size, read_stored
from ..files.mask import read_mask
from ..files.paths import StoredPath
from .json_files import by_number, listed, numbers, read_json, rigid

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


@dataclass(frozen=True, eq=False)
class Truth:
    """An instance of an object in an image, as scene_gt.json has it."""

    index: int  # position in the image's list, by which masks are named
    obj_id: int
    pose: Tensor  # (4, 4) float64, mesh to camera, mm
    visible: float | None  # visible share of the silhouette, 0 … 1; None without scene_gt_info.json


class Frame:
    """An image of a scene, whose files are read when they are asked for.

    Attributes
    ----------
    scene_id, im_id : int
        Numbers of scene and image.
    truths : list of Truth
        The instances in it, in the order of scene_gt.json.
    """

    def __init__(self, scene: SceneFiles, im_id: int) -> None:
        self._scene, self.scene_id, self.im_id = scene, scene.scene_id, im_id
        path = scene.folder / "scene_camera.json"
        if im_id not in scene.cameras:
            raise ValueError(f"{path}: expected image {im_id} in it, got {listed(scene.cameras)}; choose one of these")
        self._where, self._camera = f"{path}, image {im_id}", scene.cameras[im_id]

    @property
    def K(self) -> Tensor:
        """Return K (3, 3) float64 as the file has it: the centre of the first pixel is at (0, 0)."""
        return numbers(self._where, self._camera, "cam_K", 3, 3)

    @cached_property
    def camera(self) -> Camera:
        """Return the camera at the origin, looking along +Z, in float64, for poses from the mesh to it, of the picture's size."""
        one = torch.eye(3, dtype=torch.float64)
        return Camera.from_opencv(one, one.new_zeros(3), self.K, read_size(self.picture_path))

    @cached_property
    def truths(self) -> list[Truth]:
        """Return the instances in the image. Raises FileNotFoundError if the split has no public poses."""
        return self._scene.truths(self.im_id)

    def truths_of(self, obj_id: int) -> list[Truth]:
        """Return the instances of one object."""
        return [truth for truth in self.truths if truth.obj_id == obj_id]

    @property
    def picture_path(self) -> Path:
        """Return the path of the colour image, or else of the grey one, or else of the depth image. Raises FileNotFoundError."""
        return self._file(("rgb", "gray", "depth"), f"{self.im_id:06d}")

    def picture(self) -> Tensor:
        """Return (H, W, 3) linear radiance, also of a grey image. Raises FileNotFoundError, or what read_image raises."""
        return read_image(self._file(("rgb", "gray"), f"{self.im_id:06d}"), channels=3)

    def depth(self) -> Tensor:
        """Return (H, W) float64 along the optical axis in mm, 0 where nothing was measured.

        Raises FileNotFoundError or ValueError.
        """
        path = self._file(("depth",), f"{self.im_id:06d}")
        color, _, largest = read_stored(path)
        if largest is None or color.shape[-1] != 1:
            raise ValueError(f"{path}: expected depth as whole numbers in one channel, got something else")
        scale = float(numbers(self._where, self._camera, "depth_scale"))
        return (color[..., 0].double() * largest).round() * scale

    def mask(self, index: int) -> Tensor:
        """Return (H, W), 1 on the silhouette of truths[index], also where it is covered. Raises FileNotFoundError."""
        return read_mask(self._file(("mask",), f"{self.im_id:06d}_{index:06d}"))

    def mask_visible(self, index: int) -> Tensor:
        """Return (H, W), 1 where truths[index] is visible. Raises FileNotFoundError."""
        return read_mask(self._file(("mask_visib",), f"{self.im_id:06d}_{index:06d}"))

    def _file(self, folders: tuple[str, ...], name: str) -> Path:
        for folder in folders:
            for suffix in PICTURES:
                if (path := self._scene.folder / folder / (name + suffix)).is_file():
                    return StoredPath(path)  # K and poses refer to stored pixels
        raise FileNotFoundError(
            f"{self._scene.folder}: expected {name}.png (or .jpg, .tif) in {' or '.join(folders)}, got no such file; "
            "download the images of this split"
        )

    def __repr__(self) -> str:
        return f"Frame(scene {self.scene_id}, image {self.im_id})"


class SceneFiles:
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
            found.append(Truth(i, obj_id, rigid(f"{where}, cam_R_m2c", R, t), visible))
        return found
