"""Objects of one colour, and what passes before objects."""

from __future__ import annotations

import math

import numpy as np
import torch
import trimesh
from torch import Tensor
from trimesh.creation import box, capsule, cylinder, icosphere, torus
from trimesh.remesh import subdivide
from trimesh.transformations import random_rotation_matrix, rotation_matrix, translation_matrix

import edgegrad as eg


def block(rng: np.random.Generator) -> eg.Mesh:
    """Return a box with three smaller ones and a cylinder on its sides, with sharp edges and without symmetry."""
    half = rng.uniform([0.4, 0.18, 0.18], [0.5, 0.28, 0.28])
    parts = [box(2.0 * half)]
    for _ in range(3):
        parts.append(box(2.0 * rng.uniform(0.09, 0.22, 3), translation_matrix(_on_side(half, rng))))
    pin = cylinder(float(rng.uniform(0.08, 0.15)), float(rng.uniform(0.4, 0.6)), 48)
    parts.append(pin.apply_transform(translation_matrix(_on_side(half, rng))))
    return _plain(parts, rng.uniform(0.05, 0.6, 3))


def _on_side(half: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a point on one of the long sides of a box."""
    place, axis = rng.uniform(-0.7, 0.7, 3) * half, int(rng.integers(1, 3))
    place[axis] = half[axis] * rng.choice([-1.0, 1.0])
    return place


def bolt(rng: np.random.Generator) -> eg.Mesh:
    """Return a smooth shape of a sphere, a capsule and a ring, without symmetry."""
    shaft = capsule(float(rng.uniform(0.5, 0.8)), float(rng.uniform(0.1, 0.15)), (24, 24))
    ring = torus(float(rng.uniform(0.2, 0.3)), float(rng.uniform(0.05, 0.08)), 48, 24)
    ring.apply_transform(random_rotation_matrix(rng.uniform(size=3)))
    ring.apply_translation(rng.uniform([0.15, 0.1, 0.35], [0.3, 0.25, 0.5]))
    mesh = _plain([icosphere(3, float(rng.uniform(0.22, 0.32))), shaft, ring], rng.uniform(0.05, 0.6, 3))
    return mesh.replace(normals=mesh.vertex_normals())


def hand(rng: np.random.Generator) -> eg.Mesh:
    """Return four fingers, a palm and an arm along x, whose tips are near the origin, for an object of size 1."""
    width, radius = float(rng.uniform(0.13, 0.16)), float(rng.uniform(0.05, 0.06))
    parts = []
    for k in range(4):
        finger = capsule(0.55, radius, (16, 16)).apply_transform(rotation_matrix(math.pi / 2, (0, 1, 0)))
        tip = float(rng.uniform(-0.1, 0.1)) - finger.bounds[0, 0]
        parts.append(finger.apply_translation((tip, width * (k - 1.5), 0.03 * (k % 2))))
    parts.append(box((0.6, 3.6 * width, 0.12), translation_matrix((0.75, 0.0, 0.0))))
    parts.append(box((2.0, 2.2 * width, 0.12), translation_matrix((1.9, 0.0, 0.02))))
    return _plain(parts, np.array([0.48, 0.27, 0.18]) * rng.uniform(0.4, 1.3))


def board(half: float, texture: Tensor) -> eg.Mesh:
    """Return a square across the axis z with a picture (H, W, 3) on it."""
    corners = half * torch.tensor([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    return eg.Mesh(corners, faces, texture=texture, uvs=uvs, uv_faces=faces)


def whitened(mesh: eg.Mesh) -> eg.Mesh:
    """Return the mesh in colours that are nearly white."""
    pale = {
        name: 0.75 + 0.1 * value
        for name in ("texture", "colors", "face_colors")
        if isinstance(value := getattr(mesh, name), Tensor)
    }
    return mesh.replace(**pale)


def centred(mesh: eg.Mesh, size: float) -> eg.Mesh:
    """Return the mesh with the middle of its bounding box at the origin, and a diagonal of this length."""
    low, high = mesh.verts.aminmax(dim=0)
    return mesh.replace(verts=(mesh.verts - (low + high) / 2) * (size / (high - low).norm()))


def subdivided(mesh: eg.Mesh, least: int) -> eg.Mesh:
    """Return the mesh with each face in four, again and again until there are so many."""
    while len(mesh.faces) < least:
        # Faces come in the same order, whatever they index.
        verts, faces = subdivide(mesh.verts.numpy(), mesh.faces.numpy())[:2]
        tensors = {"verts": torch.from_numpy(verts).float(), "faces": torch.from_numpy(faces).long()}
        if mesh.uvs is not None and mesh.uv_faces is not None:
            uvs, uv_faces = subdivide(mesh.uvs.numpy(), mesh.uv_faces.numpy())[:2]
            tensors |= {"uvs": torch.from_numpy(uvs).float(), "uv_faces": torch.from_numpy(uv_faces).long()}
        if mesh.colors is not None:
            tensors["colors"] = torch.from_numpy(subdivide(mesh.colors.numpy(), mesh.faces.numpy())[0]).float()
        if mesh.face_colors is not None:
            tensors["face_colors"] = mesh.face_colors.repeat_interleave(4, 0)
        smooth = mesh.normals is not None
        mesh = mesh.replace(**tensors, normals=None)
        mesh = mesh.replace(normals=mesh.vertex_normals()) if smooth else mesh
    return mesh


def _plain(parts: list[trimesh.Trimesh], colour: np.ndarray) -> eg.Mesh:
    whole = trimesh.util.concatenate(parts)
    assert isinstance(whole, trimesh.Trimesh)
    verts, faces = torch.tensor(whole.vertices).float(), torch.tensor(whole.faces).long()
    return eg.Mesh(verts, faces, face_colors=torch.tensor(colour).float().expand(len(faces), 3).contiguous())
