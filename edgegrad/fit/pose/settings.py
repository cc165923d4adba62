"""The numbers of pose fits in photographs: what each means, and its unit.

`python -m benchmarks.poses --sensitivity` prints how results change at half and twice the value of each.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class PoseSettings:
    """Numbers of the objective and of the search, see docs/pose.md. Lengths are in pixels of a level unless it says otherwise."""

    # The image pyramid.
    coarsest: float = 30.0  # pixels across the object on the coarsest level
    smallest_side: int = 12  # pixels on the shorter side of a picture there
    crop_margin: float = 0.6  # around the object, in its extent in the image
    coarse_spp: int = 8  # samples a pixel before the last level
    # Standard deviations of a blur of alpha on the first two levels, which widens the reach of a step.
    alpha_blurs: tuple[float, float] = (1.0, 0.7)
    few_harmonics: int = 4  # of the light on the coarsest level, which shows no more

    # Regions: colours are counted in windows inside and outside of the silhouette.
    window_radius: float = 0.15  # in extents of the object
    prior_pixels: float = 1.0  # of the whole picture's colours, which each window has besides its own
    region_outliers: float = 1e-3  # likelihood of a pixel whose colour says nothing, relative to both sides

    # Light inside the silhouette.
    light_blur: float = 1.0  # of picture and render, before they are compared
    light_ridge: float = (
        5e-4  # relative to the constant's curvature: light that the picture does not show stays near zero
    )
    light_rounds: int = 4  # of iteratively reweighted least squares
    min_light_pixels: int = 60  # Fewer pixels inside do not show the light.
    min_light_noise: float = 0.02  # least standard deviation of a difference
    clipped: float = 0.95  # linear radiance: brighter pixels may be of any brighter colour
    tail: float = 3.0  # standard deviations beyond which a difference hardly counts (Geman and McClure 1987)
    occluded: float = 0.1  # prior probability that something covers a pixel of the object
    occluder_width: float = 2.0  # standard deviation of the window in which pixels decide together what is covered
    max_pixel_nats: float = 3.0  # Largest log likelihood ratio by which one pixel outweighs its neighbours there.
    color_kernel: float = 0.12  # standard deviation of one colour of a window, in scaled radiance
    correlated_light: float = 8.0  # Neighbouring differences correlate: so many pixels count as one.

    # The contour, on the last level.
    contour_window: float = 1.4  # standard deviation of the windows from which the colours of both sides are taken
    # Of which the likeliest is taken. Wider ones pass for an offset: with 1.1 and 1.4 four of ten lit cases were off.
    contour_blurs: tuple[float, ...] = (0.3, 0.5, 0.7, 0.9)
    contour_tolerance: float = 12.0  # squared differences in variances; far larger ones hardly count
    min_contour_pixels: int = 20

    # Depth.
    depth_noise: tuple[float, float] = (0.002, 0.05)  # least and largest standard deviation, in sizes of the object
    min_depth_pixels: int = 30
    correlated_depth: float = 4.0  # Neighbouring errors of a sensor correlate: so many pixels count as one.

    # The search.
    # Radians of the first hypotheses about each axis of the camera, to both sides.
    turns: tuple[float, ...] = (0.2, 0.4)
    start_radius: float = 0.8  # radians: the largest rotation of a given number of starts around one
    # Steps on the coarsest level, and hypotheses kept then.
    first_rounds: tuple[tuple[int, int], ...] = ((3, 8), (4, 4))
    later_rounds: tuple[tuple[int, int], ...] = ((2, 6), (3, 3))  # the same on each further level before the last
    last_rounds: tuple[tuple[int, int], ...] = (
        (3, 3),
        (5, 3),
    )  # on the last level, before its noise and blur are known
    last_steps: int = 20  # most steps then
    weak_directions: int = 3  # of the likeliest mode, along which hypotheses are drawn for the next level
    weak_deviations: float = 2.0  # standard deviations of the level's posterior at which they are drawn
    open_length: float = 4.0  # pixels: the correlation length by which that posterior is as wide as ends of descents
    distinct: float = 0.03  # Radians and object sizes: of hypotheses nearer to one another the likeliest is kept.
    modes: int = 3  # kept on the last level
    same_mode: float = 0.1  # Radians and object sizes: nearer ends are one mode.
    coarse_damping: float = 0.1  # λ at first, before the last level and on it
    fine_damping: float = 0.01
    most_damping: float = 100.0  # A descent with a larger λ rests, for its cost falls along no step.
    longest_step: float = 0.1  # radians, object sizes and logarithms
    least_gain: float = 0.1  # nats of independent pixels: a step that is predicted to gain less is short
    # Errors of neighbouring pixels have common causes: posteriors have its square as temperature.
    correlation_length: float = 8.0
    ambiguous_nats: float = 3.0  # A mode that is less likely by a smaller factor than exp(this) may be the right one.

    # What counts as right: the share of the render's edges that pictures show.
    photo_support: float = 0.65  # least share of a right pose: wrong ones show up to 0.57, right ones 0.83 and more
    plain_support: float = 0.85  # the same by the contour alone: wrong places in clutter show up to 0.81
    sure_support: float = 0.85  # where the colours as they are were compared first and did not fit
    unoccluded: float = 0.85  # Of an object that is visible less, `sure_support` is the least share.
    unchanged_colors: float = 0.05  # largest mean relative change of colours by the light that counts as none

    # Several objects in one picture.
    rounds_of_objects: int = 4  # most rounds in which all objects are sought in turn
    cover_margin: int = 2  # pixels around an object before another one, in which that is not compared


POSE = PoseSettings()
