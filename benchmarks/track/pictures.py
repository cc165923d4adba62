"""Pictures of the worst frames of films."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image, ImageDraw, ImageFont

import edgegrad as eg
from benchmarks.poses.runs import outline

from .films import Film
from .measures import RIGHT, Record

TRUTH, FOUND = (0, 220, 30), (255, 230, 0)  # colours of contours, sRGB
ZOOM = 2
TITLE = 28  # pixels


def worst(record: Record) -> int:
    """Return the frame with the largest error relative to RIGHT, of those not said to be lost; of all if they all are."""
    errors = np.maximum(np.array(record["degrees"]) / RIGHT[0], np.array(record["shift"]) / RIGHT[1])
    lost = np.array(record["lost"], dtype=bool)
    return int(np.argmax(np.where(lost & ~lost.all(), -1.0, errors)))


def draw(folder: Path, film: Film, record: Record) -> Path:
    """Write the worst frame with contours of the true pose (green) and of the tracker's (yellow)."""
    k, n = worst(record), record["object"]
    camera = film.camera.resized((ZOOM * film.camera.size[0], ZOOM * film.camera.size[1]))
    found = np.vstack([np.array(record["poses"][k]).reshape(3, 4), [0.0, 0.0, 0.0, 1.0]])
    picture = torch.from_numpy(film.frame(k)).movedim(-1, 0)[None].float()
    picture = F.interpolate(picture, scale_factor=float(ZOOM))[0].movedim(0, -1)
    for pose, colour in ((film.poses[k, n], TRUTH), (found, FOUND)):
        on = outline(_alpha(film.meshes[n], pose, camera))
        picture = torch.where(on, torch.tensor(colour).float(), picture)
    title = (
        f"{record['kind']} {record['seed']}, {record['mesh']}, frame {k}: {record['degrees'][k]:.2f}°, "
        f"{record['shift'][k]:.2%}{', lost' if record['lost'][k] else ''}, {record['visible'][k]:.0%} visible"
    )
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + TITLE), "white")
    image.paste(Image.fromarray(picture.round().byte().numpy()), (0, TITLE))
    ImageDraw.Draw(image).text((6, 4), title, fill="black", font=ImageFont.load_default(size=18))
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{record['kind']}-{record['seed']}-{n}-{record['mesh']}.png"
    image.save(path)
    return path


def _alpha(mesh: eg.Mesh, pose: np.ndarray, camera: eg.Camera) -> torch.Tensor:
    """Return the silhouette (H, W) of a mesh at a pose; empty where the tracker's pose is behind the camera."""
    M = torch.tensor(pose).float()
    placed = mesh.transformed(M[:3, :3], M[:3, 3])
    return eg.render_aovs(eg.Mesh(placed.verts, placed.faces), camera, ["alpha"], 16, seed=0)["alpha"][..., 0]
