"""Messages of meshes and scenes, each wording once. test_bad_input.py checks that every argument is named."""

from __future__ import annotations

import pytest
import torch
from messages import FACES, INF, NAN, VERTS, T, V, bad_calls, check_message, mesh, put, textured

import edgegrad as eg

pytestmark = pytest.mark.watched

MESH = {
    "verts is text": (lambda: mesh(verts="cube"), T, "verts: expected a tensor, array or nested sequence", "got str"),
    "verts is missing": (lambda: mesh(verts=None), T, "verts: expected a tensor", "got NoneType"),
    "verts of integers": (
        lambda: mesh(verts=FACES),
        T,
        "verts: expected float32 or float64, got torch.int64",
        ".float()",
    ),
    "verts in 2-D": (lambda: mesh(verts=VERTS[:, :2]), V, "verts: expected shape (V, 3), got (8, 2)"),
    "no verts": (lambda: mesh(verts=VERTS[:0]), V, "verts: expected shape (V, 3), none of them 0, got (0, 3)"),
    "verts not finite": (
        lambda: mesh(verts=put(put(VERTS, (3, 1), NAN), (5, 0), INF)),
        V,
        "verts: expected finite numbers, got nan at [3, 1] (2 such values in all)",
    ),
    "faces of floats": (
        lambda: mesh(faces=FACES.float()),
        T,
        "faces: expected an integer dtype",
        "got torch.float32",
        ".long()",
    ),
    "quads": (lambda: mesh(faces=FACES.reshape(-1, 4)), V, "faces: expected shape (F, 3), got (9, 4); triangulate"),
    "face index too large": (
        lambda: mesh(faces=put(FACES, (4, 2), 8)),
        V,
        "faces: expected indices from 0 to 7 (verts has 8 rows), got 8 at [4, 2]",
    ),
    "two kinds of colour": (
        lambda: mesh(colors=VERTS, face_colors=torch.rand(12, 3)),
        V,
        "face_colors: expected one kind of colour, got colors and face_colors",
    ),
    "colors too few": (lambda: mesh(colors=VERTS[:7]), V, "colors: expected shape (8, C), got (7, 3)"),
    "texture without uvs": (lambda: textured(uvs=None), V, "uvs: expected with a texture, got None"),
    "texture without uv_faces": (lambda: textured(uv_faces=None), V, "uv_faces: expected with a texture, got None"),
    "uvs alone": (lambda: textured(texture=None, uv_faces=None), V, "uv_faces: expected with uvs, got None"),
    "uv_faces alone": (lambda: mesh(uv_faces=FACES), V, "uvs: expected with uv_faces, got None"),
    "alpha without uvs": (lambda: mesh(alpha=torch.ones(2, 2)), V, "uvs: expected with alpha, got None"),
    "alpha of colours": (lambda: textured(alpha=torch.ones(2, 2, 1)), V, "alpha: expected shape (h, w), got (2, 2, 1)"),
    "alpha of bytes": (lambda: textured(alpha=torch.ones(2, 2).byte()), T, "alpha: expected float32 or float64"),
    "alpha_cutoff as text": (lambda: textured(alpha_cutoff="half"), T, "alpha_cutoff: expected a number, got str"),
    "alpha_cutoff not finite": (
        lambda: textured(alpha_cutoff=NAN),
        V,
        "alpha_cutoff: expected a finite number, got nan",
    ),
    "wrap unknown": (lambda: textured(wrap="border"), V, "wrap: expected one of repeat, clamp, mirror, or a pair"),
    "wrap of three axes": (lambda: textured(wrap=("clamp",) * 3), V, "wrap: expected one of repeat, clamp, mirror"),
    "filter of a texture": (
        lambda: textured(filter="cubic"),
        V,
        "filter: expected one of linear, nearest, mipmap, got 'cubic'",
    ),
    "uv_faces too few": (lambda: textured(uv_faces=FACES[:5]), V, "uv_faces: expected shape (12, 3), got (5, 3)"),
    "uv index too large": (
        lambda: textured(uvs=torch.rand(6, 2)),
        V,
        "uv_faces: expected indices from 0 to 5 (uvs has 6 rows), got 7",
    ),
    "replace what is not there": (lambda: mesh().replace(vertices=VERTS), T, "replace: expected one of", "'vertices'"),
    "scale of three": (
        lambda: mesh().transformed(scale=torch.ones(3)),
        V,
        "scale: expected one number, got shape (3,)",
    ),
}

SCENE = {
    "no mesh": (lambda: eg.Scene([]), V, "meshes: expected at least one Mesh, got none"),
    "a number": (lambda: eg.Scene(3), T, "meshes: expected a Mesh or a sequence of them, got int"),
    "not a mesh": (lambda: eg.Scene([mesh(), VERTS]), T, "meshes[1]: expected a Mesh, got Tensor"),
    "other channels": (
        lambda: eg.Scene([mesh(), mesh(colors=VERTS), mesh(colors=VERTS[:, :2])]),
        V,
        "meshes[2]: expected 3 channels like meshes[1], got 2",
    ),
    "another device": (
        lambda: eg.Scene([mesh(), mesh().to("meta")]),
        V,
        "meshes: expected one device, got ['cpu', 'meta']",
    ),
    "background of other channels": (
        lambda: eg.Scene(mesh(colors=VERTS), torch.zeros(4)),
        V,
        "background: expected shape (3,) or (H, W, 3), got (4,)",
    ),
}


@bad_calls(MESH | SCENE)
def test_messages_of_scenes(call, error, parts):
    check_message(call, error, *parts)
