"""Files in BOP's layout: results, and data sets that are rendered, to test methods or to learn from.

A result file is a CSV with a header and the columns scene_id, im_id, obj_id, score, R, t, time. R has 9 numbers by rows and t 3
in mm, separated by spaces. time is that of all estimates of an image together, in seconds, or −1 if it is unknown.
https://bop.felk.cvut.cz/challenges/bop-challenge-2019/#formatofresults
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ..camera.camera import Camera
from ..check import check_int
from ..files.image import srgb_to_linear, write_image
from ..files.paths import PathLike, check_readable, check_suffix, replacing, write_json
from ..files.save import save_mesh
from ..optional import require
from ..render import render
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from ..scene.symmetries import Symmetries
from .dataset import LEAST_VISIBLE, TARGETS
from .depth import depth_image
from .json_files import rigid

COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
DEPTH_SCALE = 0.1  # mm per level of the depth images, which reach 6.5 m


@dataclass(frozen=True, eq=False)
class Estimate:
    """A row of a result file."""

    scene_id: int
    im_id: int
    obj_id: int
    score: float
    pose: Tensor  # (4, 4) float64, mesh to camera, mm
    seconds: float = -1.0  # of all estimates of the image together; −1: unknown


def read_results(path: PathLike) -> list[Estimate]:
    """Return the rows in the order of the file. Raises FileNotFoundError, or ValueError that names file, line and column."""
    file = check_readable(path, (".csv",))
    found = []
    with file.open(newline="", encoding="utf-8-sig") as stream:
        for number, fields in enumerate(csv.reader(stream), 1):
            fields = [field.strip() for field in fields]
            if not any(fields) or (number == 1 and fields[0] == COLUMNS[0]):
                continue
            where = f"{path}, line {number}"
            if len(fields) != len(COLUMNS):
                raise ValueError(
                    f"{where}: expected {len(COLUMNS)} columns ({', '.join(COLUMNS)}), got {len(fields)}; part them by commas, "
                    "and the numbers of R and t by spaces"
                )
            row = dict(zip(COLUMNS, fields, strict=True))
            ids = [_id(where, name, row[name]) for name in COLUMNS[:3]]
            R = torch.tensor(_floats(where, "R", row["R"], 9), dtype=torch.float64).reshape(3, 3)
            t = torch.tensor(_floats(where, "t", row["t"], 3), dtype=torch.float64)
            (score,), (seconds,) = _floats(where, "score", row["score"], 1), _floats(where, "time", row["time"], 1)
            found.append(Estimate(ids[0], ids[1], ids[2], score, rigid(f"{where}, R", R, t), seconds))
    return found


def write_results(path: PathLike, estimates: Iterable[Estimate]) -> None:
    """Write rows as read_results reads them, to the last bit; the file is written whole or not at all. Raises ValueError or
    OSError."""
    file = check_suffix(path, (".csv",))
    with replacing(file) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(COLUMNS)
        for one in estimates:
            R, t = (" ".join(map(repr, part.flatten().tolist())) for part in (one.pose[:3, :3], one.pose[:3, 3]))
            writer.writerow(
                [one.scene_id, one.im_id, one.obj_id, repr(float(one.score)), R, t, repr(float(one.seconds))]
            )


def _id(where: str, name: str, text: str) -> int:
    if not text.isdecimal():
        raise ValueError(f"{where}, {name}: expected a whole number from 0 up, got {text!r}")
    return int(text)


def _floats(where: str, name: str, text: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in text.split()]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise ValueError(f"{where}, {name}: expected {count} finite number{'s' * (count > 1)}, got {text!r}")
    return values


@dataclass(frozen=True, eq=False)
class Shot:
    """An image to write.

    camera      pinhole camera at the origin, as Camera.from_opencv makes it of the identity, zeros and K
    objects     (obj_id, pose) of each instance; the pose (4, 4) is from the mesh to the camera, in mm
    picture     (H, W, C) linear radiance; None: the meshes are rendered with their colours
    background  radiance behind rendered meshes: one number, or a background of Scene
    """

    camera: Camera
    objects: Sequence[tuple[int, Tensor]]
    picture: Tensor | None = None
    background: Tensor | float = 0.5


def write_models(
    folder: PathLike, meshes: Mapping[int, Mesh], symmetries: Mapping[int, Symmetries] | None = None
) -> None:
    """Write models/obj_000001.ply … and models_info.json with boxes, diameters and symmetries, for meshes in mm by their ids.
    Missing folders are made. Raises TypeError, ValueError, OSError, or ImportError without SciPy."""
    info = {}
    for obj_id, mesh in meshes.items():
        check_int("obj_id", obj_id, 0, 999_999)
        save_mesh(Path(folder) / "models" / f"obj_{obj_id:06d}.ply", mesh)
        points = mesh.verts.detach().cpu().double()
        low, high = points.amin(0).tolist(), points.amax(0).tolist()
        box = {f"min_{axis}": value for axis, value in zip("xyz", low, strict=True)}
        box |= {f"size_{axis}": b - a for axis, a, b in zip("xyz", low, high, strict=True)}
        own = (symmetries or {}).get(obj_id, Symmetries())
        info[str(obj_id)] = {"diameter": _diameter(points.numpy()), **box, **own.to_bop()}
    write_json(Path(folder) / "models" / "models_info.json", info, indent=1)


def write_scene(
    folder: PathLike, scene_id: int, shots: Sequence[Shot], meshes: Mapping[int, Mesh], split: str = "test", spp: int = 64
) -> None:  # fmt: skip
    """Write SPLIT/000001/ with rgb/, depth/, mask/, mask_visib/, scene_camera.json, scene_gt.json and scene_gt_info.json.

    Images are numbered from 0; masks and depth are those at the pixels' centres. In a test split, test_targets_bop19.json gets
    the scene's targets, the instances that are visible by 10 % or more, in place of earlier ones of this scene. Raises
    TypeError, ValueError or OSError.
    """
    check_int("scene_id", scene_id, 0, 999_999)
    base = Path(folder) / split / f"{scene_id:06d}"
    cameras: dict[str, Any] = {}
    poses: dict[str, Any] = {}
    infos: dict[str, Any] = {}
    targets: list[dict[str, int]] = []
    for im_id, shot in enumerate(shots):
        for obj_id, _ in shot.objects:
            if obj_id not in meshes:
                raise ValueError(f"shots[{im_id}]: expected objects among {', '.join(map(str, meshes))}, got {obj_id}")
        depths = [depth_image(meshes[obj_id], pose.double(), shot.camera) for obj_id, pose in shot.objects]
        far = [torch.where(depth > 0, depth, torch.inf) for depth in depths]
        nearest = torch.stack([*far, torch.full(shot.camera.size, torch.inf, dtype=torch.float64)]).amin(0)
        K = shot.camera.K.double().clone()
        K[:2, 2] -= 0.5  # BOP's first pixel has its centre at 0
        cameras[str(im_id)] = {"cam_K": K.flatten().tolist(), "depth_scale": DEPTH_SCALE}
        poses[str(im_id)], infos[str(im_id)] = [], []
        seen: dict[int, int] = {}
        for i, (obj_id, pose) in enumerate(shot.objects):
            mask = depths[i] > 0
            visible = mask & (far[i] <= nearest)
            share = float(visible.sum()) / max(1, int(mask.sum()))
            poses[str(im_id)].append(
                {
                    "cam_R_m2c": pose[:3, :3].double().flatten().tolist(), "cam_t_m2c": pose[:3, 3].double().tolist(),
                    "obj_id": obj_id,
                }
            )  # fmt: skip
            infos[str(im_id)].append(
                {
                    "bbox_obj": _box(mask), "bbox_visib": _box(visible), "px_count_all": int(mask.sum()),
                    "px_count_valid": int(mask.sum()), "px_count_visib": int(visible.sum()), "visib_fract": share,
                }
            )  # fmt: skip
            for kind, area in (("mask", mask), ("mask_visib", visible)):
                write_image(base / kind / f"{im_id:06d}_{i:06d}.png", srgb_to_linear(area.float()))
            if share >= LEAST_VISIBLE:
                seen[obj_id] = seen.get(obj_id, 0) + 1
        targets += [
            {"scene_id": scene_id, "im_id": im_id, "obj_id": o, "inst_count": n} for o, n in sorted(seen.items())
        ]
        picture = shot.picture if shot.picture is not None else _rendered(shot, meshes, spp)
        write_image(base / "rgb" / f"{im_id:06d}.png", picture)
        _write_depth(base / "depth" / f"{im_id:06d}.png", torch.where(torch.isfinite(nearest), nearest, 0.0))
    for name, content in (("scene_camera", cameras), ("scene_gt", poses), ("scene_gt_info", infos)):
        write_json(base / f"{name}.json", content, indent=1)
    if not split.startswith("test"):
        return
    file = Path(folder) / TARGETS
    others = json.loads(file.read_text(encoding="utf-8")) if file.exists() else []
    write_json(file, [one for one in others if one["scene_id"] != scene_id] + targets, indent=1)


def _rendered(shot: Shot, meshes: Mapping[int, Mesh], spp: int) -> Tensor:
    placed = [meshes[obj_id].transformed(pose[:3, :3], pose[:3, 3]) for obj_id, pose in shot.objects]
    channels = max([mesh.channels or 3 for mesh in placed], default=3)
    background = torch.as_tensor(shot.background, dtype=torch.float32)
    if background.dim() == 0:
        background = background.expand(channels)
    if not placed:
        return background.expand(*shot.camera.size, channels)
    return render(Scene(placed, background=background), shot.camera, spp=spp, seed=0)


def _diameter(points: np.ndarray) -> float:
    """Return the largest distance between two points, which are corners of their convex hull."""
    spatial: Any = require("scipy.spatial", "edgegrad[fit]", "diameters")
    with suppress(spatial.QhullError):  # flat, or fewer than four
        points = points[spatial.ConvexHull(points).vertices]
    return float(max(np.linalg.norm(points - point, axis=1).max() for point in points))


def _box(area: Tensor) -> list[int]:
    """Return x, y, width and height."""
    if not bool(area.any()):
        return [-1, -1, -1, -1]
    rows, columns = area.any(1).nonzero()[:, 0], area.any(0).nonzero()[:, 0]
    x, y = int(columns[0]), int(rows[0])
    return [x, y, int(columns[-1]) - x, int(rows[-1]) - y]


def _write_depth(path: Path, depth: Tensor) -> None:
    """Write 16 bits in one channel."""
    oiio: Any = require("OpenImageIO", "OpenImageIO", "writing images")
    steps = (depth / DEPTH_SCALE).round()
    if float(steps.max()) > 65535:
        raise ValueError(
            f"{path}: expected depths up to {65535 * DEPTH_SCALE:.0f} mm, got {float(depth.max()):.0f}; are the meshes in mm?"
        )
    values = np.ascontiguousarray(steps.numpy().astype(np.uint16)[..., None])
    with replacing(path) as temporary:
        image = oiio.ImageBuf(oiio.ImageSpec(values.shape[1], values.shape[0], 1, oiio.UINT16))
        image.set_pixels(oiio.ROI(), values)
        if not image.write(str(temporary)):
            raise OSError(f"{path}: expected to write it, got: {image.geterror()}")
