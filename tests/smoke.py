"""Whether an installed edgegrad works: python tests/smoke.py. Needs what edgegrad itself requires, and nothing else."""

from __future__ import annotations

import importlib.util
import tempfile
from pathlib import Path

import torch
import trimesh

import edgegrad as eg
from edgegrad.cli import main
from edgegrad.cli.doctor import gradient_error
from edgegrad.fit import FitOptions, fit_pose, fit_shape


def painted() -> eg.Mesh:
    ball = trimesh.creation.icosphere(2)
    verts = torch.from_numpy(ball.vertices.copy()).float() * torch.tensor([1.0, 0.6, 0.4])
    return eg.Mesh(verts, torch.from_numpy(ball.faces.copy()), colors=0.5 + 0.4 * torch.sin(5.0 * verts))


def edges() -> None:
    """A gradient that comes from silhouettes alone, against its closed form."""
    assert gradient_error() < 0.02


def light() -> None:
    """A shadow's border has a gradient: of the sum of an image by the direction of the light, against a difference."""
    mesh, ground = painted().replace(material=eg.Material()), torch.tensor([[-4.0, -1, -4], [4, -1, -4], [0, -1, 6]])
    floor = eg.Mesh(ground, torch.tensor([[0, 1, 2]]), material=eg.Material())
    camera = eg.Camera.look_at((0, 3, 5), (0, 0, 0), size=(48, 48))

    def total(x: torch.Tensor, seed: int) -> torch.Tensor:
        sun = eg.lights.DirectionalLight(torch.stack([x, -torch.ones_like(x), -0.3 * torch.ones_like(x)]), 3.0)
        return eg.render(
            eg.Scene([mesh, floor], lights=[sun]), camera, spp=64, seed=seed, sampling=eg.Sampling(edges=20_000)
        ).sum()

    x = torch.tensor(0.4, requires_grad=True)
    total(x, 1).backward()
    with torch.no_grad():
        slope = (total(x + 0.05, 2) - total(x - 0.05, 2)) / 0.1
    assert x.grad is not None and abs(float(x.grad / slope) - 1.0) < 0.1, (x.grad, slope)


def files_and_fits() -> None:
    """A pose is found again, and what is written is read; also from the command line."""
    mesh, camera = painted(), eg.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, size=(64, 64))
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.1, 0.05], [0.1, 0, -0.1], [-0.05, 0.1, 0]]))
    target = eg.render(mesh.transformed(turn), camera, spp=64, seed=1)
    fit = fit_pose(eg.Scene([mesh], torch.zeros(3)), target, camera, options=FitOptions(seed=0, progress=False))
    error = torch.rad2deg(torch.acos(((fit.R.T.to(turn) @ turn).trace() / 2 - 0.5).clamp(-1, 1)))
    assert fit.converged and float(error) < 0.5, (fit.reason, error)
    with tempfile.TemporaryDirectory() as folder:
        model, picture = Path(folder) / "mesh.ply", Path(folder) / "picture.png"
        eg.save_mesh(model, mesh)
        eg.write_image(picture, target)
        assert torch.allclose(eg.read_image(picture, channels=3), target.clamp(0, 1), atol=0.01)
        assert main(["render", str(model), "--out", str(Path(folder) / "out.png"), "--size", "32x32"]) == 0


def extras() -> None:
    """What needs a library that is not installed names the extra that brings it."""
    mesh, camera = painted(), eg.Camera.look_at((0, 0, 4), (0, 0, 0), fov_y=40, size=(16, 16))
    image = eg.render(mesh, camera, seed=0)
    fit = fit_pose(eg.Scene([mesh], torch.zeros(3)), image, camera, options=FitOptions(seed=0, progress=False, steps=1))
    needs = {
        "matplotlib": ("figures", fit.plot),
        "gpytoolbox": (
            "fit",
            lambda: fit_shape(mesh, [image], [camera], options=FitOptions(seed=0, steps=1, progress=False)),
        ),
        "xatlas": ("fit", lambda: eg.textures.unwrap(mesh)),
    }
    for library, (extra, call) in needs.items():
        if importlib.util.find_spec(library) is None:
            try:
                call()
            except ImportError as error:
                assert f"pip install 'edgegrad[{extra}]'" in str(error), error
            else:
                raise AssertionError(f"works without {library}")


if __name__ == "__main__":
    for check in (edges, light, files_and_fits, extras):
        check()
        print(f"{check.__name__}: right")
