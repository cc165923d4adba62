"""calibrate(): the lens that took several pictures of a known object, and where each of them was taken.

Each picture is first searched alone, as by fit_camera(), at half the resolution. Then Gauss-Newton steps move all poses and
the one lens together (bundle_adjustment.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from ...camera.camera import Camera
from ...check import check_flag
from ...optim.history import Ending
from ...scene.mesh import Mesh
from ...scene.scene import Scene
from ..by_camera import one_for_each
from ..checkpoints import checkpoint_of
from ..modes import in_full_precision
from ..options import MIN_PICTURE_SIDE, POSE_OPTIONS, FitOptions, Settings, options_of
from ..views import Images, cameras_of, check_image
from .camera_result import CameraFit, fitted
from .fit_camera import START, refined, with_coefficients
from .fit_pose import search_pose
from .inputs import ArgumentNames
from .result import PoseFit
from .task import Unknowns

PROJECTIONS = "perspective", "fisheye"


@in_full_precision
def calibrate(
    mesh: Mesh | Scene,
    images: Images | None,
    cameras: Camera | Sequence[Camera],
    *,
    masks: Images | None = None,
    principal: bool = True,
    distortion: int = 4,
    options: FitOptions | None = None,
) -> CameraFit:
    """Find the lens that took several pictures of a known object, and the place of each.

    Parameters
    ----------
    mesh : Mesh or Scene
        What the pictures show, with its colours; the background of a Scene is known, if it has one.
    images, masks
        As of fit_pose(), of one size.
    cameras : Camera or sequence of Camera
        One for each picture, with one K and distortion: where the fit starts, each within about 30° and 15 % of the mesh's
        size.
    principal, distortion
        As of fit_camera(). The focal length is always found.
    options : FitOptions, optional
        Of its defaults, `steps` is 60 on each level of a search, `step_tolerance` 3e-4, `spp` 16 and `max_size` 512. A
        checkpoint has a file for the search of each picture, with its number in the name.

    Returns
    -------
    CameraFit
        `cameras`, `uncertainty` with the standard deviation of each number of the first camera, and `uncertainties` of all.

    Raises
    ------
    TypeError, ValueError
        An argument is wrong; the message names it.

    Notes
    -----
    Pictures that were cropped or zoomed have another lens than the others. The object should fill the pictures, lie near their
    corners in some, and be seen from several sides. Where a number is hardly known, the fit has not `converged`, and `reason`
    names it.
    """
    given = _cameras(cameras, distortion)
    lens = Unknowns(False, True, check_flag("principal", principal), distortion)
    parts = options_of(options)
    settings = Settings.from_options(
        parts.of_part(0), "calibrate", (*POSE_OPTIONS, "checkpoint"), steps=60, max_size=512
    )
    if images is None and masks is None:
        raise ValueError("images: expected pictures or masks to compare with, got neither")
    n = len(given)
    pictures, shapes = one_for_each("images", images, n, 3), one_for_each("masks", masks, n, 2)
    name = "masks" if images is None else "images"
    for k, (camera, picture) in enumerate(
        zip(given, shapes if images is None else pictures, strict=True)
    ):  # All are checked before the first search.
        check_image(f"{name}[{k}]", picture, camera.size)
    searches: list[PoseFit] = []
    callback = settings.callback

    for k, (camera, picture, shape) in enumerate(zip(given, pictures, shapes, strict=True)):
        names = ArgumentNames(images=f"images[{k}]", masks=f"masks[{k}]")
        alone = replace(
            settings, max_size=max(MIN_PICTURE_SIDE, min(settings.max_size, max(camera.size)) // 2),
            callback=None if callback is None else lambda now: callback(fitted([*searches, now])),
            checkpoint=checkpoint_of(parts.of_part(k).checkpoint),
        )  # fmt: skip
        searches.append(search_pose(mesh, picture, camera, shape, START, lens, None, None, names, alone))
        if searches[-1].interrupted:
            return fitted(searches, Ending.INTERRUPTED)
    return refined(searches, settings)


def _cameras(cameras: object, distortion: object) -> list[Camera]:
    """Return the cameras one by one, with one lens. Raises TypeError or ValueError."""
    found = [with_coefficients(f"cameras[{k}]", camera, distortion) for k, camera in enumerate(cameras_of(cameras))]
    first = found[0]
    for k, camera in enumerate(found):
        if camera.projection not in PROJECTIONS:
            raise ValueError(
                f"cameras[{k}]: expected a perspective or a fisheye camera, got {camera.projection}, which has no lens to find"
            )
        if camera.size != first.size or camera.projection != first.projection:
            raise ValueError(
                f"cameras[{k}]: expected {first.projection}, {first.size[0]} × {first.size[1]} pixels, like cameras[0], got "
                f"{camera.projection}, {camera.size[0]} × {camera.size[1]}; calibrate pictures of one size and lens at a time"
            )
        same = torch.equal(camera.K.double(), first.K.double())
        if not same or not torch.equal(camera.coefficients.double(), first.coefficients.double()):
            raise ValueError(
                f"cameras[{k}]: expected the K and distortion of cameras[0], got others; the pictures are of one lens: start all "
                "from the same guess of it"
            )
    return found
