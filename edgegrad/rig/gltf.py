"""Rigs from glTF files."""

from __future__ import annotations

import numpy as np
import torch

from ..files.formats.gltf_rig import RigFile, SkinBinding
from ..files.formats.part import LoadOptions, Part, errors_with_path
from ..files.parts import read_rig
from ..files.paths import PathLike
from ..files.welding import to_mesh, welded
from ..scene.mesh import Mesh
from ..scene.scene import Scene
from .animation import Animation, Channel
from .joints import Joints
from .rig import Rig
from .rotations import roma
from .skin import Skin


def load_gltf(path: PathLike, materials: bool = True, lit: bool = False, dtype: torch.dtype | None = None) -> Rig:
    """Return a Rig from a glTF or GLB file: what its skins, morph targets and nodes move, and its animations.

    Each node of the scene is a joint, by its name, and each primitive of a visible node a mesh, in their order; a node without
    a skin carries its mesh along. Weights of a skin are normalised, with a warning where they are more than a hundredth from
    it; JOINTS_n and WEIGHTS_n are read for all n. Morphs have the names of mesh.extras.targetNames. Vertices are welded where
    they are equal in all poses. Lights stand where they are at rest.

    One warning names what does not fit, and the rest is loaded: vertices whose weights are all 0 are bound to the skin's first
    joint, primitives without JOINTS_0 are rigid with their node, rotations of another length than 1 are divided by it, and
    channels of animations, morph targets and lights that cannot be read are left out.

    The arguments are those of load_scene(), and so are the errors. ValueError is also raised for a skin whose joints are not in
    the scene, other errors of a skin, and nodes in a cycle.
    """
    roma()
    options = LoadOptions(materials, lit, rigged=True, dtype=dtype)
    with errors_with_path(path):
        found, model = read_rig(path, options)
        joints = Joints(
            [node.name for node in found.nodes],
            [node.parent for node in found.nodes],
            torch.from_numpy(np.stack([node.translation for node in found.nodes])),
            torch.from_numpy(np.stack([node.rotation for node in found.nodes])),
            torch.from_numpy(np.stack([node.stretch for node in found.nodes])),
        )
        world = joints.world().numpy()
        made = [
            _bound(part, bound, world, model.dtype)
            for part, (_, _, bound) in zip(model.parts, found.parts, strict=True)
        ]
        meshes = [mesh for mesh, _ in made]
        scene = meshes[0] if len(meshes) == 1 and not model.lights else Scene(meshes, lights=model.lights)
        morphs = dict(zip(found.morphs, found.morph_weights, strict=True))
        return Rig.from_arrays(
            scene, joints, [skin for _, skin in made], morphs=morphs, animations=_animations(found, joints)
        )


def _bound(part: Part, bound: SkinBinding, world: np.ndarray, dtype: torch.dtype) -> tuple[Mesh, Skin]:
    """Return the mesh, and how it is bound to the joints."""
    moves = [*bound.targets, bound.weights]
    by = welded(np.concatenate([part.verts, *moves], 1), part.faces)
    # The front of a face stays its front in a mirror.
    blended = np.einsum("vn,nij->vij", bound.weights[by.kept], (world[bound.joints] @ bound.inverse_binds)[:, :3, :3])
    mirrored = np.median(np.linalg.det(blended)) < 0.0
    by = by._replace(faces=by.faces[:, ::-1].copy()) if mirrored else by
    part = part.reversed() if mirrored else part
    normals, index, owners, of_normals = None, None, None, None
    if part.normals is not None:
        each = part.normal_faces if part.normal_faces is not None else part.faces
        # There is one row for each vertex and normal that meet at a corner.
        at = np.zeros(len(part.normals), np.int64)
        at[each] = by.faces
        rows = np.concatenate([at[:, None], part.normals, *bound.normal_targets], 1)
        one = welded(rows, each)
        owners, index, normals = at[one.kept], one.faces, part.normals[one.kept]
        of_normals = torch.from_numpy(bound.normal_targets[:, one.kept])
        if len(owners) == len(by.kept) and np.array_equal(owners[index], index):
            owners, index = None, None
        part = part._replace(normals=None, normal_faces=None)
    mesh = to_mesh(part, dtype, by)
    if normals is not None:
        mesh = mesh.replace(
            normals=torch.from_numpy(normals).to(dtype), normal_faces=None if index is None else torch.from_numpy(index)
        )
    skin = Skin(
        torch.from_numpy(bound.joints), torch.from_numpy(bound.inverse_binds), torch.from_numpy(bound.weights[by.kept]),
        bound.morphs, torch.from_numpy(bound.targets[:, by.kept]), of_normals,
        None if owners is None else torch.from_numpy(owners),
    )  # fmt: skip
    return mesh, skin


def _animations(found: RigFile, joints: Joints) -> list[Animation]:
    weights = torch.tensor(found.morph_weights, dtype=torch.float64)
    made = []
    for name, channels in found.animations:
        own = []
        for channel in channels:
            if channel.path == "weights" and channel.node not in found.morphs_of:
                continue  # of a mesh that is hidden
            target = found.morphs_of[channel.node][0] if channel.path == "weights" else channel.node
            times, values = torch.from_numpy(channel.times), torch.from_numpy(channel.values)
            own.append(Channel(channel.path, target, times, values, channel.interpolation))
        made.append(Animation(name, tuple(own), joints, weights))
    return made
