"""The bracket as files that commands read."""

import json
from pathlib import Path

import trimesh
from brackets import START, bracket, camera, picture

from edgegrad.files.cameras import save_camera
from edgegrad.files.image import linear_to_srgb, write_image


def write_bracket(folder: Path, size: int) -> Path:
    """Write mesh.ply, whose colours survive 8 bits, camera.json, target.png of so many pixels, and init.json."""
    mesh, view = bracket(), camera(size)
    colors = (linear_to_srgb(mesh.face_colors) * 255).round().byte().numpy()
    trimesh.Trimesh(mesh.verts, mesh.faces, face_colors=colors, process=False).export(folder / "mesh.ply")
    write_image(folder / "target.png", picture(view))
    save_camera(folder / "camera.json", view)
    (folder / "init.json").write_text(json.dumps({"mesh_to_world": START.tolist()}))
    return folder
