"""Measurements that need a fresh process, which speed starts:
python -m benchmarks.fresh import | first cube | first sphere | steps cube | steps sphere | memory"""

from __future__ import annotations

import ctypes
import json
import statistics
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from edgegrad import Camera, Mesh

# edgegrad and common are imported where they are timed.


def scene_of(name: str, cube_size: int, sphere_size: int) -> tuple[Mesh, Camera]:
    """Return mesh and camera of "cube" or "sphere"."""
    if name == "cube":
        from .common import single
        from .scenes import cube, front_camera

        return single(cube()), front_camera(cube_size)
    from .common import sphere

    return sphere(sphere_size)[:2]


def import_seconds() -> dict[str, float]:
    """Return the seconds of importing edgegrad after torch."""
    import torch  # noqa: F401

    begin = time.perf_counter()
    import edgegrad as eg

    _ = eg.render, eg.Scene, eg.Camera  # the package imports its modules on first use of their names
    return {"seconds": time.perf_counter() - begin}


def first_render(name: str) -> dict[str, float]:
    """Return seconds of the first render of the process, and of later ones: vertices moved, and the same again."""
    import torch

    import edgegrad as eg

    mesh, camera = scene_of(name, cube_size=64, sphere_size=512)

    def render(shift: float) -> float:
        moved = mesh.replace(verts=mesh.verts + shift)
        begin = time.perf_counter()
        with torch.no_grad():
            eg.render(moved, camera)
        return time.perf_counter() - begin

    first = render(0.0)
    moved = statistics.median(render(1e-3 * k) for k in range(1, 10))
    return {"first": first, "moved": moved, "same": statistics.median(render(9e-3) for _ in range(9))}


def steps(name: str, repeats: int = 50) -> dict[str, float]:
    """Return the median of the seconds of a step as users write it."""
    import torch

    import edgegrad as eg

    mesh, camera = scene_of(name, cube_size=64, sphere_size=256)
    target = eg.render(mesh.replace(verts=mesh.verts * 1.05), camera)
    verts = mesh.verts.clone().requires_grad_()
    optimizer = torch.optim.Adam([verts], lr=1e-5)
    seconds = []
    for k in range(repeats + 3):
        begin = time.perf_counter()
        optimizer.zero_grad()
        image = eg.render(mesh.replace(verts=verts), camera, seed=k)
        ((image - target).square().mean() + 1e-3 * (image[1:] - image[:-1]).abs().mean()).backward()
        optimizer.step()
        seconds.append(time.perf_counter() - begin)
    return {"median": statistics.median(seconds[3:])}


def memory(height: int = 1080, width: int = 1920, spp: int = 64) -> dict[str, float]:
    """Return the peak of bytes that an image and its gradients take beyond scene, image, adjoint and gradients."""
    import edgegrad as eg

    from .common import single, sphere
    from .scenes import cube, front_camera

    mesh, camera, adjoint = sphere((height, width))
    # Code, threads and what torch keeps of a first backward pass are not this image's.
    tiny = single(cube())
    eg.render(tiny.replace(verts=tiny.verts.requires_grad_()), front_camera(16)).sum().backward()
    assert mesh.colors is not None
    verts, colors = mesh.verts.clone().requires_grad_(), mesh.colors.clone().requires_grad_()
    mesh = mesh.replace(verts=verts, colors=colors)
    if hasattr(libc := ctypes.CDLL(None), "malloc_trim"):
        libc.malloc_trim(0)  # freed pages would hide what is taken now
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status("VmRSS")
    image = eg.render(mesh, camera, spp=spp)
    image.backward(adjoint)
    peak = _status("VmHWM")
    assert verts.grad is not None and colors.grad is not None
    expected = sum(t.numel() * t.element_size() for t in (image, verts.grad, colors.grad))
    return {"bytes": peak - before - expected}


def _status(key: str) -> int:
    """Return bytes of an entry of /proc/self/status."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith(key + ":"))


if __name__ == "__main__":
    what, *rest = sys.argv[1:]
    print(json.dumps({"import": import_seconds, "first": first_render, "steps": steps, "memory": memory}[what](*rest)))
