"""edgegrad doctor: what is installed, and whether a gradient comes out right."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import time
from typing import Any

from .. import __version__

LIBRARIES = ("torch", "numpy", "embreex", "trimesh", "OpenImageIO")
# The extra that brings a library, and its purpose.
OPTIONAL = {
    "pillow": "files, figures: textures of meshes, labels of masks",
    "lxml": "files: 3MF",
    "DracoPy": "files: compressed glTF",
    "pyyaml": "cameras: calibrations of OpenCV, ROS and Kalibr",
    "matplotlib": "figures: of fits and reports",
    "pyvista": "demo",
    "mitsuba": "peers: compared in `make report`",
    "scipy": "fit: nearest points",
    "cholespy": "fit: smooth steps of shapes",
    "gpytoolbox": "fit: remeshing, visual hulls",
    "xatlas": "fit: unwrapping",
}
TOLERANCE = 0.02  # of the gradient's size; the sampling error is 0.1 %


class Version(argparse.Action):
    """Print the version of the installed package, or of one that is only on the path, and end."""

    def __call__(self, *_: object) -> None:
        print(f"edgegrad {__version__}")
        raise SystemExit(0)


def add(commands: Any) -> None:
    parser = commands.add_parser("doctor", help="what is installed, and a check", description=run.__doc__)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Show versions, Embree, the processor's instructions and threads, and check a gradient against its closed form. The exit
    code is 1 if that is wrong."""
    import torch

    from ..library import core, embree_path

    lines = {"edgegrad": __version__, "Python": f"{platform.python_version()} on {platform.platform()}"}
    lines |= {name: _version(name) or "not installed" for name in LIBRARIES}
    number = core.embree_version()
    lines["Embree"] = f"{number // 10000}.{number // 100 % 100}.{number % 100}, {embree_path()}"
    lines["OpenMP"] = core.openmp_runtime()
    lines["kernel"] = core.__file__
    lines["processor"] = (
        f"{torch.backends.cpu.get_cpu_capability()}; rays in packets of {core.packet_width()}, "
        f"{os.cpu_count()} processors, {torch.get_num_threads()} threads (torch.set_num_threads)"
    )
    for name, text in lines.items():
        print(f"{name:12} {text}")
    print("extras, pip install 'edgegrad[EXTRA]':")
    for name, text in OPTIONAL.items():
        extra, _, purpose = text.partition(": ")
        print(f"  {name:24} {_version(name) or '-':12} [{extra}] {purpose}".rstrip())
    start = time.perf_counter()
    error = gradient_error()
    good = error <= TOLERANCE
    verdict = "right" if good else f"WRONG, more than {TOLERANCE:.0%}: please report it with all of the above"
    print(f"gradient     {error:.2%} off its closed form after {time.perf_counter() - start:.2f} s: {verdict}")
    return 0 if good else 1


def gradient_error() -> float:
    """Return the relative error of the derivative of a triangle's area in the image by its vertices.

    The sum of an image of a white triangle is its area in pixels, ½ |(b − a) × (c − a)|. Its derivative by a is half the
    opposite side, rotated by 90°. All of it comes from silhouettes.
    """
    import torch

    from .. import Camera, Mesh, Sampling, render

    verts = torch.tensor([[-0.7, -0.6, 0.0], [0.8, -0.3, 0.0], [-0.1, 0.75, 0.0]], dtype=torch.float64)
    mesh = Mesh(verts.clone().requires_grad_(), torch.tensor([[0, 1, 2]]), colors=torch.ones(3, 1))
    camera = Camera.orthographic((0, 0, 2), (0, 0, 0), height=2.0, size=(64, 64))
    render(mesh, camera, spp=4, seed=0, sampling=Sampling(edges=4096)).sum().backward()
    assert mesh.verts.grad is not None
    found = mesh.verts.grad[:, :2]
    sides = verts.roll(-2, 0) - verts.roll(-1, 0)  # opposite to each vertex
    exact = 0.5 * 32**2 * torch.stack([-sides[:, 1], sides[:, 0]], -1)  # 32 pixels a unit; counterclockwise
    return float((found - exact).norm() / exact.norm())


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None
