"""The objective of pose fits at one resolution: the sum of all terms over all pictures, as a problem for optim."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from ....camera.camera import Camera
from ....optim.levenberg_marquardt import Model, Problem
from ...options import Settings
from ...placement import Pose
from ...region import Palette, palette
from ..camera_motion import moved_poses, moving_cameras, stacked
from ..settings import POSE
from ..task import FOCAL_LENGTH, PoseTask, TargetView, scaled
from .contour import ContourNoise, Sides, contour_noise, contour_rows, contour_term
from .depth import depth_term
from .light import HARMONICS, FittedLight
from .picture import PictureLevel, RenderedPoses
from .region import Frequencies, region_term
from .term import Term

CROP_GRID = 16  # Crops are aligned to so many pixels, so that a slightly different pose has the same.
AREA_SPP = 4
OBJECT_DIAGONAL = 1.5  # of an object, relative to the root of its area: thin objects count as smaller


class Comparison(NamedTuple):
    """N poses compared with one picture."""

    term: Term
    seen: RenderedPoses
    part: PictureLevel  # the picture in the renders' box
    colors: Frequencies
    light: FittedLight | None
    visible: Tensor  # (N, h, w), of the box: probability that nothing covers a pixel

    def sides(self, noise: ContourNoise) -> Sides:
        """Return the colours on both sides of the contours."""
        return Sides.from_picture(
            self.part, self.seen, self.visible, self.light, self.seen.box.cut(self.colors.every), noise
        )


@dataclass(frozen=True)
class PoseLevel(Problem[Pose]):
    """Pictures at one resolution. What is fixed while descents go on, as the level of noise, is known of the likeliest pose."""

    task: PoseTask
    pictures: tuple[PictureLevel, ...]
    dofs: tuple[int, ...]  # sought entries of a step
    spp: int
    seed: int
    coarseness: float  # size of a pixel, relative to the finest level's
    alpha_blur: float
    harmonics: int  # 0 for a mesh without colours
    last: bool
    contour_noises: tuple[ContourNoise, ...] = ()  # of each picture
    light_deviations: tuple[float | None, ...] = ()
    temperature: float = 1.0  # pixels that count as one, where that is known

    @property
    def size(self) -> tuple[int, int]:
        """The size (h, w) of the first picture."""
        return self.pictures[0].size

    def model(self, points: Sequence[Pose]) -> Model:
        total = Term.zero(len(points), len(self.dofs))
        for one in self.comparisons(points):
            total = total.plus(one.term._replace(summands=None))
        noise = torch.full_like(total.cost, POSE.cost_noise * self.temperature)
        return Model(total.cost[:, None], total.gradient, total.curvature, noise)

    def moved(self, points: Sequence[Pose], steps: Tensor) -> list[Pose]:
        return moved_poses(self.task, points, self.dofs, steps)

    def costs(self, poses: Sequence[Pose]) -> Tensor:
        """Return the costs (N,) of poses."""
        return replace(self, dofs=()).model(poses).cost[:, 0]

    def comparisons(self, poses: Sequence[Pose]) -> list[Comparison]:
        """Compare renders at N poses with each picture."""
        n = len(self.pictures)
        columns = self.pictures, self.light_deviations or (None,) * n, self.contour_noises or (ContourNoise(),) * n
        return [self._compared(poses, *each) for each in zip(*columns, strict=True)]

    def _compared(
        self, poses: Sequence[Pose], picture: PictureLevel, deviation: float | None, noise: ContourNoise
    ) -> Comparison:
        moving = moving_cameras(self.task, picture.camera, poses, self.dofs)
        colored, measured = self.harmonics > 0, picture.depth is not None
        seen = RenderedPoses.from_cameras(
            self.task, moving, colored, colored or measured, self.spp, self.seed
        )  # fmt: skip
        whole = seen.box.grown(max(picture.size), picture.size)
        colors = Frequencies.from_picture(picture, seen.box.pasted(seen.alpha, whole))
        part, light, visible = picture.part(seen.box), None, torch.ones_like(seen.alpha)
        terms: list[Term] = []
        flow: Tensor | None = None
        if seen.position is not None:
            flow = moving.flow(seen.position / seen.alpha[:, None].clamp(min=1e-6))
            if colored:
                near = Frequencies(*(seen.box.cut(one) for one in colors))
                blur = noise.blur if self.contour_noises and part.mask is None else 0.0  # A mask's is its own.
                light = FittedLight.from_picture(part, seen, self.harmonics, near, deviation, blur)
                visible = visible if light is None else light.visible
            if measured:
                depth = depth_term(part, seen, moving, flow, stacked(poses).scale, self.task.size)
                terms.append(depth.counted(POSE.correlated_depth))
        mixed: Tensor | None = None  # pixels that the contour term explains
        if self.last:
            every = seen.box.cut(colors.every)
            sides = Sides.from_picture(part, seen, visible, light, every, noise)
            gained = sides.gain(part.outlined)
            mixed = sides.band * gained[1]
            terms.append(contour_term(part, sides, gained, contour_rows(seen, noise.blur)))
        terms.append(region_term(picture, seen, colors, visible, mixed, self.alpha_blur))
        if light is not None and flow is not None:
            # Contour and region gain where nothing covers the object.
            shown = [term.gains for term in terms[-2 if self.last else -1 :] if term.gains is not None]
            others = POSE.correlated_light * sum(shown, torch.zeros_like(visible)) / visible.clamp(min=1e-3)
            # Far from the right pose, and in few pixels, surroundings like the margin would draw the silhouette outwards.
            grown = seen.tangents if self.last else torch.zeros_like(seen.tangents)
            terms.append(light.term(flow, grown, others).counted(POSE.correlated_light))
        total = terms[0]
        for term in terms[1:]:
            total = total.plus(term)
        return Comparison(total, seen, part, colors, light, visible)

    def informed(self, poses: Sequence[Pose]) -> PoseLevel:
        """Return the level with the noise that the likeliest of these poses leaves in each picture."""
        found: list[float | None] = []
        for one in replace(self, light_deviations=(), dofs=(), last=False).comparisons(poses):
            light = one.light
            found.append(None if light is None else float(light.deviation[light.known].min()))
        return replace(self, light_deviations=tuple(found))

    def focused(self, pose: Pose) -> PoseLevel:
        """Return the level with contours as sharp and as noisy as the pictures show them at a pose."""
        sharp = replace(self, last=False, spp=max(self.spp, POSE.sharp_spp)).comparisons([pose])
        found = [
            contour_noise(one.part, one.seen, one.visible, one.light, one.seen.box.cut(one.colors.every))
            for one in sharp
        ]
        # Samples are enough where their noise is far below the pictures'. Stratified ones leave an error of about spp^(-3/4).
        here = replace(self, contour_noises=tuple(found)).comparisons([pose])
        excess = 0.0
        for one, other, noise in zip(here, sharp, found, strict=True):
            excess = max(excess, one.sides(noise).distance(other.sides(noise)) / POSE.render_noise)
        spp = min(max(self.spp, POSE.sharp_spp), math.ceil(self.spp * max(1.0, excess ** (4.0 / 3.0))))
        T = temperature([one.term for one in here])
        return replace(self, contour_noises=tuple(found), spp=spp, temperature=T)


def temperature(terms: Sequence[Term]) -> float:
    """Return how many pixels count as one: the covariance of the gradient, by the residuals of the terms of one pose, relative to
    Fisher's information."""
    scores = POSE.common_errors * sum(term.score_covariance(POSE.correlation_length)[0] for term in terms)
    H = sum(term.curvature[0] for term in terms)
    assert isinstance(H, Tensor) and isinstance(scores, Tensor)
    H = H + (1e-9 * H.diagonal().max() + 1e-30) * torch.eye(len(H), dtype=torch.float64)
    return max(1.0, float(torch.linalg.solve(H, scores).trace()) / len(H))


class Crop(NamedTuple):
    """The part of a picture that is used, in pixels, and the object's extent there."""

    top: int
    left: int
    bottom: int
    right: int
    extent: float

    @staticmethod
    def around(task: PoseTask, shot: TargetView, pose: Pose) -> Crop:
        """Return the part around the object at a pose; the whole picture where that is not in the image."""
        H, W = shot.camera.size
        whole = Crop(0, 0, H, W, float(max(H, W)) / 2)
        camera = task.lens(shot.camera, pose)
        verts = torch.cat([mesh.verts for mesh in task.scene.meshes])
        seen = camera.project(pose.scale * verts @ pose.R.T + pose.t)
        if camera.projection == "panorama" or not bool(seen.isfinite().all()):
            return whole
        low, high = seen.amin(0), seen.amax(0)
        extent = float((high - low).norm())
        margin = POSE.crop_margin * extent
        left, top = (max(0, CROP_GRID * int((float(v) - margin) / CROP_GRID)) for v in low)
        ends = (CROP_GRID * math.ceil((float(v) + margin) / CROP_GRID) for v in high)
        right, bottom = (min(side, end) for end, side in zip(ends, (W, H), strict=True))
        if min(right - left, bottom - top) < POSE.smallest_side:
            return whole
        return Crop(top, left, bottom, right, extent)


def pose_levels(
    task: PoseTask, start: Pose, depths: Sequence[Tensor | None], settings: Settings
) -> list[PoseLevel]:  # fmt: skip
    """Return the levels from coarse to fine, of what surrounds the object at the start."""
    shots, cut, extents = [], [], []
    for shot, depth in zip(task.shots, depths, strict=True):
        crop = Crop.around(task, shot, start)
        rows, columns = slice(crop.top, crop.bottom), slice(crop.left, crop.right)
        weight = None if shot.weight is None else shot.weight[rows, columns]
        behind = shot.background
        behind = behind[rows, columns] if behind is not None and behind.dim() == 3 else behind
        camera = shot.camera.crop(crop.top, crop.left, crop.bottom - crop.top, crop.right - crop.left)
        shots.append(TargetView(camera, shot.target[rows, columns], behind, weight))
        cut.append(None if depth is None else depth[rows, columns])
        extents.append(crop.extent)
    finest = [min(1.0, settings.max_size / max(shot.camera.size)) for shot in shots]
    shorter = min(factor * min(shot.camera.size) for factor, shot in zip(finest, shots, strict=True))
    across = max(
        factor * min(extent, OBJECT_DIAGONAL * math.sqrt(max(_area(task, shot.camera, start), 1.0)))
        for factor, extent, shot in zip(finest, extents, shots, strict=True)
    )
    halvings = round(math.log2(max(1.0, min(across / POSE.coarsest, shorter / POSE.smallest_side))))
    blurs = POSE.alpha_blurs
    halved = [*range(halvings, -1, -1)]
    halved += [0] * (1 + len(blurs) - len(halved))
    masked, harmonics = _kind(task)
    levels, palettes = [], list[Palette]()
    for k, n in enumerate(halved):
        sizes = [scaled(shot.camera.size, factor / 2**n) for shot, factor in zip(shots, finest, strict=True)]
        own = [extent * factor / 2**n for extent, factor in zip(extents, finest, strict=True)]
        if not palettes:
            palettes = [_palette(shot, masked, size, settings.seed) for shot, size in zip(shots, sizes, strict=True)]
        columns = zip(shots, cut, sizes, own, palettes, strict=True)
        pictures = tuple(PictureLevel.from_shot(a, b, masked, c, d, e) for a, b, c, d, e in columns)
        # Perspective shows in fine detail only: on the coarsest level the focal length would diverge.
        dofs = tuple(entry for entry in task.dofs if entry < FOCAL_LENGTH or k > 0)
        last = k == len(halved) - 1
        spp = settings.spp if last else min(settings.spp, POSE.coarse_spp)
        few = min(harmonics, POSE.few_harmonics) if k == 0 else harmonics
        blur = blurs[k] if k < len(blurs) else 0.0
        levels.append(PoseLevel(task, pictures, dofs, spp, settings.seed, float(2**n), blur, few, last))
    return levels


def _palette(shot: TargetView, masked: bool, size: tuple[int, int], seed: int) -> Palette:
    """Return the palette of what outlines the object in a picture of this size."""
    empty = torch.zeros(1, 3 if not masked else 1, dtype=torch.float32)
    picture = PictureLevel.from_shot(shot, None, masked, size, 1.0, Palette(empty[:, : shot.target.shape[-1]]))
    return palette(picture.outlined.movedim(0, -1), seed)


def _area(task: PoseTask, camera: Camera, pose: Pose) -> float:
    """Return the number of pixels that the object covers at a pose."""
    moving = moving_cameras(task, camera, [pose], [0])
    return float(RenderedPoses.from_cameras(task, moving, False, False, AREA_SPP, 0).alpha.sum())


def whole_level(task: PoseTask, sizes: Sequence[tuple[int, int]], spp: int) -> PoseLevel:
    """Return the whole pictures with these sizes as a last level, for drawing."""
    masked, harmonics = _kind(task)
    pictures = []
    for shot, size in zip(task.shots, sizes, strict=True):
        found = _palette(shot, masked, size, 0)
        pictures.append(PictureLevel.from_shot(shot, None, masked, size, float(max(size)), found))
    return PoseLevel(task, tuple(pictures), tuple(task.dofs), spp, 0, 1.0, 0.0, harmonics, True)


def _kind(task: PoseTask) -> tuple[bool, int]:
    """Return whether pictures have masks, and the number of harmonics of the light."""
    masked = "alpha" in task.aovs and not task.clutter
    return masked, 0 if task.colorless or task.aovs == ("alpha",) else 1 if task.scene.is_shaded else HARMONICS
