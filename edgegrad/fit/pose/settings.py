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
    light_rounds: int = 6  # of iteratively reweighted least squares
    light_pixels: int = 4000  # of more, every other row and column finds the light
    min_light_pixels: int = 60  # Fewer pixels inside do not show the light.
    min_light_noise: float = 0.004  # least standard deviation of a difference; renders of 16 samples leave about that
    clipped: float = 0.95  # linear radiance: brighter pixels may be of any brighter colour
    tail: float = 3.0  # standard deviations beyond which a difference hardly counts (Geman and McClure 1987)
    occluded: float = 0.1  # prior probability that something covers a pixel of the object
    # Prior probabilities that a shadow or a highlight changes what is seen of the surface, and that, without the mesh, a pixel
    # continues its neighbours. Of 20 covered pictures 19 are found, with 0.01 17.
    shaded: float = 0.1
    brightest: float = 2.0  # a highlight, relative to the fitted light
    occluder_width: float = 2.0  # standard deviation of the window in which pixels decide together what is covered
    # Largest log likelihood ratio by which one pixel outweighs its neighbours there. With 3, nothing was more hidden than by 0.7,
    # and a quarter's cover drew two of ten poses away, which 10 mended; from 7 on, margins of what is seen count as hidden. On 15
    # other covered pictures 3 and 5 find the same number of poses.
    max_pixel_nats: float = 5.0
    color_kernel: float = 0.12  # standard deviation of one colour of a window, in scaled radiance
    correlated_light: float = 8.0  # Neighbouring differences correlate: so many pixels count as one.

    # The contour, on the last level.
    contour_window: float = 1.4  # standard deviation of the windows from which the colours of both sides are taken
    # Standard deviations of the blur of alpha, of which the likeliest is taken. With 1.1 and 1.4 too, a photograph of a box is
    # found 2.4° off, without 1.8°.
    contour_blurs: tuple[float, ...] = (0.0, 0.3, 0.5, 0.7, 0.9)
    # Standard deviations of a mixed pixel, display values, of which the likeliest is taken.
    contour_noises: tuple[float, ...] = (0.002, 0.004, 0.008, 0.015, 0.03, 0.06)
    # Noise of the last level's renders, in deviations of the pictures. More would pass for an error of the pose.
    render_noise: float = 0.5
    first_contour: tuple[float, float] = (0.9, 0.03)  # blur and deviation before these are known
    sharp_spp: int = 128  # samples a pixel from which these are found, and the most that the last level takes

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
    # The same on the last level, before its noise and blur are known.
    last_rounds: tuple[tuple[int, int], ...] = ((1, 5), (2, 3))
    unlikely_nats: float = 8.0  # by which hypotheses on the last level may be less likely: a factor of 3000
    last_steps: int = 20  # most steps on the last level, once its noise and blur are known
    noise_rounds: int = 4  # most times that noise and blur are estimated anew, and that descents go on by these
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
    least_gain: float = 0.1  # nats: a step that is predicted to gain less is short, at most 0.45 standard deviations
    # Nats by which the renders' samples may raise the cost. Between poses that differ by less than a deviation it varies by
    # 0.2 … 0.35 at 16 samples; without slack, half of the last level's steps are taken back, and end no nearer.
    cost_noise: float = 0.3
    correlation_length: float = 8.0  # pixels: further apart, residuals have no common cause
    # Variance of poses relative to what residuals show: errors that all pixels have in common, as of blur and exposure, go into
    # the pose. On 27 lit and covered pictures it is 12 for rotations and 25 for shifts, on 12 with masks 4.
    common_errors: float = 12.0
    ambiguous_nats: float = 3.0  # A mode that is less likely by a smaller factor than exp(this) may be the right one.

    # What counts as right: the share of the render's edges that pictures show.
    photo_support: float = 0.65  # least share of a right pose: wrong ones show up to 0.57, right ones 0.83 and more
    plain_support: float = 0.85  # the same by the contour alone: wrong places in clutter show up to 0.81
    covered_support: float = 0.85  # the same of an object of which others leave less than `unoccluded` to be seen
    unoccluded: float = 0.85

    # Several objects in one picture.
    rounds_of_objects: int = 4  # most rounds in which all objects are sought in turn
    cover_margin: int = 2  # pixels around an object before another one, in which that is not compared


POSE = PoseSettings()


@dataclass(frozen=True)
class Round:
    """One round of the search near matches of views."""

    across: int  # pixels of the object's diagonal in the views
    turn: float  # radians, about each axis
    grow: float  # relative change of the size
    kept: int


@dataclass(frozen=True)
class TemplateSettings:
    """Numbers of the search of a whole picture by views of the object (photo/)."""

    # Views.
    directions: int = 96  # of views; with `rolls` rotations about each, they are some 20° apart
    rolls: int = 18
    view_pixels: int = 20  # pixels of the object's diagonal in the first views
    view_fill: float = 0.6  # share of the picture's shorter side that an object fills, for the perspective of views
    least_depth: float = 1.2  # of the object's centre, in its sizes
    ring: float = 0.1  # margin around the object's box for the background, in its diagonal
    spp: int = 4  # samples a pixel
    # Places in the picture.
    smallest: float = 0.25  # the object's diagonal, relative to the picture's shorter side
    largest: float = 1.25
    size_ratio: float = 1.2  # between two sizes
    stride: int = 2  # pixels between two places
    places_per_view: int = 3  # at one size
    most_ranked: int = 3000  # matches that are compared with one another
    mip_ratio: float = 1.15  # between two sizes of the picture
    shift_pixels: int = 2  # by which a match is moved to all sides
    # Matches are distinct that differ by so many radians, a distance in sizes of the object, or a factor of the size.
    distinct: tuple[float, float, float] = (0.35, 0.15, 1.25)
    places: int = 24  # of given views that are kept
    fewer_with_mask: int = 2  # A mask shows where the object is: matches are fewer by this factor.
    coarse: int = 200  # matches of the first views that are kept
    beam_rounds: tuple[Round, ...] = (Round(20, 0.17, 0.1, 100), Round(32, 0.12, 0.07, 40), Round(32, 0.07, 0.04, 16))
    # How well a view matches.
    batch: int = 64  # views
    noise: float = 0.06  # standard deviation of a pixel in sRGB values, by noise and by the views' spacing
    light_slope: float = 0.3  # standard deviation of slopes of the light, relative to its constant
    light_tint: float = 0.15  # standard deviation of the light's colour
    residual_level: float = 0.1  # weight of a residual's square relative to squared differences of neighbours
    # Share of pixels that are drawn from the picture's colours without the object. Of eight hard pictures, two have no right view
    # among the first matches; with 0.6, five.
    rare_weight: float = 0.3
    mask_weight: float = 0.25  # of a mask's error relative to that of colours
    color_bandwidth: float = 0.08  # standard deviation of similar colours, sRGB values
    sampled_pixels: int = 1500  # that estimate the density of colours


TEMPLATES = TemplateSettings()


@dataclass(frozen=True)
class CameraSettings:
    """Numbers of fits of cameras, and of what all pose fits check at start and end."""

    # What counts as known; lengths are in sizes of the object.
    prior_deviation: float = 1.0  # radians and sizes: standard deviation of what the pictures do not show at all
    most_degrees: float = 5.0  # Directions with a larger standard deviation are unknown.
    most_shift: float = 0.05
    most_focal: float = 0.03  # relative to the focal length
    most_contour_degrees: float = 2.0  # by a contour alone: rotations known to ±2.2° … 5° were 2° … 8° off
    least_visible: float = 0.1  # With a smaller share left by objects in front, a pose is not accepted.
    # Steps of all poses and the lens at once.
    adjust_steps: int = 12
    short_step: float = 0.1  # mean standard deviations
    lens_unit: float = 10.0  # Numbers of the lens may move so many times as far as those of a pose.
    # The start.
    check_spp: int = 4  # samples a pixel of renders for checks
    unit_factor: float = 4.0  # Depths that are off by a larger factor have other units.
    default_fill: float = 0.5  # share of the picture's shorter side that an object fills if nothing else is known
    least_overlap: float = 0.3  # IoU of the boxes of object and mask at which the mesh file's pose is accepted


CAMERA = CameraSettings()
