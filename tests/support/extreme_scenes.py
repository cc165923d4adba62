"""Random scenes with extreme numbers and degenerate topology, for tests/rays/test_extreme.py. From the shell, many of them:

python tests/support/extreme_scenes.py FIRST COUNT
"""

from __future__ import annotations

import math
import signal
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scenes import icosphere
from torch import Tensor

import edgegrad as eg

F32, F64 = torch.float32, torch.float64
LARGEST = float(torch.finfo(F32).max)
SECONDS = 30.0  # of a processor, for a scene; hundreds of coincident curves, whose cost is a square, may take 10


class TooSlow(Exception):
    """A scene that takes longer."""


def _tensor(x: np.ndarray, dtype: torch.dtype) -> Tensor:
    return torch.from_numpy(np.clip(x, -LARGEST, LARGEST)).to(dtype)


def _magnitude(r: np.random.Generator) -> float:
    return 10.0 ** r.uniform(-38, 38)


def _numbers(r: np.random.Generator, n: int, width: int) -> np.ndarray:
    """Return numbers of ordinary size, all of another size, each of its own, on a lattice, or with zeros and copies among
    them."""
    x = r.normal(size=(n, width))
    match r.integers(7):
        case 0:
            x *= _magnitude(r)
        case 1:
            x *= 10.0 ** r.uniform(-38, 38, (n, 1))
        case 2:
            x = np.round(2 * x) / 2
        case 3:
            x[:, r.integers(width)] = 0.0
        case 4:
            x = x[r.integers(max(1, n // 4), size=n)]
    if r.random() < 0.2:
        x = x + r.normal(size=width) * 10.0 ** r.uniform(0, 12)  # far from the origin
    if r.random() < 0.1:
        x[r.integers(n)] *= _magnitude(r)
    if r.random() < 0.1:
        x = x + 1e-16 * r.normal(size=x.shape) * np.abs(x)  # copies that are off by roundings
    return x


def _topology(r: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and faces (F, 3)."""
    n = int(10.0 ** r.uniform(0, 3))
    kind = r.integers(8)
    if kind == 0:  # whatever
        V = max(1, int(r.integers(1, 2 + n // 2)))
        return _numbers(r, V, 3), r.integers(V, size=(n, 3))
    if kind == 1:  # a soup
        return _numbers(r, 3 * n, 3), np.arange(3 * n).reshape(n, 3)
    if kind == 2:  # a fan
        a = np.linspace(0, 2 * math.pi, n + 1)[:-1]
        ring = np.stack([np.cos(a), np.sin(a), np.full(n, r.choice([0.0, 1.0]))], -1)
        i = np.arange(n)
        return np.concatenate([np.zeros((1, 3)), ring]), np.stack([0 * i, 1 + i, 1 + (i + 1) % n], -1)
    if kind == 3:  # pages of a book, on one edge
        i = np.arange(n)
        return _numbers(r, n + 2, 3), np.stack([0 * i, 0 * i + 1, i + 2], -1)
    if kind == 4:  # everything in one place
        return np.tile(_numbers(r, 1, 3), (3 * n, 1)), np.arange(3 * n).reshape(n, 3)
    if kind == 5:  # one face many times
        return _numbers(r, 3, 3), np.tile(np.arange(3), (n, 1))
    if kind == 6:  # a grid, as a soup or not
        m = max(1, int(math.sqrt(n / 2)))
        x, y = np.meshgrid(np.linspace(-1, 1, m + 1), np.linspace(-1, 1, m + 1), indexing="ij")
        v = np.stack([x, y, 0.0 * x], -1).reshape(-1, 3)
        i = np.arange(m * (m + 1)).reshape(m, m + 1)[:, :-1].reshape(-1)
        f = np.concatenate([np.stack([i, i + 1, i + m + 1], -1), np.stack([i + 1, i + m + 2, i + m + 1], -1)])
        return (v, f) if r.random() < 0.5 else (v[f].reshape(-1, 3), np.arange(3 * len(f)).reshape(-1, 3))
    ball = icosphere(int(r.integers(3)))
    return ball.verts.double().numpy().copy(), ball.faces.numpy().copy()


def _mesh(r: np.random.Generator, unit: float) -> eg.Mesh:
    verts, faces = _topology(r)
    if r.random() < 0.3:
        verts = verts @ np.linalg.qr(r.normal(size=(3, 3)))[0]
    with np.errstate(over="ignore"):
        verts = verts * unit
    dtype = F32 if r.random() < 0.5 else F64
    V, F, C = len(verts), len(faces), 3

    def radiance(n: int) -> Tensor:
        x = r.normal(size=(n, C))
        return _tensor(x * _magnitude(r) if r.random() < 0.1 else x, dtype)

    appearance: dict[str, Any] = {}
    match r.integers(5):
        case 0:
            appearance["colors"] = radiance(V)
        case 1:
            appearance["face_colors"] = radiance(F)
        case 2:
            appearance["corner_colors"] = radiance(3 * F).reshape(F, 3, C)
        case 3:
            appearance["texture"] = radiance(12).reshape(3, 4, C)
            appearance["uvs"], appearance["uv_faces"] = _tensor(_numbers(r, V, 2), dtype), torch.from_numpy(faces)
    return eg.Mesh(_tensor(verts, dtype), torch.from_numpy(faces), **appearance)


def _camera(r: np.random.Generator, meshes: list[eg.Mesh], unit: float) -> eg.Camera:
    size = int(r.integers(1, 24)), int(r.integers(1, 24))
    verts = np.concatenate([m.verts.double().numpy() for m in meshes])
    faces = meshes[0].faces.numpy()
    corners = meshes[0].verts.double().numpy()[faces[r.integers(len(faces))]]
    target = [np.zeros(3), verts[r.integers(len(verts))], corners.mean(0), corners[:2].mean(0)][r.integers(4)]
    match r.integers(6):
        case 0:  # in a vertex
            eye = verts[r.integers(len(verts))]
        case 1:  # in the plane of a face
            eye = r.normal(size=3) @ corners
        case 2:  # on an axis
            eye = target + unit * r.choice([-3.0, 1.0, 3.0]) * np.eye(3)[r.integers(3)]
        case 3:  # at any distance
            eye = target + r.normal(size=3) * _magnitude(r)
        case _:
            eye = target + 3 * unit * r.normal(size=3)
    up = np.eye(3)[r.integers(3)] if r.random() < 0.5 else r.normal(size=3)
    eye, target = (_tensor(x, F64) for x in (eye, target))
    if r.random() < 0.4:
        height = unit * (_magnitude(r) if r.random() < 0.2 else r.uniform(0.5, 4.0))
        return eg.Camera.orthographic(
            eye, target, _tensor(up, F64), height=float(np.clip(height, 1e-38, 1e38)), size=size
        )
    fov = r.uniform(1, 179) if r.random() < 0.7 else 10.0 ** r.uniform(-6, 1)
    return eg.Camera.look_at(eye, target, _tensor(up, F64), float(fov), size)


def _adjoint(r: np.random.Generator, image: Tensor) -> Tensor:
    A = torch.from_numpy(r.normal(size=tuple(image.shape)))
    match r.integers(5):
        case 0:
            A[:] = 0
        case 1:
            one = torch.zeros_like(A)
            i, j = r.integers(A.shape[0]), r.integers(A.shape[1])
            one[i, j] = A[i, j]
            A = one
        case 2:
            A *= _magnitude(r)
    return A.clamp(-LARGEST, LARGEST).to(image.dtype)


def most_samples(scene: eg.Scene, camera: eg.Camera) -> int:
    """Return what the defaults may come to: every face over the whole view, and all of its sides across it."""
    faces = sum(len(mesh.faces) for mesh in scene.meshes)
    h, w = (n + 3 for n in camera.size)  # with the filter
    return int(faces * (4 * (h * w + math.hypot(h, w)) + 3 * 24 * math.hypot(h, w)) + 4 * h * w + 2)


def run(seed: int) -> str:
    """Plans, draws and differentiates the scene of a seed; "right", or the argument that was refused.

    Raises TooSlow, or AssertionError where something is not as it should be.
    """

    def stop(*_: object) -> None:
        raise TooSlow(seed)

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        return _run(seed)
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _run(seed: int) -> str:
    r = np.random.default_rng(seed)
    unit = _magnitude(r) if r.random() < 0.25 else 1.0
    leaves: list[Tensor] = []

    def leaf(x: Tensor) -> Tensor:
        leaves.append(x.requires_grad_())
        return x

    try:
        meshes = [_mesh(r, unit) for _ in range(r.choice([1, 1, 2, 3]))]
        camera = _camera(r, meshes, unit)
    except ValueError as error:  # such as an eye in the target
        return _refused(error)
    for mesh in meshes:
        for x in vars(mesh).values():
            if isinstance(x, Tensor) and x.is_floating_point() and r.random() < 0.8:
                leaf(x)
    if r.random() < 0.5:
        leaf(camera.world_to_camera), leaf(camera.K)
    background = torch.from_numpy(r.normal(size=3)) if r.random() < 0.5 else None
    scene = eg.Scene(meshes, background)
    options: dict[str, Any] = {"filter": str(r.choice(["box", "tent", "gaussian"])), "spp": int(r.integers(1, 5))}
    try:
        plan = eg.plan(scene, camera, **options)
        samples = sum(plan[term].samples for term in ("interior", "boundary"))
        assert samples <= most_samples(scene, camera), f"{samples:,} samples planned"
        image = eg.render(scene, camera, seed=seed, **options)
        assert not bool(image.isnan().any()), "a pixel that is not a number"
        if not image.requires_grad:
            return "right"
        grads = torch.autograd.grad(image, leaves, _adjoint(r, image), allow_unused=True)
    except ValueError as error:
        return _refused(error)
    for grad in grads:
        if grad is not None:
            assert not bool(grad.isnan().any()), "a gradient that is not a number"
            # What is beyond the range of float32 becomes infinite where that is the type of the gradient.
            assert grad.dtype == F32 or bool(grad.isfinite().all()), "a gradient that is infinite"
    return "right"


ARGUMENTS = (
    "verts", "uvs", "eye", "target", "up", "fov_y", "height", "K", "world_to_camera", "the gradient of the image",
)  # fmt: skip


def _refused(error: ValueError) -> str:
    """The argument that an error names."""
    name = str(error).partition(":")[0]
    assert name in ARGUMENTS, f"an error that names no argument: {error}"
    return name


def main(first: int, count: int, each: Callable[[int], str] = run) -> int:
    """Runs that many scenes; the number of faults, which it prints."""
    torch.set_num_threads(1)
    found: Counter[str] = Counter()
    faults = 0
    for seed in range(first, first + count):
        try:
            found[each(seed)] += 1
        except (AssertionError, TooSlow, MemoryError, RuntimeError) as error:
            faults += 1
            print(f"seed {seed}: {type(error).__name__}: {error}", flush=True)
    print(f"{count} scenes from {first}: {faults} faults; {dict(found)}")
    return faults


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]), int(sys.argv[2])) > 0)
