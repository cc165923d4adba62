"""fit_shape(): find the vertices of a mesh, from coarse to fine."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ...camera.camera import Camera
from ...check import check_positive, check_positive_int
from ...optim.parameter import Parameter
from ...optim.tensors import DescentResult
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ...warnings import warn
from ..checkpoints import CheckpointFile
from ..laplacian import LaplacianSolver
from ..losses import REGION
from ..measured import Measured
from ..modes import in_full_precision
from ..options import DESCENT_OPTIONS, FitOptions, Settings
from ..placement import Coordinates
from ..remeshing import count_nonmanifold_edges, remeshed
from ..views import Images, views_of
from .descend import Save, descend_levels, descend_views
from .fit_scene import reporter
from .objective import Objective
from .result import Fit, make_fit
from .scene_builder import Built, whole_scene
from .settings import DESCENT


@dataclass(frozen=True)
class Refinement:
    """How fit_shape() goes from coarse to fine.

    Parameters
    ----------
    levels : int, default 3
        Number of levels. Before each but the first, the mesh is remeshed to even triangles of half the size. On a single level
        it keeps its faces.
    faces : int, optional
        About so many faces on the last level; by default four times as many as on the level before.
    lr : float, default 0.01
        Learning rate on the first level, in diagonals of the mesh's bounding box; it is halved on each further level.
    smoothness : float, default 4.0
        λ of the coordinates (I + λ L) v in which steps are taken: the larger, the farther a vertex moves its neighbours along
        (Nicolet, Jacobson and Jakob, Large Steps in Inverse Rendering of Geometry, 2021).
    """

    levels: int = 3
    faces: int | None = None
    lr: float = 0.01
    smoothness: float = 4.0

    def __post_init__(self) -> None:
        check_positive_int("refinement.levels", self.levels, most=12)
        for name in ("lr", "smoothness"):
            check_positive(f"refinement.{name}", getattr(self, name), least=0.0, most=1e9)
        if self.faces is not None:
            check_positive_int("refinement.faces", self.faces)


@in_full_precision
def fit_shape(
    mesh: Mesh,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    *,
    masks: Images | None = None,
    depths: Images | Measured | None = None,
    normals: Images | Measured | None = None,
    positions: Images | Measured | None = None,
    weights: Images | None = None,
    appearance: Callable[[Mesh], Scene | Mesh] | None = None,
    regularizer: Callable[[Scene], Tensor] | None = None,
    refinement: Refinement | None = None,
    options: FitOptions | None = None,
) -> Fit:
    """Find the shape of a mesh from pictures, masks, or measured depths, normals or positions of it.

    Parameters
    ----------
    mesh : Mesh
        The initial shape: a sphere around the object will do, unless the object has holes.
    images, cameras, masks, weights, regularizer
        As of fit_scene().
    depths, normals, positions : Tensor, sequence of Tensor, or Measured, optional
        (H, W) each, along the camera's axis +Z in world units; (H, W, 3) each, outward normals of length 1 in world axes; (H,
        W, 3) each, world coordinates. They are measured where they are finite and not 0. None stands for a picture that a
        camera does not have; a sensor with a camera of its own is one more camera.
    appearance : function, optional
        Makes of a mesh of bare vertices and faces what is rendered: a Mesh with normals and a material, or a Scene with lights
        and a background. By default the plain mesh before black. With masks, a background does not count.
    refinement : Refinement, optional
        Levels, faces, learning rate and smoothness.
    options : FitOptions, optional
        Of its defaults, `steps` is 500 on each level and `spp` 16. Coarse levels have smaller pictures.

    Returns
    -------
    Fit
        The `mesh` found.

    Raises
    ------
    TypeError, ValueError, ImportError
        An argument is wrong; the message names it. Or cholespy is missing, or, for more than one level, gpytoolbox (`pip
        install 'edgegrad[fit]'`).
    """
    settings = Settings.from_options(options, "fit_shape", DESCENT_OPTIONS)
    how = Refinement() if refinement is None else refinement
    if not isinstance(how, Refinement):
        raise TypeError(f"refinement: expected a Refinement, got {type(how).__name__}; give Refinement(levels=…)")
    if not isinstance(mesh, Mesh):
        raise TypeError(f"mesh: expected a Mesh, got {type(mesh).__name__}; load one with load_mesh(path)")
    # Remeshing would fail after the first level only.
    if how.levels > 1 and (count := count_nonmanifold_edges(mesh)):
        raise ValueError(
            f"mesh: expected no more than two triangles at each edge, as remeshing needs, got {count} edges with more; "
            "give Refinement(levels=1), or a sphere around the object"
        )
    measured = {"depths": depths, "normals": normals, "positions": positions}
    views = views_of(cameras, images, masks, weights, measured, by_region=settings.loss == REGION)
    compared = settings.loss != REGION and any(view.image is not None for view in views)
    if compared and appearance is None and mesh.channels is not None:
        warn(
            "colours of fit_shape",
            "mesh: expected bare vertices and faces, got colours, which fit_shape leaves out; make what is rendered of each mesh "
            "by appearance=, as a function of it, or give masks in place of images",
        )
    bare = Mesh(mesh.verts.detach().cpu().float().clone(), mesh.faces.detach().cpu().clone())
    masked, made = masks is not None, appearance or (lambda mesh: mesh)

    def scene(mesh: Mesh) -> Scene:
        return whole_scene(made(mesh), masked)

    def descend(
        values: dict[str, Tensor], level: int, save: Save, saved: Mapping[str, Any] | None
    ) -> DescentResult:  # fmt: skip
        """Run one level from a mesh's `verts` and `faces`, and return the best as its values."""
        mesh = Mesh(values["verts"], values["faces"])
        smooth = LaplacianSolver(mesh.faces, len(mesh.verts), how.smoothness)
        smallest = min(min(view.camera.size) for view in views)
        factor = min(1.0, max(0.5 ** (how.levels - 1 - level), DESCENT.coarsest_pixels / smallest))
        small = [view.resized(factor) for view in views]
        low, high = mesh.verts.aminmax(dim=0)
        rate = how.lr * float((high - low).norm()) * 0.5**level

        def build(values: Mapping[str, Tensor]) -> Built:
            return scene(mesh.replace(verts=smooth(values["verts"]))), [view.camera for view in small]

        objective = Objective(build, small, settings, regularizer, builder="appearance")
        first = smooth.to_differential(mesh.verts)
        if level == 0 and saved is None:
            objective.check({"verts": first})
        title = f"level {level + 1} of {how.levels}"
        parameters = {"verts": Parameter(rate, first, uniform=True)}
        found = descend_views(objective, parameters, save, saved, title, reporter(build, small))
        return found._replace(values={"verts": smooth(found.values["verts"]), "faces": mesh.faces})

    def finer(values: dict[str, Tensor], level: int) -> dict[str, Tensor]:
        last = how.faces or len(bare.faces) * 4 ** (how.levels - 1)
        found = remeshed(Mesh(values["verts"], values["faces"]), round(last / 4 ** (how.levels - 1 - level)))
        return {"verts": found.verts, "faces": found.faces}

    given = {"mesh": bare, "refinement": how, **settings.of_steps}
    checkpoint = CheckpointFile.from_views(settings.checkpoint, views, given)
    found = descend_levels(checkpoint, {"verts": bare.verts, "faces": bare.faces}, how.levels, descend, finer)
    last = Mesh(found.values["verts"], found.values["faces"])

    def build(values: Mapping[str, Tensor]) -> Built:
        return scene(last.replace(verts=values["verts"])), [view.camera for view in views]

    found = found._replace(values={"verts": last.verts})
    return make_fit(Objective(build, views, settings), found, scene(bare), Coordinates({}))
