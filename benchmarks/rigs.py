"""Rigs: how exactly poses are found, and what a pose costs.

    python -m benchmarks.rigs body [--count 10] [--first 0] [--size 192]
    python -m benchmarks.rigs picture | anny | arm | walk | evaluation

body        twenty joints of a skinned mesh from four masks, from rest, each turned by up to 40°
picture     the same from one picture with colours in the light of a sun and a sky that the fit does not know: first in a smooth
            light, then in a sun's and a sky's
anny        pose and shape of a body model from four masks, from rest
arm         a camera from eight masks of a seven-joint arm with known angles
walk        the same twenty joints in a walk of 60 frames, tracked in four masks
evaluation  posed vertices and their gradient, next to a step of the renderer
Seconds are of the processor, over all cores.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from pathlib import Path
from typing import Any

import arm
import body
import figure
import robot
import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, fit_rig, track_rig

F64 = torch.float64
SEEN = 30  # pixels of a limb's own surface in a picture, from which its joint is visible
TRIES = 8  # of limbs, in one picture
FLIPPED = 30.0  # degrees, of a limb's direction


def summary(errors: Tensor, what: str) -> str:
    return f"{what}: median {errors.median():.2f}°, 90 % {errors.quantile(0.9):.2f}°, most {errors.max():.1f}°"


def masks_of(posed: eg.Mesh, cameras: list[eg.Camera], spp: int = 64) -> list[Tensor]:
    with torch.no_grad():
        return [eg.render_aovs(posed, camera, ["alpha"], spp=spp, seed=5)["alpha"] for camera in cameras]


def bodies(count: int, first: int, size: int) -> None:
    rotation, direction, seconds = [], [], []
    for seed in range(first, first + count):
        began = time.process_time()
        rig, truth, _, fit = body.trial(seed, size=size, progress=False)
        seconds.append(time.process_time() - began)
        errors = body.Errors.of(rig, fit.values["rotations"], truth)
        rotation.append(errors.rotation)
        direction.append(errors.direction)
        print(f"pose {seed}: {errors}; {fit.reason[:70]}; {seconds[-1]:.0f} s", flush=True)
    print(summary(torch.cat(rotation), "rotations of all joints"))
    print(summary(torch.cat(direction), "directions of all limbs"))
    print(f"seconds: median {torch.tensor(seconds).median():.0f}, most {max(seconds):.0f}")


# -- one picture --------------------------------------------------------------------------------------------------------


def in_light(mesh: eg.Mesh, lights: list[Any]) -> eg.Scene:
    """Return the mesh as a matte surface with smooth normals before black."""
    assert mesh.colors is not None
    normals = mesh.vertex_normals()
    material = eg.Material(base_color=mesh.colors)
    return eg.Scene([mesh.replace(colors=None, normals=normals, material=material)], lights=lights)


def harmonic(posed: eg.Mesh, light: Tensor) -> eg.Scene:
    return in_light(posed, [eg.lights.SphericalHarmonics(light.to(posed.verts))])


def sunny(posed: eg.Mesh, sky: Tensor, sun: Tensor, tint: Tensor) -> eg.Scene:
    """Light the mesh by a sun in the direction `sun`, which casts shadows, and a sky that casts none."""
    like = posed.verts
    lights = [
        eg.lights.DirectionalLight(-sun.to(like), 1.0, color=tint.to(like)),
        eg.lights.SphericalHarmonics(sky.to(like)),
    ]
    return in_light(posed, lights)


def sun_of(light: Tensor) -> dict[str, Parameter]:
    """Return where a sun and a sky begin, from irradiance (9, 3).

    Order 1 is the sun's, max(0, n·s), whose harmonics are √π/2 of order 0 and √(π/3) of order 1 (Ramamoorthi and Hanrahan 2001).
    """
    first = light[[3, 1, 2]]  # (xyz, channels)
    sun = first.mean(1) / first.mean(1).norm()
    tint = (sun @ first / math.sqrt(math.pi / 3.0)).clamp(min=0.1)
    sky = torch.zeros_like(light)
    sky[0] = (light[0] - 0.5 * math.sqrt(math.pi) * tint).clamp(min=0.1)
    return {"sky": Parameter(0.2, sky), "sun": Parameter(0.1, sun), "tint": Parameter(0.2, tint)}


def sun_and_sky(seed: int) -> list[Any]:
    """Return a sun from a random direction above, and a sky."""
    g = torch.Generator().manual_seed(100 + seed)
    x, z = torch.randn(2, generator=g).tolist()
    sky = torch.zeros(9, 3)
    sky[0], sky[1] = 3.0, 0.8
    return [
        eg.lights.DirectionalLight(torch.tensor([x, -1.2, z]), 1.6, color=torch.tensor([1.0, 0.95, 0.85])),
        eg.lights.SphericalHarmonics(sky),
    ]


def visible(rig: eg.rig.Rig, posed: eg.Mesh, camera: eg.Camera) -> Tensor:
    """Return for each joint (J,) whether its limb covers more than SEEN pixels."""
    skin = rig.deformer.skins[0]  # type: ignore[attr-defined]
    shares = eg.render(posed.replace(colors=skin.weights.to(posed.verts)), camera, 16)
    return shares.sum((0, 1)) > SEEN


def picture(count: int, first: int, size: int) -> None:
    found, seconds = [], []
    rig = figure.figure(colored=True).with_limits(rotations=(-body.LIMIT, body.LIMIT))
    camera = figure.cameras(size)[0]
    light = torch.zeros(9, 3, dtype=F64)
    light[0] = 4.0
    for seed in range(first, first + count):
        truth, began = figure.pose(seed, 40.0), time.process_time()
        target = eg.render(in_light(rig.posed(truth), sun_and_sky(seed)), camera, 64, 5)
        seen = visible(rig, rig.posed(truth), camera)
        told: dict[str, Any] = {"loss": "huber", "seed": seed, "progress": False}
        smooth = fit_rig(
            rig,
            target,
            camera,
            appearance=(harmonic, {"light": Parameter(0.2, light)}),
            search=TRIES,
            options=FitOptions(**told),
        )
        before = body.Errors.of(rig, smooth.values["rotations"], truth).rotation[seen]
        # With a light that is known better, from there: shadows that no smooth light has turn limbs aside.
        fit = fit_rig(
            rig, target, camera, appearance=(sunny, sun_of(smooth.fit.values["light"])), init=smooth.values, search=0,
            options=FitOptions(coarsest=size // 2, **told),
        )  # fmt: skip
        seconds.append(time.process_time() - began)
        errors = body.Errors.of(rig, fit.values["rotations"], truth)
        found.append(errors.rotation[seen])
        print(
            f"pose {seed}: {int(seen.sum())} joints seen, median {before.median():.2f}° in smooth light, then "
            f"{found[-1].median():.2f}°, 90 % {found[-1].quantile(0.9):.2f}°; {fit.reason[:70]}; {seconds[-1]:.0f} s", flush=True,
        )  # fmt: skip
    print(summary(torch.cat(found), "rotations of visible joints"))
    print(f"seconds: median {torch.tensor(seconds).median():.0f}, most {max(seconds):.0f}")


# -- a body model -------------------------------------------------------------------------------------------------------

TURNED = [
    "spine05", "spine03", "spine01", "neck01", "head", "clavicle.L", "clavicle.R", "upperarm01.L", "upperarm01.R",
    "lowerarm01.L", "lowerarm01.R", "wrist.L", "wrist.R", "upperleg01.L", "upperleg01.R", "lowerleg01.L", "lowerleg01.R",
    "foot.L", "foot.R",
]  # fmt: skip


def model() -> tuple[eg.rig.Rig, Any]:
    """Return the body model anny, of which the bones TURNED rotate."""
    import anny  # type: ignore[import-not-found]
    import roma

    given = anny.Anny(skinning_method="lbs")
    labels = list(given.bone_labels)
    places = torch.tensor([labels.index(name) for name in TURNED])

    def function(rotations: Tensor, **phenotype: Tensor) -> Tensor:
        turns = torch.eye(3, dtype=rotations.dtype).expand(len(rotations), len(labels), 3, 3)
        turns = turns.index_copy(1, places, roma.rotvec_to_rotmat(rotations))
        poses = roma.Rigid(turns, torch.zeros_like(turns[..., 0])).to_homogeneous()
        return given(poses, phenotype)["vertices"]

    controls = {"rotations": eg.rig.Control(torch.zeros(len(TURNED), 3), names=tuple(TURNED), rotates=True)}
    controls |= {
        name: eg.rig.Control(torch.tensor(0.5), torch.tensor(0.0), torch.tensor(1.0)) for name in given.phenotype_labels
    }
    return eg.rig.Rig.from_function(function, given.get_triangular_faces(), controls, batched=True), given


def model_bodies(count: int, first: int, size: int, degrees: float = 20.0) -> None:
    rig, _ = model()
    off, seconds = [], []
    middle, height = rig.center.tolist(), float(rig.meshes[0].verts[:, 2].max() - rig.meshes[0].verts[:, 2].min())
    cameras = []
    for k in range(4):
        a = 0.4 + math.tau * k / 4
        eye = (middle[0] + 2.2 * height * math.sin(a), middle[1] + 2.2 * height * math.cos(a), middle[2] + 0.2 * height)
        cameras.append(eg.Camera.look_at(eye, middle, up=(0, 0, 1), fov_y=40, size=(size, size)))
    for seed in range(first, first + count):
        g = torch.Generator().manual_seed(seed)
        axes = torch.randn(len(TURNED), 3, generator=g, dtype=F64)
        turns = (
            math.radians(degrees)
            * torch.rand(len(TURNED), 1, generator=g, dtype=F64)
            * axes
            / axes.norm(dim=1)[:, None]
        )
        truth = {n: 0.2 + 0.6 * torch.rand((), generator=g, dtype=F64) for n in rig.controls if n != "rotations"}
        with torch.no_grad():
            posed = rig.posed(turns, **truth)  # type: ignore[arg-type]
        assert isinstance(posed, eg.Mesh)
        tall = float(posed.verts[:, 2].max() - posed.verts[:, 2].min())
        began = time.process_time()
        fit = fit_rig(rig, None, cameras, masks=masks_of(posed, cameras), options=FitOptions(seed=seed, progress=False))
        seconds.append(time.process_time() - began)
        found = fit.posed()
        assert isinstance(found, eg.Mesh)
        error = (found.verts - posed.verts).norm(dim=1)
        off.append(float(error.mean()) / tall)
        print(
            f"body {seed}: vertices {off[-1]:.2%} of the height in the mean, {float(error.max()) / tall:.2%} at most; "
            f"{fit.reason[:70]}; {seconds[-1]:.0f} s", flush=True,
        )  # fmt: skip
    share = sum(x <= 0.01 for x in off) / len(off)
    print(f"vertex error within 1 % of the height of {share:.0%} of {len(off)} bodies")
    print(f"seconds: median {torch.tensor(seconds).median():.0f}, most {max(seconds):.0f}")


# -- others -------------------------------------------------------------------------------------------------------------


def arms(count: int, first: int, size: int) -> None:
    with tempfile.TemporaryDirectory() as folder:
        rig = eg.rig.load(arm.write(Path(folder) / "arm.urdf"))
    for seed in range(first, first + count):
        truth, _, found, _, _ = robot.trial(rig, 8, size, seed)
        millimetres, degrees = robot.errors(found, truth)
        print(f"trial {seed}: {millimetres:.2f} mm, {degrees:.4f}°", flush=True)


def stride(phase: float) -> Tensor:
    """Return rotations (20, 3) of the walking figure at a phase from 0 to 1."""
    s, c = math.sin(math.tau * phase), math.cos(math.tau * phase)
    names = [bone[0] for bone in figure.BONES]
    found = torch.zeros(len(names), 3, dtype=F64)

    def turn(name: str, x: float, y: float = 0.0, z: float = 0.0) -> None:
        found[names.index(name)] = torch.tensor([x, y, z], dtype=F64)

    turn("hips", 0.05, 0.12 * s, 0.05 * c)
    turn("chest", 0.0, -0.2 * s)
    turn("head", 0.05 * c, 0.08 * s)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        turn(f"{side} arm", 0.5 * sign * s, 0.0, -0.35 * sign)
        turn(f"{side} elbow", -0.35 - 0.25 * sign * s)
        turn(f"{side} hip", -0.5 * sign * s)
        turn(f"{side} knee", 0.35 + 0.35 * sign * c)
        turn(f"{side} foot", 0.2 * sign * s)
    return found


def walk(count: int, first: int, size: int) -> None:
    rig, cameras = figure.figure(colored=True), figure.cameras(size)
    truths = [stride(k / 24) for k in range(first, first + count)]
    shifts = [torch.tensor([0.01 * k - 0.005 * count, 0.0, 0.0], dtype=F64) for k in range(count)]
    frames = [
        {"masks": masks_of(rig.posed(truth, translation=shift), cameras)}
        for truth, shift in zip(truths, shifts, strict=True)
    ]
    start = {"rotations": truths[0], "translation": shifts[0]}
    began, rotation, direction = time.process_time(), [], []
    options = FitOptions(seed=0, progress=False)
    for k, fit in enumerate(track_rig(rig, frames, cameras, init=start, search=0, options=options)):
        errors = body.Errors.of(rig, fit.values["rotations"], truths[k])
        rotation.append(errors.rotation)
        direction.append(errors.direction)
        if k % 5 == 4:
            print(f"frame {k + 1}: {errors}; {(time.process_time() - began) / (k + 1):.1f} s a frame", flush=True)
    off, turned = torch.stack(rotation), torch.stack(direction)
    print(f"{summary(off.flatten(), 'rotations')}, mean {off.mean():.2f}°")
    print(f"{summary(turned.flatten(), 'directions')}; flips: {int((turned > FLIPPED).any(1).sum())} of {count} frames")


def evaluation(count: int, first: int, size: int) -> None:
    """Time a pose and its gradient (20,000 vertices, 60 joints), and a step of the renderer with the same mesh."""
    g = torch.Generator().manual_seed(first)
    rings, sides, joints = 200, 100, 60
    y, a = torch.linspace(0.0, 2.0, rings), math.tau * torch.arange(sides) / sides
    verts = torch.stack(torch.broadcast_tensors(0.3 * a.cos(), y[:, None], 0.3 * a.sin()), -1).reshape(-1, 3)
    i, j = torch.meshgrid(torch.arange(rings - 1), torch.arange(sides), indexing="ij")
    p, q = i * sides + j, i * sides + (j + 1) % sides
    quads = torch.stack([p, q, q + sides, p + sides], -1).reshape(-1, 4)
    faces = torch.cat([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    share = torch.exp(-0.5 * ((verts[:, 1:2] - torch.linspace(0.0, 2.0, joints)) / 0.05).square())
    hierarchy = eg.rig.Joints(
        [f"joint {k}" for k in range(joints)], [-1, *(max(0, k - 1 - k % 3) for k in range(1, joints))],
        0.1 * torch.rand(joints, 3, generator=g), torch.zeros(joints, 3),
    )  # fmt: skip
    rig = eg.rig.Rig.from_arrays(eg.Mesh(verts, faces, colors=torch.rand(len(verts), 3, generator=g)), hierarchy, share)
    camera = eg.Camera.look_at((0.0, 1.0, 4.0), (0.0, 1.0, 0.0), up=(0, 1, 0), fov_y=40, size=(size, size))
    target = torch.rand(size, size, 3, generator=g)
    own, whole = [], []
    for k in range(count + 3):
        turns = (0.02 * torch.randn(joints, 3, generator=g, dtype=F64)).requires_grad_()
        began = time.perf_counter(), time.process_time()
        posed = rig.posed(turns)
        forward = time.perf_counter() - began[0], time.process_time() - began[1]
        verts = posed.verts.detach().requires_grad_()
        middle = time.perf_counter(), time.process_time()
        (eg.render(posed.replace(verts=verts), camera, 16, k) - target).square().mean().backward()
        step = time.perf_counter() - middle[0], time.process_time() - middle[1]
        again = time.perf_counter(), time.process_time()
        posed.verts.backward(verts.grad)
        backward = time.perf_counter() - again[0], time.process_time() - again[1]
        if k >= 3:
            own.append([a + b for a, b in zip(forward, backward, strict=True)])
            whole.append(step)
    ours, theirs = (torch.tensor(x).mul(1000.0).quantile(0.25, 0).tolist() for x in (own, whole))
    print(
        f"{len(rig.meshes[0].verts)} vertices, {joints} joints: a pose and its gradient {ours[0]:.1f} ms ({ours[1]:.1f} ms of"
    )
    print(
        f"processors), a step of the renderer at {size}² {theirs[0]:.1f} ms ({theirs[1]:.1f} ms): {ours[1] / theirs[1]:.2f} of it"
    )


ROWS = {
    "body": (bodies, 10, 192), "picture": (picture, 10, 192), "anny": (model_bodies, 20, 192), "arm": (arms, 4, 192),
    "walk": (walk, 60, 128), "evaluation": (evaluation, 40, 256),
}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("row", choices=ROWS)
    parser.add_argument("--count", type=int)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--size", type=int, help="pixels")
    told = parser.parse_args()
    run, count, size = ROWS[told.row]
    run(told.count or count, told.first, told.size or size)


if __name__ == "__main__":
    main()
