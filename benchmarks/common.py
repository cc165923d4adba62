"""What rows of speed share: a sphere, passes of the kernel, steps of an optimisation, converged gradients."""

from __future__ import annotations

import pickle
import time
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import edgegrad as eg
from edgegrad.files.paths import replacing
from edgegrad.kernel.operators import HitBuffers, Profile, kernel_camera, kernel_channels, kernel_hits, kernel_scene
from edgegrad.kernel.request import make_request
from edgegrad.library import core, load

from .error_time.methods import differentiate
from .error_time.references import standard_error
from .scenes import ReportScene, icosphere, smooth_adjoint

parts = load("_core_tests")  # what only tests and benchmarks call


def sphere(size: int | tuple[int, int], subdivisions: int = 6) -> tuple[eg.Mesh, eg.Camera, Tensor]:
    """The icosphere (6: 81,920 faces) with smooth colours in float32, a camera (height, width), a smooth adjoint image."""
    height, width = (size, size) if isinstance(size, int) else size
    camera = eg.Camera.look_at((0.9, 0.7, 3.2), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 40.0, (height, width))
    return single(icosphere(subdivisions)), camera, smooth_adjoint(height, width, 3).float()


def single(mesh: eg.Mesh) -> eg.Mesh:
    """Return the mesh with vertices and colours in float32, as users have them."""
    assert mesh.colors is not None
    return mesh.replace(verts=mesh.verts.float(), colors=mesh.colors.float())


class Kernel:
    """The two passes of the kernel for a scene, without the overhead of torch and Python."""

    def __init__(self, scene: eg.Scene | eg.Mesh, camera: eg.Camera, adjoint: Tensor, spp: int = 16) -> None:
        request = make_request(scene, camera, spp)
        flat, self.options = request.scene, core.ImageOptions(**request.image._asdict())
        self.scene, self.camera = kernel_scene(flat), kernel_camera(request.camera)
        self.channels = kernel_channels(request)
        self.adjoint = adjoint.to(flat.colors.dtype).contiguous()
        self.image = torch.empty_like(self.adjoint)
        self.interior = request.gradient.channels_vary
        self.hits = kernel_hits(HitBuffers.empty(request))
        appearance = ("uvs", "texels") if len(flat.textures) else ("colors",)
        self.grads = {
            name: torch.zeros_like(request.slot(name), dtype=torch.float64) for name in ("verts", *appearance)
        }
        self.profile: Profile = {}  # of the last pass
        self.forward()

    def forward(self, threads: int | None = None) -> float:
        """Write `image` and return the seconds."""
        threads = threads or torch.get_num_threads()
        begin = time.perf_counter()
        self.profile = self.scene.forward(
            self.camera, self.channels, self.options, threads, self.image.numpy(), self.hits
        )
        return time.perf_counter() - begin

    def backward(
        self,
        surface_samples: int = -1,
        edge_samples: int = -1,
        seed: int = 0,
        *,
        interior: bool | None = None,
        boundary: bool = True,
        appearance: bool = False,
        threads: int | None = None,
    ) -> float:
        """Write `grads`, of vertices and with `appearance` of colours or texels, and return the seconds."""
        wanted = {name: grad.zero_().numpy() for name, grad in self.grads.items() if appearance or name == "verts"}
        options = core.GradientOptions(
            surface_samples=surface_samples,
            edge_samples=edge_samples,
            seed=seed,
            interior_geometry=self.interior if interior is None else interior,
            boundary=boundary,
        )
        threads = threads or torch.get_num_threads()
        begin = time.perf_counter()
        self.profile = self.scene.backward(
            self.camera, self.channels, self.options, options, threads, self.adjoint.numpy(), self.hits, wanted
        )
        return time.perf_counter() - begin

    def gradient(self, surface_samples: int, edge_samples: int, seed: int, **terms: Any) -> tuple[Tensor, float]:
        """Return ∂(image · adjoint)/∂verts (V, 3) and the seconds of the backward pass."""
        seconds = self.backward(surface_samples, edge_samples, seed, **terms)
        return self.grads["verts"].clone(), seconds

    def default_samples(self) -> tuple[int, int]:
        """Return the default numbers of surface samples and edge samples."""
        self.backward()
        return int(self.profile["surface_samples"]), int(self.profile["edge_samples"])

    def references(self) -> tuple[Tensor, Tensor]:
        """Return converged gradients (V, 3) of both terms: 128 times the default surface samples, 512 times the edge samples."""
        surface, edge = self.default_samples()
        inside, _ = self.gradient(128 * surface, -1, 991, boundary=False)
        edges, _ = self.gradient(-1, 512 * edge, 992, interior=False)
        return inside, edges


class Step:
    """Steps of an optimisation as a user writes them: update after the vertices moved, image, backward."""

    def __init__(self, mesh: eg.Mesh, camera: eg.Camera, adjoint: Tensor) -> None:
        self.mesh, self.camera, self.adjoint = mesh, camera, adjoint
        # Vertices elsewhere by a thousandth, so that a step cannot take what the kernel keeps of the last one.
        self._elsewhere = mesh.replace(verts=mesh.verts * 1.001)

    def __call__(self, spp: int = 16, **options: Any) -> tuple[Tensor, float]:
        """Return ∂(image · adjoint)/∂verts (V, 3) float64 and the seconds of the step."""
        with torch.no_grad():
            eg.render(self._elsewhere, self.camera, spp=1)
        begin = time.perf_counter()
        verts = self.mesh.verts.detach().clone().requires_grad_()
        eg.render(self.mesh.replace(verts=verts), self.camera, spp=spp, **options).backward(self.adjoint)
        seconds = time.perf_counter() - begin
        assert verts.grad is not None
        return verts.grad.double(), seconds


class Converged:
    """The gradient ∂loss/∂verts (V, 3) of a scene from long runs: up to 20 seconds, once. It is then kept in `folder`.

    The numbers of samples are given, not the kernel's defaults, and the estimate is unbiased: so kernels that place samples
    otherwise have the same expected value, and the file is keyed by the scene and the counts alone. `made_by` names the
    kernel that wrote it; after a change of what the expected value is (a rule for coincident edges, say) remove the file.
    """

    # One random shift moves all samples of a run, and where faces pass through each other too often each run draws lines of
    # its own, however many samples it has.
    RUNS = 64

    def __init__(
        self, scene: ReportScene, folder: Path, kernel: str, surface: int = 1 << 19, edge: int = 1 << 20
    ) -> None:
        path = folder / f"converged-{scene.fingerprint}-{surface}-{edge}.pt"
        try:
            kept = torch.load(path, weights_only=True)
        except (OSError, pickle.UnpicklingError, RuntimeError, EOFError, ValueError):
            # Of an image of 16 samples a pixel: which faces it sees steers where the gradient's samples go.
            options = {"spp": 16, "sampling": eg.Sampling(surface=surface, edges=edge)}
            runs = [differentiate(scene, seed=(1 << 40) + run, **options)[0] for run in range(self.RUNS)]
            kept = {"gradient": torch.stack(runs).mean(0), "error": standard_error(runs), "made_by": kernel}
            folder.mkdir(parents=True, exist_ok=True)
            with replacing(path) as temporary:
                torch.save(kept, temporary)
        self.gradient: Tensor = kept["gradient"]
        self.norm = float(self.gradient.norm())
        self.own_error: float = kept["error"] / self.norm
        self.made_by: str = kept["made_by"]

    def error(self, gradients: list[Tensor]) -> float:
        """Return ‖g − g*‖ / ‖g*‖, root mean square, less what the error of g* itself adds."""
        squares = [float(((gradient - self.gradient) ** 2).sum()) / self.norm**2 for gradient in gradients]
        return max(0.0, sum(squares) / len(squares) - self.own_error**2) ** 0.5
