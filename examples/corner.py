"""Find the colours of a room's corner from two pictures of it, with indirect light and without.

    python examples/corner.py [--size 64] [--out corner.png]

Three walls of unknown colours meet, under a light that is known. Of the light that the pictures show 17 % has been scattered by
one wall on another. A fit in direct light alone takes it for the wall's own: colours come out too bright, with those of
neighbours baked in. With `bounces=4` they are right. The pictures have eight bounces, and noise of their own.
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, fit_scene
from edgegrad.fit.descent.result import Fit

SIZE, SHOWN = 64, 160  # pixels on a side, of the pictures and of what is drawn
WALLS = {
    "floor": (torch.tensor([0.75, 0.75, 0.75]), [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]),
    "left": (torch.tensor([0.7, 0.2, 0.15]), [[0, 0, 0], [0, 2, 0], [0, 2, 2], [0, 0, 2]]),
    "right": (torch.tensor([0.25, 0.35, 0.7]), [[0, 0, 0], [0, 0, 2], [2, 0, 2], [2, 0, 0]]),
}
TRUTH = {name: color for name, (color, _) in WALLS.items()}


def scene(colors: dict[str, Tensor]) -> eg.Scene:
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    walls = [
        eg.Mesh(torch.tensor(corners, dtype=torch.float32), faces, material=eg.Material(colors[name]))
        for name, (_, corners) in WALLS.items()
    ]
    emitting = eg.Material(base_color=0.0, emission=60.0)
    emitter = eg.shapes.rectangle((1.1, 1.1, 3.2), (0.25, 0.0, 0.0), (0.0, -0.25, 0.0), material=emitting)
    return eg.Scene([*walls, emitter])


def cameras(size: int) -> list[eg.Camera]:
    eyes = (4.5, 3.6, 2.6), (3.4, 4.6, 2.0)
    return [eg.Camera.look_at(eye, (0.7, 0.7, 0.7), (0.0, 0.0, 1.0), fov_y=32.0, size=(size, size)) for eye in eyes]


def pictures(colors: dict[str, Tensor], size: int, bounces: int, spp: int = 256) -> list[Tensor]:
    with torch.no_grad():
        return [
            eg.render(scene(colors), camera, spp, seed=10_000 + k, bounces=bounces)
            for k, camera in enumerate(cameras(size))
        ]


def fit(seen: list[Tensor], bounces: int, steps: int = 30) -> Fit:
    """Start from grey walls."""
    size = len(seen[0])
    sought = {name: Parameter(0.03, torch.full((3,), 0.5), low=0.0, high=1.0) for name in WALLS}
    options = FitOptions(seed=0, method="gauss-newton", steps=steps, spp=16, bounces=bounces)
    return fit_scene(scene, seen, cameras(size), sought, options=options)


def errors(found: Fit) -> dict[str, float]:
    """Return of each wall the largest of its channels' relative errors."""
    return {name: float((found.values[name] / color - 1).abs().max()) for name, color in TRUTH.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--size", type=int, default=SIZE)
    parser.add_argument("--out", default="corner.png")
    args = parser.parse_args()
    seen = pictures(TRUTH, args.size, 8)
    shown = [pictures(TRUTH, SHOWN, 8)[0]]
    for bounces in (1, 4):
        found = fit(seen, bounces)
        said = ", ".join(f"{name} {100 * error:.1f} %" for name, error in errors(found).items())
        print(f"bounces={bounces}: off by {said}; {found.seconds:.0f} s; {found.reason}", flush=True)
        shown.append(pictures(found.values, SHOWN, 8)[0])
    eg.write_image(args.out, torch.cat(shown, 1))
    print(f"{args.out}: the corner, and what was found in direct light and with 4 bounces, in all its light")


if __name__ == "__main__":
    main()
