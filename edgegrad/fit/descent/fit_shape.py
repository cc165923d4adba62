"""fit_shape(): find the vertices of a mesh, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from ...camera.camera import Camera
from ...check import check_positive, check_positive_int
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..checkpoints import Checkpoint
from ..ending import Ending
from ..history import Record
from ..laplacian import LaplacianSolver
from ..losses import REGION
from ..measured import Measured
from ..options import Options, Parameter
from ..placement import Coordinates
from ..remeshing import count_nonmanifold_edges, remeshed
from ..row_order import check_mask_rows
from ..views import Images, Observation, region_views, views_of
from .fit_scene import make_optimizer, options_of, reporter
from .loop import Descent, descend
from .objective import Objective
from .result import Fit, make_fit

SMOOTHNESS = 4.0  # λ of I + λ L
MIN_PIXELS = 64  # on the shorter side of pictures of coarse levels


def fit_shape(
    mesh: Mesh,
    cameras: Camera | Sequence[Camera],
    images: Images | None = None,
    *,
    masks: Images | None = None,
    depths: Images | Measured | None = None,
    normals: Images | Measured | None = None,
    positions: Images | Measured | None = None,
    weights: Images | None = None,
    levels: int = 3,
    faces: int | None = None,
    lr: float = 0.01,
    smoothness: float = SMOOTHNESS,
    look: Callable[[Mesh], Scene | Mesh] | None = None,
    background: Tensor | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    **options: Any,
) -> Fit:
    """Find the shape of a mesh from pictures, masks, or measured depths, normals or positions of it.

    mesh        initial shape: a sphere around the object will do, unless the object has holes
    depths      (H, W) each, along the optical axis, +Z of the camera, in world units, as sensors give them
    normals     (H, W, 3) each, of length 1, in world axes, outwards
    positions   (H, W, 3) each, world coordinates These three are measured where they are finite and not 0; Measured(values, …)
                adds weights. None stands for a picture that a camera does not have; a sensor with a camera of its own is one
                more camera
    levels      number of levels; before each but the first, the mesh is remeshed to even triangles of half the size. 1: the
                mesh keeps its faces
    faces       about so many faces on the last level; None: four times as many as on the level before
    lr          learning rate on the first level, in diagonals of the mesh's bounding box; halved on each further level
    smoothness  λ of the coordinates (I + λ L) v in which steps are taken: the larger, the farther a vertex moves its neighbours
                along (Nicolet, Jacobson and Jakob, Large Steps in Inverse Rendering of Geometry, 2021)
    look        function that makes of a mesh of bare vertices and faces what is rendered: a Mesh with normals and a material,
                or a Scene with lights; None: the plain mesh
    background  radiance behind the mesh where there are no masks, (C,) or (H, W, C); None: black
    options     see edgegrad.fit.Options; `steps` counts on each level, and coarse levels have smaller pictures

    The other arguments are those of fit_scene(). Needs cholespy, and gpytoolbox for more than one level (`pip install
    'edgegrad[fit]'`). Raises TypeError or ValueError that names the argument, ImportError.
    """
    opts = options_of(options)
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; load one with load_mesh(path)")
    check_positive_int("levels", levels, most=12)
    for name, value in (("lr", lr), ("smoothness", smoothness)):
        check_positive(name, value, least=0.0, most=1e9)
    if faces is not None:
        check_positive_int("faces", faces)
    # Remeshing would fail after the first level only.
    if levels > 1 and (count := count_nonmanifold_edges(mesh)):
        raise ValueError(
            f"mesh: expected no more than two triangles at each edge, as remeshing needs, got {count} edges with more; "
            "give levels=1, or a sphere around the object"
        )
    measured = {"depths": depths, "normals": normals, "positions": positions}
    views = views_of(cameras, images, masks, weights, measured)
    if opts.loss == REGION:
        views = region_views(views)
    behind = None if masks is not None else background
    bare = Mesh(mesh.verts.detach().cpu().float().clone(), mesh.faces.detach().cpu().clone())
    return _ShapeFit(views, opts, levels, faces, lr, smoothness, look or _itself, behind, regularizer).run(bare)


def _itself(mesh: Mesh) -> Mesh:
    return mesh


class _ShapeFit:
    """The levels of one fit."""

    def __init__(
        self, views: list[Observation], options: Options, levels: int, faces: int | None, lr: float, smoothness: float,
        look: Callable[[Mesh], Scene | Mesh], background: Tensor | None, regularizer: Callable[[Scene], Tensor] | None,
    ) -> None:  # fmt: skip
        self.views, self.options, self.levels, self.faces, self.lr = views, options, levels, faces, lr
        self.smoothness, self.look, self.background, self.regularizer = smoothness, look, background, regularizer

    @torch.inference_mode(False)
    @torch.enable_grad()
    def run(self, mesh: Mesh) -> Fit:
        start, level, history, seconds = mesh, 0, [], 0.0
        names = ("levels", "faces", "lr", "smoothness", "background")
        given = {"mesh": mesh, **{name: getattr(self, name) for name in names}}
        checkpoint = Checkpoint.from_fit(self.options, self.views, given)
        saved = checkpoint.read()
        last = self.faces or len(mesh.faces) * 4 ** (self.levels - 1)
        if saved is not None:
            level, mesh = saved["level"], Mesh(saved["verts"], saved["faces"])
            history, seconds = [Record(*record) for record in saved["history"]], saved["seconds"]
        else:
            check_mask_rows(self.views, self.scene(mesh), [view.camera for view in self.views])
        while True:
            stage = {
                "level": level, "verts": mesh.verts, "faces": mesh.faces,
                "history": [tuple(record) for record in history], "seconds": seconds,
            }  # fmt: skip

            def save(loop: dict[str, Any], stage: dict[str, Any] = stage) -> None:
                checkpoint.write({**stage, "loop": loop})

            found = self.descend(mesh, level, save, None if saved is None else saved["loop"])
            saved, mesh = None, mesh.replace(verts=found.values["verts"])
            history += [record._replace(step=len(history) + k) for k, record in enumerate(found.history)]
            seconds += found.seconds
            if found.ending is Ending.INTERRUPTED or level == self.levels - 1:
                break
            level += 1
            mesh = remeshed(mesh, round(last / 4 ** (self.levels - 1 - level)))
        whole = Descent({"verts": mesh.verts}, history, seconds, found.ending)

        def build(values: Mapping[str, Tensor]) -> tuple[Scene, list[Camera]]:
            return self.scene(mesh.replace(verts=values["verts"])), [view.camera for view in self.views]

        return make_fit(Objective(build, self.views, self.options), whole, self.scene(start), Coordinates({}))

    def descend(
        self, mesh: Mesh, level: int, save: Callable[[dict[str, Any]], None], saved: dict[str, Any] | None
    ) -> Descent:
        """Run one level from `mesh` and return the best vertices as its values."""
        smooth = LaplacianSolver(mesh.faces, len(mesh.verts), self.smoothness)
        smallest = min(min(view.camera.size) for view in self.views)
        factor = min(1.0, max(0.5 ** (self.levels - 1 - level), MIN_PIXELS / smallest))
        views = [view.resized(factor) for view in self.views]
        low, high = mesh.verts.aminmax(dim=0)
        rate = self.lr * float((high - low).norm()) * 0.5**level

        def build(values: Mapping[str, Tensor]) -> tuple[Scene, list[Camera]]:
            return self.scene(mesh.replace(verts=smooth(values["verts"]))), [view.camera for view in views]

        objective = Objective(build, views, self.options, self.regularizer)
        first = smooth.to_differential(mesh.verts)
        if level == 0 and saved is None:
            objective.check({"verts": first})
        parameters = {"verts": Parameter(rate, first, uniform=True)}
        title = f"level {level + 1} of {self.levels}"
        found = descend(make_optimizer(parameters, self.options), objective, save, saved, title, reporter(build, views))
        return found._replace(values={"verts": smooth(found.values["verts"])})

    def scene(self, mesh: Mesh) -> Scene:
        made = self.look(mesh)
        return made if isinstance(made, Scene) else Scene([made], self.background)
