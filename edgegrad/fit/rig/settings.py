"""The numbers of fits of rigs: what each means, and its unit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RigSettings:
    """Numbers of the levels, of the search for limbs, and of what counts as shown. Rotations are in radians.

    `python -m benchmarks.rig_confidence --sensitivity` prints how results change at half and twice the value of each.
    """

    # Levels.
    most_numbers: int = 200  # Of more numbers, "adam" is the default method.
    steps: int = 40  # most on the last level
    coarse_steps: int = 15  # most on each level before
    spp: int = 8  # samples a pixel
    coarse_spp: int = 16  # at least, of pictures smaller than `coarse_share` of their own size
    coarse_share: float = 0.4
    last_spp: int = 4  # factor of samples on the last level, where axial rotations show little
    prior_growth: float = 3.0  # A prior's weight grows by this power of how much coarser pictures are.
    last_prior: float = (
        0.1  # factor of the default prior at full size; 1 hides axial rotations, and 0.01 everywhere lost poses
    )
    # On the last level, losses but those by regions have these two dampings, relative to the largest curvature. Steps then go
    # far where pictures show little: shared axial rotations arrive before the loss seems at rest.
    last_damping: float = 1e-4
    last_unseen_damping: float = 1e-6

    # Hypotheses.
    tries: int = 40  # most draws on each level
    least_side: int = 24  # pixels on the shorter side of the levels on which limbs are drawn
    most_side: int = 96
    region_share: float = 0.5  # of the tries by regions, each of which takes as many times as long
    draws: int = 64  # of one limb that are compared
    kept: int = 2  # of these, refined by the limb's own numbers
    spreads: tuple[float, float] = (0.2, 0.4)  # standard deviations of draws, alternating
    least_move: float = 0.3  # A draw that rotates all joints less is the same place.
    least_chance: float = 0.05  # of a limb to be drawn, relative to the largest
    limb_share: float = 0.4  # A joint with more of all rows below it is drawn alone.
    refinement_steps: int = 6  # of a drawn limb
    # On the last level, limbs are refined after rotations of `worst_joints` by `far_angles`. Without it, pose 7 of
    # examples/body.py keeps an arm 22° … 44° off at 192 pixels.
    sweeps: int = 2
    worst_joints: int = 5
    last_refinement_steps: int = 12
    far_angles: tuple[float, ...] = (0.35, 0.7)
    axial_angles: tuple[float, ...] = (0.05, 0.1, 0.15, 0.3, 0.5, 0.7)  # about bones, to both sides
    flat_angle: float = 1.5708  # also, where nothing hangs on a limb: both sides of a flat one may be equal
    most_worse: float = 2.0  # A hypothesis whose refined limb costs more by this factor is dropped.
    deviations: float = 2.0  # A lower cost counts from so many standard errors of its samples.
    region_gain: float = 0.05  # least decrease of the missing share of contours
    fitted: float = 1.5  # A residual loss below this, in units of its noise, ends the search.

    # Keypoints.
    keypoint_width: float = 0.02  # share of the picture's diagonal, beyond which distances count linearly
    keypoint_weight: float = 1e-3

    # What pictures show of a joint.
    moved_share: float = 0.05  # Pixels move with a joint from this share of its largest derivative,
    joint_margin: int = 2  # and so do those so many pixels around.
    least_edges: float = 8.0  # pixels: with fewer edges a joint is not judged
    support_spp: int = 32
    missed_region: float = 0.01  # A region of a larger share of a mask is a missed limb.
    share_of_median: float = 0.85  # A misplaced joint shows a smaller share of edges, relative to the median joint.
    prior_deviation: float = 1.0  # of what pictures do not show at all; in radians, or as many rates as make one
    known_degrees: float = 5.0  # A joint known less exactly is unknown.

    # Step sizes.
    rotation_rate: float = 0.03
    translation_rate: float = 0.01  # sizes of the rig
    other_rate: float = 0.05  # of the range between limits, or in the control's own unit

    # Sequences.
    motion_share: float = (
        0.5  # of the last frame's motion to start with: all of it adds up errors that no picture shows
    )
    track_coarsest: int = 48  # pixels of the first level in later frames


RIG = RigSettings()
