"""Measurements that need a fresh process, which speed starts:
python -m benchmarks.fresh import | first cube | first sphere | steps edgegrad | steps torch | memory"""

from __future__ import annotations

import ctypes
import json
import statistics
import sys
import time
from pathlib import Path

# edgegrad and common are imported where they are timed.


def import_seconds() -> dict[str, float]:
    """Return the seconds of importing edgegrad after torch."""
    import torch  # noqa: F401

    begin = time.perf_counter()
    import edgegrad  # noqa: F401

    return {"seconds": time.perf_counter() - begin}


def first_render(name: str) -> dict[str, float]:
    """Return seconds of the first render of the process, and of later ones: vertices moved, and the same again."""
    import torch

    import edgegrad as eg

    from .common import single, sphere

    if name == "cube":
        from .scenes import cube, front_camera

        mesh, camera = single(cube()), front_camera(64)
    else:
        mesh, camera, _ = sphere(512)

    def render(shift: float) -> float:
        moved = mesh.replace(verts=mesh.verts + shift)
        begin = time.perf_counter()
        with torch.no_grad():
            eg.render(moved, camera)
        return time.perf_counter() - begin

    first = render(0.0)
    moved = statistics.median(render(1e-3 * k) for k in range(1, 10))
    return {"first": first, "moved": moved, "same": statistics.median(render(9e-3) for _ in range(9))}


def steps(first: str, repeats: int = 50) -> dict[str, float]:
    """Return median and 90 % quantile of the seconds of a step as users write it, by what was imported first."""
    if first == "edgegrad":
        import edgegrad as eg

        # isort: split
        import torch
    else:
        import torch

        # isort: split
        import edgegrad as eg
    from .common import sphere

    mesh, camera, _ = sphere(256)
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
    seconds = sorted(seconds[3:])
    return {"median": statistics.median(seconds), "slow": seconds[int(0.9 * repeats)]}


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
