"""Real photographs with meshes, cameras and poses, from a folder, whose cameras are OpenCV's (x right, y down, z forward,
pixels, X_cam = R X + t):

    squirrel/frame.png, squirrel_demo_low.obj (mm, without colours), camera_and_init.json: K, cam_R_model_init,
        cam_t_model_init_mm, mesh_centre_to_subtract_mm
    gelatin_box/000001-color.png, 000001-depth.png (16 bits, 0.1 mm), 009_gelatin_box_textured.gltf (m),
        009_gelatin_box_tex1024.png, reference.json: {"009_gelatin_box": K, cam_R_mesh, cam_t_mesh_m}
    cracker_box/image_rgb.png, 003_cracker_box_textured.gltf (m), 003_cracker_box_tex1024.png, reference.json: K, a start
        cam_R_bop, cam_t_bop_m, and gltf_to_bop_R, gltf_to_bop_t_m
    bottle/_sequence/color_camera_image_200.png, …_201.png, depth_camera_image_200.png, …_201.png, depth_camera.yaml (of M3T),
        bottle/_body/schauma.obj (m), reference.json: K, {"schauma": cam_R_body, cam_t_body_m, geometry_offset_z_m}
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenImageIO as oiio
import torch
import yaml
from torch import Tensor

import edgegrad as eg

from .cases import Case, Placed
from .objects import textured

JUMP = 0.02  # of the depth: neighbours that are farther apart do not lie on one surface
WHOLE = 0.99  # share of a pixel that depth must cover


def squirrel(folder: Path) -> Case:
    """`truth` is the start that comes with it."""
    known = _json(folder / "squirrel" / "camera_and_init.json")
    mesh = eg.load_mesh(folder / "squirrel" / "squirrel_demo_low.obj")
    mesh = mesh.replace(verts=mesh.verts - torch.tensor(known["mesh_centre_to_subtract_mm"]).to(mesh.verts))
    start = _placed(known["cam_R_model_init"], known["cam_t_model_init_mm"])
    return _case("squirrel", mesh, folder / "squirrel" / "frame.png", known["K"], start)


def gelatin_box(folder: Path, with_depth: bool) -> Case:
    place = folder / "gelatin_box"
    known = _json(place / "reference.json")["009_gelatin_box"]
    mesh = textured(place / "009_gelatin_box_textured.gltf", place / "009_gelatin_box_tex1024.png")
    truth = _placed(known["cam_R_mesh"], known["cam_t_mesh_m"])
    depth = _integers(place / "000001-depth.png") / 10000.0 if with_depth else None
    return _case("gelatin box", mesh, place / "000001-color.png", known["K"], truth, depth)


def cracker_box(folder: Path) -> Case:
    """`truth` is the start that comes with it."""
    place = folder / "cracker_box"
    known = _json(place / "reference.json")
    mesh = textured(place / "003_cracker_box_textured.gltf", place / "003_cracker_box_tex1024.png")
    R, t = torch.tensor(known["cam_R_bop"]).double(), torch.tensor(known["cam_t_bop_m"]).double()
    inner, shift = torch.tensor(known["gltf_to_bop_R"]).double(), torch.tensor(known["gltf_to_bop_t_m"]).double()
    return _case("cracker box", mesh, place / "image_rgb.png", known["K"], Placed(R @ inner, R @ shift + t))


def bottle(folder: Path, frame: int, with_depth: bool) -> Case:
    place = folder / "bottle"
    known = _json(place / "reference.json")
    mesh = eg.load_mesh(place / "_body" / "schauma.obj")
    mesh = mesh.replace(verts=mesh.verts + torch.tensor([0.0, 0.0, known["schauma"]["geometry_offset_z_m"]]))
    truth = _placed(known["schauma"]["cam_R_body"], known["schauma"]["cam_t_body_m"])
    case = _case("bottle", mesh, place / "_sequence" / f"color_camera_image_{frame}.png", known["K"], truth)
    if not with_depth:
        return case
    metres, pose, K = _depth_camera(place / "_sequence", frame)
    return replace(case, depth=reprojected(metres, K, pose, case.camera))


def reprojected(depth: Tensor, K: Tensor, to_world: Tensor, camera: eg.Camera) -> Tensor:
    """Return depth (H, W) seen by `camera` from depth (h, w) of an OpenCV camera K at `to_world` (4, 4); NaN where unknown.

    Neighbouring measurements that lie on one surface are the corners of triangles, which are rendered from where `camera` is: so
    what is hidden from there is hidden, and every pixel has its depth, whichever camera has the more of them.
    """
    h, w = depth.shape
    v, u = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    rays = torch.stack([(u - 0.5 - K[0, 2]) / K[0, 0], (v - 0.5 - K[1, 2]) / K[1, 1], torch.ones_like(u)], -1)
    points = (rays * depth[..., None]).reshape(-1, 3).double() @ to_world[:3, :3].T + to_world[:3, 3]
    at = torch.arange(h * w).reshape(h, w)
    corners = torch.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]], -1).reshape(-1, 4)
    near, far = depth.flatten()[corners].aminmax(dim=1)
    corners = corners[(near > 0.0) & (far < (1.0 + JUMP) * near)]
    faces = torch.cat([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])
    seen = eg.render_aovs(eg.Mesh(points.float(), faces), camera, ["depth", "alpha"], spp=4)
    return torch.where(seen["alpha"] > WHOLE, seen["depth"] / seen["alpha"], torch.nan)[..., 0]


def _depth_camera(place: Path, frame: int) -> tuple[Tensor, Tensor, Tensor]:
    """Depth (h, w) in metres, camera to world (4, 4), and K."""
    # OpenCV's files name a version and a tag that YAML does not have.
    text = (place / "depth_camera.yaml").read_text().replace("%YAML:1.2", "").replace("!!opencv-matrix", "")
    known: dict[str, Any] = yaml.safe_load(text)
    lens = known["intrinsics"]
    K = torch.tensor([[lens["f_u"], 0.0, lens["pp_x"]], [0.0, lens["f_v"], lens["pp_y"]], [0.0, 0.0, 1.0]])
    pose = torch.tensor(known["camera2world_pose"]["data"], dtype=torch.float64).reshape(4, 4)
    return _integers(place / f"depth_camera_image_{frame}.png") * known["depth_scale"], pose, K


def _case(name: str, mesh: eg.Mesh, picture: Path, K: Any, truth: Placed, depth: Tensor | None = None) -> Case:
    image = eg.read_image(picture, channels=3)
    H, W = image.shape[:2]
    camera = eg.Camera.from_opencv(torch.eye(3), torch.zeros(3), torch.tensor(K), (H, W))
    return Case(name, mesh, image, camera, truth, depth=depth, real=True)


def _integers(path: Path) -> Tensor:
    """Return an image (H, W) of 16 bits as its integers."""
    pixels = oiio.ImageBuf(str(path)).get_pixels(oiio.UINT16)
    assert pixels is not None
    return torch.from_numpy(pixels[..., 0].astype(np.float32))


def _placed(R: Any, t: Any) -> Placed:
    return Placed(torch.tensor(R).double(), torch.tensor(t).double())


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))
