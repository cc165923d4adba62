"""A coloured bracket, its pictures, and how far a fit's pose is off."""

import math

import torch

import edgegrad as eg
from edgegrad.fit.pose.inputs import ArgumentNames
from edgegrad.fit.pose.task import PoseTask, Unknowns

CENTER = torch.tensor([1.0, 0.75, 0.4]).double()
SIZE = 2.62  # the diagonal of the bracket's box
BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def bracket(plain=False):
    """Return an L of 20 triangles, one colour a side, so that no pose is ambiguous."""
    profile = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 0.6], [0.7, 0.6], [0.7, 1.5], [0.0, 1.5]]).double()
    verts = torch.cat([torch.cat([profile, torch.full((6, 1), z).double()], 1) for z in (0.0, 0.8)])
    cap = [[3, 4, 5], [3, 5, 0], [3, 0, 1], [3, 1, 2]]  # seen from its reflex corner, the L is a fan
    faces = [[c, b, a] for a, b, c in cap] + [[a + 6, b + 6, c + 6] for a, b, c in cap]
    colors = [[0.8, 0.2, 0.1]] * 4 + [[0.2, 0.7, 0.2]] * 4
    for k in range(6):
        a, b = k, (k + 1) % 6
        faces += [[a, b, b + 6], [a, b + 6, a + 6]]
        colors += [[0.15 * k, 0.9 - 0.15 * k, 0.4 + 0.1 * (k % 3)]] * 2
    return eg.Mesh(verts, torch.tensor(faces), face_colors=None if plain else torch.tensor(colors))


def camera(size=64, distance=4.5):
    eye = CENTER + distance * torch.tensor([0.35, 0.3, 0.89]).double()
    return eg.Camera.look_at(eye, CENTER, fov_y=45.0, size=(size, size))


def rotation(*vector):
    x, y, z = vector
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).double())


def about_center(R, shift=(0.0, 0.0, 0.0)):
    """Return the pose (4, 4) that rotates the bracket about its centre and shifts it."""
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3], M[:3, 3] = R, CENTER + torch.tensor(shift).double() - R @ CENTER
    return M


START = about_center(rotation(0.12, -0.15, 0.1), (0.12, -0.1, 0.15))  # 12.3° and 8.4 % of the size off


def picture(view, mesh=None, background=BACKGROUND):
    return eg.render(eg.Scene([mesh or bracket()], background), view, spp=64, seed=1 << 40)


def silhouette(view):
    mesh = bracket().replace(face_colors=torch.ones(20, 1))
    return eg.render(mesh, view, spp=64, seed=1 << 40)


def errors(fit, R=None):
    """Return by how many degrees, and percent of the size, a pose is off the identity."""
    apart = fit.R if R is None else fit.R @ R.T
    degrees = math.degrees(math.acos(max(-1.0, min(1.0, (float(apart.trace()) - 1.0) / 2.0))))
    moved = fit.scale * fit.R @ CENTER + fit.t - CENTER
    return degrees, 100.0 * float(moved.norm()) / SIZE


def before_sky():
    return eg.Scene([bracket()], BACKGROUND)


def task_of(image, view, mesh=None, mask=None, weight=None, background=None, unknowns=None):
    """Return the task of a pose search for a bracket, or another mesh, of scale 1."""
    scene, unknowns = eg.Scene([mesh or bracket()], background), unknowns or Unknowns()
    return PoseTask.from_arguments(scene, image, view, mask, weight, unknowns, 1.0, ArgumentNames())
