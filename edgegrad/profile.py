"""profile(): where the time of a step goes."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from .camera.camera import Camera
from .check import as_tensor, check_finite, check_float, check_positive_int, check_shape
from .kernel import memory as memory
from .kernel.counts import CURVES, Watch, table
from .kernel.operators import backward_kernel, forward_kernel
from .kernel.request import Request, make_request, required
from .light.radiance import Lighting
from .light.unused_options import warn_of_unused
from .sampling import RenderOptions, check_options, check_sampling, drawn_seed, without_shading
from .scene.mesh import Mesh
from .scene.scene import Scene, as_scene
from .scene.tree import map_tensors, tensors_in

if TYPE_CHECKING:
    from typing_extensions import Unpack

# The kernel measures these parts, in the order of a step.
_PARTS = (
    "update", "forward", "view", "surface measure", "surface rays", "surface scatter", "curves", "edge rays",
    "edge scatter", "discontinuity rays", "discontinuity scatter", "world",
)  # fmt: skip
# These parts are always shown where points are shaded: in lit scenes, and around mipmaps.
_SHADED = ("image", "samples", "surface shading", "edge shading", "discontinuities", "shadows")
# These are shown where light is scattered more than once.
_INDIRECT = ("indirect shadows", "secondary edges")
_BAR = 24  # characters of a bar of 100 %


class Profile(Mapping[str, float]):
    """Median seconds of each part of a step, by name, and `samples`, how many of each kind. Prints as a table.

        update           for vertices that moved: the ray structure, who meets at edges, which faces pass through each other
        forward          the image
        view             vertices in the image, the importance map of the loss, and the background's gradient
        surface …        triangles laid end to end; samples and their rays; adding what they found
        curves, edge …   the same at edges
        discontinuity …  the same at discontinuities within faces
        world            from camera coordinates to the user's arrays
        python           all the rest: checks and copies of tensors

    In lit scenes, and where textures have mipmaps, points are shaded, and their shading is differentiated by autograd:

        image              with what is made for vertices that moved
        samples            of the gradient, inside faces and at edges, and their rays
        surface shading    inside faces
        edge shading       on both sides of edges
        discontinuities    finding, and shading on both sides of, texel edges
        shadows            the same of shadow boundaries
        indirect shadows   the same of those on surfaces that the camera does not see directly, with bounces above 1
        secondary edges    the same of edges seen from shading points, with bounces above 1
        backward           what autograd runs
        python             all the rest
    """

    def __init__(self, seconds: Mapping[str, float], samples: Mapping[str, int]) -> None:
        self._seconds, self.samples = dict(seconds), dict(samples)

    def __getitem__(self, name: str) -> float:
        try:
            return self._seconds[name]
        except KeyError:
            raise KeyError(f"part: expected one of {', '.join(self._seconds)}, got {name!r}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._seconds)

    def __len__(self) -> int:
        return len(self._seconds)

    @property
    def seconds(self) -> float:
        """Return the seconds of the whole step."""
        return sum(self.values())

    def __str__(self) -> str:
        rows = [("part", "ms", "share", "")]
        for name, seconds in self.items():
            share = seconds / self.seconds
            rows.append((name, f"{1e3 * seconds:.2f}", f"{100 * share:.0f} %", "█" * round(_BAR * share)))
        rows.append(("in all", f"{1e3 * self.seconds:.2f}", "", ""))
        counts = ", ".join(f"{name.replace('_', ' ')} {count:,}" for name, count in self.samples.items())
        return table(rows, "<>><") + "\n" + counts

    __repr__ = __str__


def profile(
    scene: Scene | Mesh,
    camera: Camera,
    adjoint: Tensor | None = None,
    spp: int = 16,
    seed: int | None = 0,
    *,
    repeats: int = 5,
    **options: Unpack[RenderOptions],
) -> Profile:
    """Measure where the time of a step goes: vertices that moved, an image, and the gradient of what requires one.

    If nothing requires a gradient, that of the vertices is taken. A batch of cameras
    counts as one step. Of scenes that are not lit, autograd itself is not run, so its cost is not included.

    Parameters
    ----------
    scene, camera, spp
        As of render().
    adjoint : (H, W, C) or (B, H, W, C), default ones
        ∂loss/∂image.
    seed : int, default 0
        As of render(), but fixed by default.
    repeats : int, default 5
        Steps of which the medians are taken.
    **options
        Other arguments of render(), but for `shader`.

    Returns
    -------
    Profile
        Mapping from the name of a part to its seconds; prints as a table.

    Raises
    ------
    TypeError, ValueError, MemoryError
        What render() raises.
    """
    check_options("profile", options)
    if options.get("shader") is not None:
        raise ValueError("shader: expected None, for profile() measures the kernel alone; torch.profiler sees a shader")
    scene, repeats = as_scene(scene), check_positive_int("repeats", repeats)
    seed, sampling = int(drawn_seed(seed, options.pop("generator", None))), check_sampling(options.get("sampling"))
    lighting = Lighting.from_options(options.get("shadows", True), options.get("bounces", 1), sampling)
    own = without_shading(options)
    warn_of_unused(scene, False, lighting, sampling)
    if scene.is_shaded:
        return _of_shaded(scene, camera, adjoint, (spp, seed), repeats, lighting, sampling.creases, own)
    # Caches between calls must not help: before each step the vertices are elsewhere, each time somewhere else.
    request = make_request(scene, camera, spp, seed, **own)
    wanted = required(request) or ("verts",)
    adjoint = _adjoint(adjoint, camera, request)

    runs = []
    for repeat in range(repeats):
        verts = request.scene.verts.detach() * (1.001 + 1e-6 * repeat)
        elsewhere = request._replace(scene=request.scene._replace(verts=verts), image=request.image._replace(spp=1))
        forward_kernel(elsewhere)
        begin = time.perf_counter()
        step = make_request(scene, camera, spp, seed, **own)
        _, hits, forward = forward_kernel(step)
        _, backward = backward_kernel(adjoint, hits, step, wanted)
        wall = time.perf_counter() - begin
        done = _sum([*forward, *backward])
        runs.append({**done, "python": wall - sum(done[part] for part in _PARTS)})
    seconds = {part: statistics.median(run[part] for run in runs) for part in (*_PARTS, "python")}
    samples = {
        "image_samples": adjoint.shape[:-1].numel() * request.image.spp,
        **{name: int(runs[-1][name]) for name in ("surface_samples", "edge_samples", "discontinuity_lines", *CURVES)},
    }
    return Profile(seconds, samples)


def _of_shaded(
    scene: Scene,
    camera: Camera,
    adjoint: Tensor | None,
    spp_and_seed: tuple[int, int],
    repeats: int,
    lighting: Lighting,
    creases: bool | str,
    own: Mapping[str, Any],
) -> Profile:
    """Return the profile of a scene of which points are shaded."""
    scene, camera, leaves = _leaves(scene, camera)
    request = make_request(scene, camera, *spp_and_seed, **own)
    adjoint = _adjoint(adjoint, camera, request)
    runs, watch = [], _Recorder()
    for repeat in range(repeats):
        elsewhere = scene.replace(meshes=[m.replace(verts=m.verts * (1.001 + 1e-6 * repeat)) for m in scene.meshes])
        with torch.no_grad():
            lighting.image(elsewhere, camera, make_request(elsewhere, camera, 1, 0, **own), creases)
        watch = _Recorder()
        begin = time.perf_counter()
        with torch.enable_grad():
            step = make_request(scene, camera, *spp_and_seed, **own)
            image = lighting.image(scene, camera, step, creases, watch)
            with watch.part("backward"):
                torch.autograd.grad(image, leaves, adjoint.reshape(image.shape).to(image))
        runs.append({**watch.seconds, "python": time.perf_counter() - begin - sum(watch.seconds.values())})
    parts = (*_SHADED, *(part for part in _INDIRECT if part in watch.seconds), "backward", "python")
    seconds = {part: statistics.median(run.get(part, 0.0) for run in runs) for part in parts}
    image_samples = adjoint.shape[:-1].numel() * request.image.spp
    return Profile(seconds, {"image_samples": image_samples, **watch.samples})


def _leaves(scene: Scene, camera: Camera) -> tuple[Scene, Camera, Sequence[Tensor]]:
    """Return the scene and the camera with leaves in place of what requires a gradient, the vertices if nothing does, and these
    leaves."""
    wanted = [t for t in tensors_in((scene, camera)) if torch.is_grad_enabled() and t.requires_grad]
    wanted = wanted or [mesh.verts for mesh in scene.meshes]
    leaves = {id(t): t.detach().requires_grad_() for t in wanted}

    def leaf(tensor: Tensor) -> Tensor:
        return leaves.get(id(tensor), tensor)

    return map_tensors(scene, leaf), map_tensors(camera, leaf), list(leaves.values())


class _Recorder(Watch):
    """A watch that keeps seconds and samples."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.samples: dict[str, int] = {}

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin

    def count(self, name: str, number: int) -> None:
        self.samples[name] = self.samples.get(name, 0) + number


def _adjoint(adjoint: Tensor | None, camera: Camera, request: Request) -> Tensor:
    """Return the adjoint (B, H, W, C), as the kernel reads it. Raises TypeError or ValueError."""
    B, shape = request.cameras, (*camera.size, request.channels)
    if adjoint is None:
        return request.scene.colors.new_ones((B, *shape))
    adjoint = as_tensor("adjoint", adjoint, floating=True).detach()
    check_float("adjoint", adjoint)
    fix = "it is the derivative of the loss by the image: give it the image's shape"
    check_shape("adjoint", adjoint, shape if camera.batch is None else (B, *shape), fix=fix)
    check_finite("adjoint", adjoint)
    return adjoint.to(request.scene.colors).reshape(B, *shape).contiguous()


def _sum(profiles: Iterable[Mapping[str, float]]) -> dict[str, float]:
    total: dict[str, float] = {}
    for profile in profiles:
        for name, value in profile.items():
            total[name] = total.get(name, 0.0) + value
    return total
