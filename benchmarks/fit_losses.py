"""What losses make of heavy-tailed noise: the roughness of a metal ball under two small bright lights, from 0.6.

    python -m benchmarks.fit_losses

A glossy surface that meets a small light has rare bright pixels. Printed is the roughness found, where 0.3 is right.
"""

from __future__ import annotations

import torch
import trimesh
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, fit_scene

TRUTH, START = 0.3, 0.6
CASES = [("l2", 8, 1), ("l1", 8, 1), ("huber", 8, 1), ("robust", 8, 1), ("l2", 64, 16), ("robust", 64, 16)]


def scene(roughness: Tensor) -> eg.Scene:
    ball = trimesh.creation.icosphere(subdivisions=3)
    verts = torch.tensor(ball.vertices).float()
    metal = eg.Material(base_color=torch.tensor([0.9, 0.7, 0.4]), roughness=roughness, metallic=1.0)
    sky = torch.full((16, 32, 3), 0.3)
    sky[3, 6:8], sky[5, 20] = 80.0, 120.0
    mesh = eg.Mesh(verts, torch.tensor(ball.faces), normals=verts, material=metal)
    return eg.Scene([mesh], lights=[eg.lights.Environment(sky)])


def main() -> None:
    camera = eg.Camera.look_at((0.0, 0.5, 3.2), (0.0, 0.0, 0.0), fov_y=40, size=(32, 32))
    with torch.no_grad():
        renders = [
            eg.render(scene(torch.tensor(TRUTH)), camera, 64, 10**6 + k, sampling=eg.Sampling(lights=16))
            for k in range(64)
        ]
    target = torch.stack(renders).mean(0)
    print("loss    spp  lights  roughness")
    for loss, spp, lights in CASES:
        fit = fit_scene(
            lambda values: scene(values["roughness"]), target, camera,
            {"roughness": Parameter(0.02, torch.tensor(START), low=0.05, high=1.0)},
            options=FitOptions(loss=loss, spp=spp, steps=150, seed=0, progress=False, sampling=eg.Sampling(lights=lights)),
        )  # fmt: skip
        print(f"{loss:7} {spp:3} {lights:6} {float(fit.values['roughness']):15.2f}   {fit.reason}", flush=True)


if __name__ == "__main__":
    main()
