"""Small fits with known answers, lit and unlit, and fits that cannot end right."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import torch
import trimesh
from brackets import CENTER, SIZE, bracket, rotation
from quiet_fits import arranged
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import Parameter, PoseParameter, fit_scene
from edgegrad.fit.descent.result import Fit
from edgegrad.fit.placement import Pose

SKY = torch.tensor([0.1, 0.2, 0.3])


def cameras(count: int = 1, size: int = 48) -> list[eg.Camera]:
    angles = [2.0 * math.pi * k / count + 0.3 for k in range(count)]
    eyes = [CENTER + 4.5 * torch.tensor([0.9 * math.sin(a), 0.3, 0.9 * math.cos(a)]).double() for a in angles]
    return [eg.Camera.look_at(eye, CENTER, fov_y=45.0, size=(size, size)) for eye in eyes]


def lit_bracket(**material: Any) -> eg.Mesh:
    return bracket().to(torch.float32).replace(material=eg.Material(**material))


def sun(direction: Any = (-0.5, -0.8, -1.0), strength: Any = 2.0) -> eg.lights.DirectionalLight:
    return eg.lights.DirectionalLight(torch.as_tensor(direction), strength)


def sky(strength: float = 0.6) -> eg.lights.SphericalHarmonics:
    return eg.lights.SphericalHarmonics(torch.zeros(9, 3).index_fill(0, torch.tensor(0), strength))


def lit(mesh: eg.Mesh, *lights: Any) -> eg.Scene:
    return eg.Scene([mesh], SKY, lights=list(lights) or [sun(), sky()])


def pictures(scene: eg.Scene, views: list[eg.Camera], seeds: int = 8) -> list[Tensor]:
    """Return means over seeds, since a face is shaded at few points of a pixel."""
    with torch.no_grad():
        return [
            torch.stack([eg.render(scene, view, 64, (1 << 20) + k) for k in range(seeds)]).mean(0) for view in views
        ]


def about_center(turn: Tensor, shift: Any = (0.0, 0.0, 0.0)) -> Pose:
    c = CENTER.to(turn)
    return Pose(turn.double(), (c + torch.as_tensor(shift).to(turn) - turn @ c).double())


def degrees_between(a: Tensor, b: Tensor) -> float:
    a, b = (torch.nn.functional.normalize(x.double(), dim=0) for x in (a, b))
    return math.degrees(2.0 * math.asin(min(1.0, 0.5 * float((a - b).norm()))))


def pose_error(matrix: Tensor) -> float:
    """Return the larger of degrees and hundredths of the size by which a pose is off."""
    M = matrix.double()
    turned = math.degrees(2.0 * math.asin(min(1.0, float((M[:3, :3] - torch.eye(3)).norm()) / math.sqrt(8.0))))
    apart = M[:3, :3] @ CENTER + M[:3, 3] - CENTER
    return max(turned, 100.0 * float(apart.norm()) / SIZE)


START = about_center(rotation(0.12, -0.15, 0.1), (0.12, -0.1, 0.15))  # 12.3° and 8.4 % of the size off


@dataclass
class Problem:
    """A fit with its start and arguments; `error` is 1 where its answer is as far off as a right one may be."""

    scene: Any
    views: list[eg.Camera]
    targets: list[Tensor] | None
    parameters: dict[str, Any]
    error: Callable[[Fit], float]
    options: dict[str, Any] = field(default_factory=dict)

    def fit(self, **options: Any) -> Fit:
        given = {"spp": 8, "progress": False, "steps": 400, **self.options, **options}
        return fit_scene(self.scene, self.targets, self.views, self.parameters, **arranged(**given))


def colours() -> Problem:
    views = cameras(3, 32)
    targets = pictures(eg.Scene([bracket()], SKY), views, 1)
    start = eg.Scene([bracket().replace(face_colors=torch.full((20, 3), 0.4))], torch.zeros(3))
    wanted = {"meshes.0.face_colors": Parameter(0.03, low=0.0), "background": 0.02}
    return Problem(start, views, targets, wanted, lambda fit: float((fit.values["background"] - SKY).norm()) / 0.01)


def shift() -> Problem:
    views, mesh = cameras(2, 32), bracket()

    def scene(values: dict[str, Tensor]) -> eg.Mesh:
        return mesh.transformed(t=torch.cat([values["x"], torch.zeros(2)]).double())

    targets = pictures(eg.Scene([mesh.transformed(t=torch.tensor([0.2, 0, 0]).double())]), views, 1)
    wanted = {"x": Parameter(0.01, torch.zeros(1))}
    return Problem(scene, views, targets, wanted, lambda fit: abs(float(fit.values["x"]) - 0.2) / 0.005)


def sunlight() -> Problem:
    views, truth = cameras(), torch.tensor([-0.5, -0.8, -1.0])
    targets = pictures(lit(lit_bracket()), views)
    start = lit(lit_bracket(), sun((-0.1, -0.9, -0.9)), sky())
    wanted = {"lights.0.direction": 0.02}
    return Problem(
        start, views, targets, wanted, lambda fit: degrees_between(fit.values["lights.0.direction"], truth) / 0.5
    )


def emitter() -> Problem:
    views, truth = cameras(), torch.tensor([2.4, 2.0, 2.6])

    def light(position: Tensor, colour: Tensor) -> eg.lights.PointLight:
        return eg.lights.PointLight(position, 6.0, colour)

    targets = pictures(lit(lit_bracket(), light(truth, torch.tensor([1.0, 0.9, 0.7])), sky(0.3)), views)
    start = lit(lit_bracket(), light(torch.tensor([1.8, 2.4, 2.9]), torch.ones(3)), sky(0.3))
    wanted = {"lights.0.position": 0.02, "lights.0.color": 0.02}

    def error(fit: Fit) -> float:
        return float((fit.values["lights.0.position"] - truth).norm()) / 0.03

    # Farther and brighter is nearly the same: with 8 samples, their noise alone moves the light by up to 0.07, with 32 by 0.02.
    return Problem(start, views, targets, wanted, error, {"spp": 32})


def patched_ball(colours: Tensor) -> eg.Mesh:
    """Return a smooth ball with one colour (8, 3) an octant."""
    shape = trimesh.creation.icosphere(subdivisions=2)
    verts, faces = torch.tensor(shape.vertices).float(), torch.tensor(shape.faces)
    octant = ((verts[faces].mean(1) > 0).long() * torch.tensor([1, 2, 4])).sum(1)
    placed = verts + CENTER.float()
    normals = eg.Mesh(placed, faces).vertex_normals()
    return eg.Mesh(placed, faces, face_colors=colours[octant], normals=normals, material=eg.Material())


def light_and_colors() -> Problem:
    """Find eight colours and the sun's direction, 27 numbers."""
    views = cameras(2, 40)
    colours = 0.2 + 0.6 * torch.rand(8, 3, generator=torch.Generator().manual_seed(1))
    truth = torch.tensor([-0.5, -0.8, -1.0])
    targets = pictures(lit(patched_ball(colours)), views)

    def scene(values: dict[str, Tensor]) -> eg.Scene:
        return lit(patched_ball(values["colours"]), sun(values["sun"]), sky())

    wanted = {
        "colours": Parameter(0.02, torch.full((8, 3), 0.5), low=0.0),
        "sun": Parameter(0.02, torch.tensor([-0.1, -0.9, -0.9])),
    }
    return Problem(scene, views, targets, wanted, lambda fit: degrees_between(fit.values["sun"], truth) / 0.5)


def pose(**options: Any) -> Problem:
    views = cameras()
    wanted = {"meshes.0.pose": PoseParameter(START, rotation=0.015, shift=0.006)}
    return Problem(
        lit(lit_bracket()), views, pictures(lit(lit_bracket()), views), wanted,
        lambda fit: pose_error(fit.values["meshes.0.pose"]) / 0.25, options,
    )  # fmt: skip


def pose_with_noise() -> Problem:
    problem = pose()
    generator = torch.Generator().manual_seed(3)
    problem.targets = [t + 0.03 * torch.randn(t.shape, generator=generator) for t in problem.targets]
    problem.error = lambda fit: pose_error(fit.values["meshes.0.pose"]) / 1.0
    return problem


def pose_and_light() -> Problem:
    problem = pose()
    problem.scene = lit(lit_bracket(), sun((-0.1, -0.9, -0.9)), sky())
    problem.parameters = {**problem.parameters, "lights.0.direction": 0.02}
    return problem


def pose_and_scale() -> Problem:
    problem = pose()
    problem.views = cameras(2)
    problem.targets = pictures(lit(lit_bracket()), problem.views)
    start = Pose(START.R, START.t, torch.tensor(1.1).double())
    problem.parameters = {"meshes.0.pose": PoseParameter(start, rotation=0.015, shift=0.006, scale=0.006)}
    problem.error = lambda fit: abs(float(fit.poses["meshes.0.pose"].scale) - 1.0) / 0.004
    return problem


def pose_by_masks() -> Problem:
    views, mesh = cameras(3), bracket(plain=True)
    masks = [eg.render_aovs(mesh, view, ["alpha"], spp=64, seed=5)["alpha"] for view in views]
    wanted = {"pose": PoseParameter(START, rotation=0.015, shift=0.006)}
    return Problem(mesh, views, None, wanted, lambda fit: pose_error(fit.values["pose"]) / 0.5, {"masks": masks})


def camera_and_material() -> Problem:
    (view,) = cameras()
    mesh = lit_bracket(roughness=0.35, metallic=0.2)
    targets = pictures(lit(mesh), [view])
    start = lit(mesh.replace(material=eg.Material(roughness=torch.tensor(0.6), metallic=0.2)))
    back = Pose(START.R.T, -(START.R.T @ START.t))
    camera = PoseParameter(back, rotation=0.015, shift=0.006)
    wanted = {"cameras.0.pose": camera, "meshes.0.material.roughness": Parameter(0.015, low=0.05, high=1.0)}

    def error(fit: Fit) -> float:
        roughness = abs(float(fit.values["meshes.0.material.roughness"]) - 0.35)
        return max(pose_error(fit.values["cameras.0.pose"]) / 0.4, roughness / 0.04)

    return Problem(start, [view], targets, wanted, error)


def metal() -> Problem:
    views = cameras(2)
    targets = pictures(lit(lit_bracket(roughness=0.4, metallic=0.6)), views)
    material = eg.Material(roughness=torch.tensor(0.6), metallic=torch.tensor(0.3))
    start = lit(lit_bracket().replace(material=material))
    wanted = {f"meshes.0.material.{n}": Parameter(0.015, low=0.05, high=1.0) for n in ("roughness", "metallic")}
    return Problem(
        start, views, targets, wanted, lambda fit: abs(float(fit.values["meshes.0.material.metallic"]) - 0.6) / 0.03
    )


def vertices() -> Problem:
    views = cameras(4, 40)
    mesh = bracket()
    moved = mesh.verts + 0.08 * torch.sin(3.0 * mesh.verts.roll(1, 1))
    targets = pictures(eg.Scene([mesh.replace(verts=moved)], SKY), views, 1)
    return Problem(
        eg.Scene([mesh], SKY), views, targets, {"meshes.0.verts": 0.005},
        lambda fit: float((fit.mesh.verts - moved).norm(dim=1).mean()) / 0.01,
    )  # fmt: skip


def covered() -> Problem:
    """Find the pose under a robust loss where a third of the picture shows something else."""
    problem = pose(loss="robust")
    problem.targets[0][:, :16] = 0.9
    problem.error = lambda fit: pose_error(fit.values["meshes.0.pose"]) / 0.8
    return problem


RIGHT = [
    colours, shift, sunlight, emitter, light_and_colors, pose, pose_with_noise, pose_and_light, pose_and_scale, pose_by_masks,
    camera_and_material, metal, vertices, covered,
]  # fmt: skip


def few_steps() -> Problem:
    return pose(steps=10)


def noise() -> Problem:
    problem = pose()
    problem.targets = [torch.rand(48, 48, 3, generator=torch.Generator().manual_seed(0))]
    return problem


def another_object() -> Problem:
    problem = pose()
    other = eg.Mesh(*_octahedron(), material=eg.Material(base_color=torch.tensor([0.2, 0.6, 0.3])))
    problem.targets = pictures(lit(other), problem.views)
    return problem


def another_light() -> Problem:
    """Find a background alone where both the sun and the object are elsewhere."""
    views = cameras()
    moved = lit_bracket().transformed(about_center(rotation(0.5, 0.9, 0.3)).R.float())
    return Problem(
        lit(lit_bracket()), views, pictures(lit(moved, sun((0.9, -0.1, -0.5))), views), {"background": 0.02},
        lambda fit: math.inf,
    )  # fmt: skip


def turned_over() -> Problem:
    """Start from the other side, where the descent ends elsewhere."""
    problem = pose()
    start = about_center(rotation(0.0, 0.0, math.pi - 0.2))
    problem.parameters = {"meshes.0.pose": PoseParameter(start, rotation=0.015, shift=0.006)}
    return problem


WRONG = {
    few_steps: "loss still falling", noise: "edges not explained", another_object: "edges not explained",
    another_light: "edges not explained", turned_over: "edges not explained",
}  # fmt: skip


def _octahedron() -> tuple[Tensor, Tensor]:
    verts = CENTER.float() + 0.9 * torch.cat([torch.eye(3), -torch.eye(3)])
    faces = [[0, 1, 2], [1, 3, 2], [3, 4, 2], [4, 0, 2], [1, 0, 5], [3, 1, 5], [4, 3, 5], [0, 4, 5]]
    return verts, torch.tensor(faces)
