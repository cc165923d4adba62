"""The terms of the objective of pose fits, and their sum, against oracles."""

import functools
import math
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from brackets import BACKGROUND, CENTER, SIZE, bracket, camera, picture, rotation, task_of
from matte_balls import LIGHT, ball_and_camera
from photographs import coverage, depth_of, photograph
from small_scenes import views

import edgegrad as eg
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.options import Settings
from edgegrad.fit.placement import Pose
from edgegrad.fit.pose.camera_motion import moved_poses, moving_cameras
from edgegrad.fit.pose.inputs import ArgumentNames
from edgegrad.fit.pose.likelihood import light, objective
from edgegrad.fit.pose.likelihood.contour import ContourNoise, Sides, contour_rows, contour_term
from edgegrad.fit.pose.likelihood.depth import depth_term
from edgegrad.fit.pose.likelihood.light import FittedLight
from edgegrad.fit.pose.likelihood.objective import pose_levels
from edgegrad.fit.pose.likelihood.picture import Box, PictureLevel, RenderedPoses
from edgegrad.fit.pose.likelihood.region import Frequencies, region_term
from edgegrad.fit.pose.likelihood.term import Term
from edgegrad.fit.pose.settings import POSE
from edgegrad.fit.pose.task import PoseTask, TargetView, Unknowns
from edgegrad.fit.region import palette, smoothed

F64 = torch.float64
RIGHT = Pose(torch.eye(3, dtype=F64), torch.zeros(3, dtype=F64))
STEP = torch.tensor([0.008, -0.01, 0.012, 0.003, -0.0025, 0.006], dtype=F64)


def level_of(view, radiance, depth=None, masked=False, background=None):
    """Return a picture (h, w, c) at its own resolution."""
    shot = TargetView(view.to(F64), radiance, background, None)
    shown = radiance[..., -1:] if masked else linear_to_srgb(radiance.clamp(0, 1))
    return PictureLevel.from_shot(shot, depth, masked, view.size, 0.5 * max(view.size), palette(shown, 0))


def rendered(task, poses, spp=64):
    """Return the poses in their box, and their cameras."""
    moving = moving_cameras(task, task.shots[0].camera, poses, task.dofs)
    return RenderedPoses.from_cameras(task, moving, True, True, spp, 1), moving


def pasted(seen, image, size):
    return seen.box.pasted(image, Box(slice(0, size), slice(0, size)))


def flow_of(seen, moving):
    return moving.flow(seen.position / seen.alpha[:, None].clamp(min=1e-6))


@pytest.mark.quick
def test_the_region_terms_gradient_is_that_of_its_cost():
    """Frequencies are held fixed. The reference is central differences of renders with many samples."""
    n, h, sigma = 40, 0.005, 0.7
    view = camera(n)
    task = task_of(torch.rand(n, n, 3), view, bracket())
    generator = torch.Generator().manual_seed(3)
    p, q = F.interpolate(torch.rand(1, 2, 5, 5, generator=generator), (n, n), mode="bilinear")[0].clamp(0.1, 0.9)
    near = torch.where(torch.arange(n) < 33, 1.0, 0.4).expand(n, n)
    level = replace(level_of(view, torch.rand(n, n, 3)), weight=near)
    colors = Frequencies(p[None], q[None], 0.5 * (p + q)[None])

    def cost(alpha):
        soft = smoothed(alpha, sigma).double()
        return -(near * ((soft * p + (1 - soft) * q + POSE.region_outliers * (p + q)) / (0.5 * (p + q))).log()).sum(
            (1, 2)
        )

    def silhouettes(poses, spp):
        moving = moving_cameras(task, task.shots[0].camera, poses, task.dofs)
        return RenderedPoses.from_cameras(task, moving, False, False, spp, 5)

    steps = h * torch.eye(6, dtype=F64)
    seen = silhouettes([RIGHT], 1024)
    term = region_term(level, seen, colors, torch.ones_like(seen.alpha), None, sigma)
    ends = silhouettes(moved_poses(task, [RIGHT] * 12, task.dofs, torch.cat([steps, -steps])), 1024)
    ahead, behind = cost(pasted(ends, ends.alpha, n)).split(6)
    expected = (ahead - behind) / (2 * h)
    assert float((term.gradient[0] - expected).norm() / expected.norm()) < 0.02, (term.gradient, expected)
    assert float(term.cost) == pytest.approx(float(cost(pasted(seen, seen.alpha, n))), rel=1e-3)
    # Fisher's information: of each pixel the gradient's square.
    soft = smoothed(seen.alpha, sigma)[0].double()
    p, q, near = (seen.box.cut(one).double() for one in (p, q, near))
    slope = (p - q) / (soft * p + (1 - soft) * q + POSE.region_outliers * (p + q)) * near
    J = smoothed(seen.tangents[:, 0], sigma).double() * slope
    torch.testing.assert_close(term.curvature[0], torch.einsum("ahw,bhw->ab", J, J), rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("masked", [False, True])
def test_the_right_silhouette_is_the_likeliest(masked):
    view, n = camera(64, 6.5), 64
    radiance = photograph(view)
    if masked:  # Its colours say nothing.
        radiance = torch.cat([torch.full_like(radiance, 0.3), coverage(view)], -1)
    task = task_of(photograph(view), view)
    steps = torch.zeros(4, 6, dtype=F64)
    steps[1, 3], steps[2, 2], steps[3, 5] = 0.05, 0.3, 0.2
    seen, _ = rendered(task, moved_poses(task, [RIGHT] * 4, task.dofs, steps), 16)
    seen = seen._replace(alpha=torch.cat([seen.alpha, torch.zeros_like(seen.alpha[:1])]),
                         tangents=torch.cat([seen.tangents, torch.zeros_like(seen.tangents[:, :1])], 1))  # fmt: skip
    level = level_of(view, radiance, masked=masked)
    colors = Frequencies.from_picture(level, pasted(seen, seen.alpha, n))
    term = region_term(level, seen, colors, torch.ones_like(seen.alpha), None, 0.0)
    assert float(term.cost[0]) < 0.0 and bool((term.cost[0] < term.cost[1:] - 3.0).all()), term.cost
    if masked:
        assert float(term.cost[0]) == pytest.approx(-n * n * math.log(2.0), rel=0.05)
        assert torch.equal(colors.inside[0], level.mask)
    else:
        assert abs(float(term.cost[4])) < 0.005 * n * n  # the picture without the object


class Ball:
    """A ball in a light, and the renders of poses that are compared with it."""

    def __init__(self, light_=LIGHT, truth=None):
        mesh, view = ball_and_camera()
        self.n = view.size[0]
        self.task = task_of(torch.rand(*view.size, 3), view, mesh)
        self.seen, self.moving = rendered(self.task, [RIGHT])
        there = self.seen if truth is None else rendered(self.task, [truth])[0]
        x, y, z = normal = F.normalize(there.normal[0], dim=0)
        one = torch.ones_like(x)
        Y = torch.stack([one, *normal, x * y, y * z, 3 * z * z - 1, x * z, x * x - y * y])[: light_.shape[1]]
        self.image = pasted(there, there.color[0] * torch.einsum("cn,nhw->chw", light_, Y), self.n).movedim(0, -1)
        self.view = view

    def fitted(self, harmonics, image=None):
        level, seen = level_of(self.view, self.image if image is None else image), self.seen
        colors = Frequencies.from_picture(level, pasted(seen, seen.alpha, self.n))
        near = Frequencies(*(seen.box.cut(one) for one in colors))
        return FittedLight.from_picture(level.part(seen.box), seen, harmonics, near, None)

    def term(self, found):
        """Return the term of pixels inside, without what the silhouette takes in."""
        still = torch.zeros_like(self.seen.tangents)
        return found.term(flow_of(self.seen, self.moving), still, torch.zeros_like(self.seen.alpha))

    def part(self, image):
        return self.seen.box.cut(image)


def test_an_exposure_is_found():
    gain = torch.tensor([[1.7], [0.6], [0.9]])
    ball = Ball(light_=gain)
    for harmonics in (1, 9):
        found = ball.fitted(harmonics).coefficients[0]
        torch.testing.assert_close(found[:, :1], gain, rtol=4e-3, atol=0)
        assert float(found[:, 1:].abs().sum()) < 0.02


def test_the_light_of_a_matte_ball_is_found(monkeypatch):
    ball = Ball()
    for ridge, most in ((POSE.light_ridge, 0.03), (0.0, 3e-4)):
        monkeypatch.setattr(light, "POSE", replace(POSE, light_ridge=ridge))
        found = ball.fitted(9)
        shown = torch.einsum("cn,cnm->cm", found.coefficients[0], found.surfaces.basis[0])
        assert float(found.found.residual.norm() / shown.norm()) < most
    # Half of a ball hardly separates the harmonics of z, and float32 solves for them: rounding differs by processor.
    assert float((found.coefficients[0] - LIGHT).norm() / LIGHT.norm()) < 0.08


@pytest.mark.parametrize(("harmonics", "most", "short"), [(1, 0.06, 0.02), (9, 0.2, 0.045)])
def test_a_step_of_the_light_term_undoes_a_small_motion(harmonics, most, short, monkeypatch):
    """The motion is half a pixel and less, in a light that is solved for. Rotations of a ball look nearly like shifts, so the
    error of the step counts by how much of the picture it changes. Shadows would explain a part of it."""
    monkeypatch.setattr(light, "POSE", replace(POSE, shaded=1e-9))
    ball = Ball()
    truth = moved_poses(ball.task, [RIGHT], ball.task.dofs, STEP[None])[0]
    ball = Ball(light_=LIGHT[:, :harmonics], truth=truth)
    term = ball.term(ball.fitted(harmonics))
    H, step = term.curvature[0], torch.linalg.solve(term.curvature[0], -term.gradient[0])
    assert float((step - STEP) @ H @ (step - STEP) / (STEP @ H @ STEP)) ** 0.5 < most
    assert float(step @ H @ STEP / (STEP @ H @ STEP)) == pytest.approx(1.0, abs=short)
    assert float(term.cost) < 0.0


def light_along(task, level, entry, step, harmonics, deviation=0.05):
    """Return lights fitted at the right pose, nearer and further along one entry of a step, and what their terms take."""
    steps = torch.zeros(3, 6, dtype=F64)
    steps[1, entry], steps[2, entry] = step, -step
    found = []
    for pose in moved_poses(task, [RIGHT] * 3, task.dofs, steps):
        seen, moving = rendered(task, [pose])
        colors = Frequencies(*(torch.full_like(seen.alpha, 1e-3) for _ in range(3)))
        light_ = FittedLight.from_picture(level.part(seen.box), seen, harmonics, colors, deviation)
        found.append((light_, flow_of(seen, moving), seen))
    return found


def test_the_light_terms_gradient_knows_what_the_silhouette_takes_in():
    """Picture and mesh have one colour, so that each pixel inside gains the same. Those at the margin do not count."""
    mesh, view = ball_and_camera(256)
    task = task_of(torch.rand(*view.size, 3), view, mesh.replace(colors=torch.full_like(mesh.colors, 0.5)))
    level = level_of(view, torch.full((*view.size, 3), 0.5))
    here, far, near = (
        one.term(flow, seen.tangents, torch.zeros_like(seen.alpha))
        for one, flow, seen in light_along(task, level, 5, 0.05, 1)
    )
    expected = float(far.cost - near.cost) / 0.1
    assert expected > 0.0 and float(here.gradient[0, 5]) == pytest.approx(expected, rel=0.03)


def test_the_light_terms_gradient_knows_what_other_terms_gain_where_the_surface_is_visible():
    """What covers a part of a surface moves along it, so that more of it counts as visible. Slopes are means of the picture's,
    which is flat in one half, and the render's: they are right for steps, and too low for the cost."""
    ball = Ball()
    image, middle = ball.image.clone(), torch.zeros(ball.n, ball.n)
    image[: ball.n // 2] = torch.tensor([0.05, 0.1, 0.5])
    middle[ball.n // 3 : 2 * ball.n // 3, ball.n // 3 : 2 * ball.n // 3] = 1.0  # which the ball covers all the time
    found = light_along(ball.task, level_of(ball.view, image), 4, 0.01, 4)
    gains = [seen.box.cut(middle)[None] for *_, seen in found]
    _, far, near = (float((gain * one.visible).sum()) for gain, (one, *_) in zip(gains, found, strict=True))
    one, flow, seen = found[0]
    alone, both = (one.term(flow, 0.0 * seen.tangents, factor * gains[0]).gradient[0, 4] for factor in (0.0, 1.0))
    assert far > near and float(both - alone) == pytest.approx((near - far) / 0.02, rel=0.35)


def test_what_covers_a_quarter_of_the_surface_is_found():
    """The picture is likelier than the colours nearby where it shows the surface, and not where it shows another texture."""
    ball = Ball()
    image = ball.image.clone()
    covered = torch.zeros(ball.n, ball.n, dtype=torch.bool)
    covered[:32, :32] = True
    image[covered] = torch.tensor([0.05, 0.1, 0.5])
    found, plain = ball.fitted(9, image), ball.fitted(9)
    inside, hidden = found.inside[0], ball.part(covered)
    near = ball.part(F.max_pool2d(covered[None].float(), 17, 1, 8)[0] > 0.0)
    assert float(plain.visible[0][inside].mean()) > 0.98
    assert float(found.visible[0][inside & hidden].mean()) < 0.4  # as little as one pixel's evidence says
    assert float(found.visible[0][inside & ~near].mean()) > 0.9
    other = Ball(truth=RIGHT._replace(R=rotation(0.0, 1.5, 0.4))).image
    right, part, wrong = (float(ball.term(one).cost) for one in (plain, found, ball.fitted(9, other)))
    assert right < part < -int(plain.inside.sum()) and right < 10.0 * wrong


@pytest.mark.quick
@pytest.mark.parametrize("known", [False, True])
@pytest.mark.parametrize(
    ("angle", "front", "behind"),
    [(0.1, (0.7, 0.4, 0.2), (0.3, 0.45, 0.5)), (0.5, (0.9, 0.6, 0.1), (0.1, 0.15, 0.2)),
     (2.1, (0.1, 0.15, 0.2), (0.9, 0.6, 0.1)), (-1.2, (0.8, 0.8, 0.8), (0.3, 0.3, 0.3))],
)  # fmt: skip
def test_a_contour_is_found_to_a_fiftieth_of_a_pixel(angle, front, behind, known):
    """A straight blurred edge between two textures is half a pixel off. Radiances are mixed, not display values, by which a
    bright contour before something dark would be found 0.2 pixels too far out."""
    n, shift, sharp, blur = 48, 0.5, 0.5, 0.9
    x, y = torch.meshgrid(torch.arange(n) + 0.0, torch.arange(n) + 0.0, indexing="xy")
    along = (x - 24.3) * math.cos(angle) + (y - 23.7) * math.sin(angle)
    front, behind = (srgb_to_linear(torch.tensor(colour)) for colour in (front, behind))
    if known:  # The background has a texture of its own.
        behind = behind * (0.5 + torch.rand(n, n, 1, generator=torch.Generator().manual_seed(1)))
    a = torch.special.ndtr((along - shift) / blur)[..., None]
    noise = 0.02 * torch.randn(n, n, 3, generator=torch.Generator().manual_seed(0))
    display = linear_to_srgb(a * front + (1 - a) * behind) + noise
    level = level_of(camera(n), srgb_to_linear(display), background=behind if known else None)
    ones, box = torch.ones(1, n, n), Box(slice(0, n), slice(0, n))

    def term(at):
        alpha = torch.special.ndtr((along - at) / sharp)[None]
        tangents = -torch.exp(-0.5 * ((along - at) / sharp).square()) / (sharp * math.sqrt(2 * math.pi))
        seen = RenderedPoses(box, alpha, tangents[None, None], None, None, None)
        noise = ContourNoise(math.sqrt(blur**2 - sharp**2), 0.03)
        sides = Sides.from_picture(level, seen, ones, None, ones, noise)
        return contour_term(level, sides, sides.gain(level.outlined), contour_rows(seen, noise.blur))

    at = 0.0
    for _ in range(6):
        at -= float(term(at).gradient / term(at).curvature)
    assert at == pytest.approx(shift, abs=0.02)
    assert float(term(shift).cost) < float(term(shift + 0.3).cost) and float(term(shift).cost) < float(term(0.2).cost)
    assert float(term(1e3).curvature) == 0.0


@pytest.mark.parametrize("scale", [1.0, 1.4])
@pytest.mark.parametrize("malformed", [False, True])
def test_a_shift_of_depth_is_found(malformed, scale):
    """A third may not be measured, while something stands before the object."""
    n, one = 48, torch.tensor(scale, dtype=F64)
    view = camera(n, 5.0)
    at = Pose(torch.eye(3, dtype=F64), (1 - one) * CENTER, one)
    task = task_of(torch.rand(n, n, 3), view)
    step = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.01], dtype=F64)
    there = moved_poses(task, [at], task.dofs, step[None])[0]
    moved = bracket().transformed(there.R, there.t, there.scale)
    aovs = eg.render_aovs(moved, view.to(F64), ["alpha", "depth"], spp=256, seed=0)
    measured = torch.where(aovs["alpha"] > 0.5, aovs["depth"] / aovs["alpha"], torch.nan)[..., 0].float()
    if malformed:
        measured[::3] = torch.nan
        measured[:, 20:24] = 2.0
    level = level_of(view, torch.rand(n, n, 3), measured)

    def term(pose, level=level):
        seen, moving = rendered(task, [pose], 256)
        return depth_term(level.part(seen.box), seen, moving, flow_of(seen, moving), one[None], SIZE)

    found = -torch.linalg.solve(term(at).curvature[0], term(at).gradient[0])
    assert float((found - step).norm()) < 0.0015, found
    assert float(found[5]) == pytest.approx(0.01, rel=0.03)
    assert float(term(there).cost) < float(term(at).cost) < 0.0
    assert not bool(term(at, replace(level, depth=torch.full_like(level.depth, torch.nan))).curvature.any())


def two_views(size=64):
    """Return the task of two photographs of the bracket, and their depths."""
    cameras = views(3, size)[:2]
    pictures = [photograph(view, seed=k) for k, view in enumerate(cameras)]
    task = PoseTask.from_arguments(bracket(), pictures, cameras, None, None, Unknowns(), 1.0, ArgumentNames())
    return task, [depth_of(view)[..., 0].float() for view in cameras]


def three_poses(task):
    steps = torch.stack([0.0 * STEP, STEP, -4.0 * STEP])
    return moved_poses(task, [RIGHT] * 3, task.dofs, steps)


def test_the_objective_is_the_sum_of_its_terms_for_each_pose_alone(monkeypatch):
    task, depths = two_views()
    depths[1] = None
    level = pose_levels(task, RIGHT, depths, Settings(seed=3))[-1]
    poses, kept = three_poses(task), []

    def noted(function):
        def call(*arguments):
            kept.append(function(*arguments))
            return kept[-1]

        return call

    for name in ("region_term", "contour_term"):
        monkeypatch.setattr(objective, name, noted(getattr(objective, name)))
    monkeypatch.setattr(Term, "counted", noted(Term.counted))  # of light and depth
    # With one seed and in one box, poses have the same samples in a batch and alone.
    for module in ("request", "operators"):
        monkeypatch.setattr(f"edgegrad.kernel.{module}.camera_seed", lambda seed, _: seed)
    monkeypatch.setattr(Box, "around", staticmethod(lambda _, camera: Box(*(slice(0, side) for side in camera.size))))
    model = level.model(poses)
    assert len(kept) == 7
    for found, parts in zip(
        (model.cost[:, 0], model.gradient, model.curvature), zip(*(one[:3] for one in kept), strict=True), strict=True
    ):
        torch.testing.assert_close(found, sum(parts))
    assert bool((torch.linalg.eigvalsh(model.curvature) > 0.0).all())
    single = [level.model([pose]) for pose in poses]
    for found, parts in zip(model[:3], zip(*(m[:3] for m in single), strict=True), strict=True):
        torch.testing.assert_close(found, torch.cat(parts), rtol=1e-4, atol=1e-4 * float(found.abs().max()))
    by_picture = [replace(level, pictures=(one,)).model(poses) for one in level.pictures]
    torch.testing.assert_close(model.gradient, by_picture[0].gradient + by_picture[1].gradient)
    assert float(model.cost[0]) < float(model.cost[2])


@pytest.mark.parametrize("blur", [0.5, 0.9])
def test_noise_and_blur_are_those_of_the_likeliest_pose(blur):
    view = camera(72)
    seen = picture(view).movedim(-1, 0)
    noise = 0.02 * torch.randn(3, *view.size, generator=torch.Generator().manual_seed(0))
    image = srgb_to_linear(linear_to_srgb(smoothed(seen, blur)) + noise).movedim(0, -1).clamp(0, 1)
    task = task_of(image, view, background=BACKGROUND)
    level = pose_levels(task, RIGHT, [None], Settings(seed=3, spp=64))[-1]
    poses = three_poses(task)
    informed = level.informed(poses)
    alone = [level.comparisons([pose])[0].light.deviation for pose in poses]
    assert informed.light_deviations[0] == pytest.approx(float(min(alone)), rel=0.05)
    known = informed.comparisons(poses)[0].light.deviation
    assert bool((known == known[0]).all()) and float(known[0]) == pytest.approx(informed.light_deviations[0])
    (noise,) = level.focused(RIGHT).contour_noises
    assert noise.blur == pytest.approx(blur, abs=0.21) and 0.007 < noise.deviation < 0.04


@pytest.mark.quick
def test_scores_of_pixels_nearby_have_bartletts_weights():
    s = torch.randn(1, 2, 6, 7, generator=torch.Generator().manual_seed(0))
    found = Term.zero(1, 2)._replace(summands=lambda: s).score_covariance(3.0)[0]
    at = torch.cartesian_prod(torch.arange(6), torch.arange(7)).to(F64)
    weight = (1.0 - (at[:, None] - at).abs() / 3.0).clamp(min=0.0).prod(-1)
    rows = s[0].flatten(1).double()
    torch.testing.assert_close(found, rows @ weight @ rows.T, rtol=1e-5, atol=1e-5)


UNUSUAL = {
    "usual": {}, "tiny": {"size": 12}, "plain": {"plain": True}, "mask": {"plain": True, "masked": True},
    "thin": {"width": 0.05}, "unweighted": {"weighted": 4},
}  # fmt: skip


@functools.cache
def unusual(size=128, width=1.0, plain=False, masked=False, weighted=128):
    """Return the levels of a picture whose object is so wide, or is compared in the upper rows alone."""
    view, mesh = camera(size), bracket(plain)
    mesh = mesh.replace(verts=CENTER + (mesh.verts - CENTER) * torch.tensor([1.0, width, width]))
    mask, weight = coverage(view).float() if masked else None, torch.zeros(size, size, 1)
    weight[:weighted] = 1.0
    return pose_levels(task_of(photograph(view, mesh), view, mesh, mask, weight), RIGHT, [None], Settings(seed=0))


@pytest.mark.parametrize("kind", UNUSUAL)
def test_levels_of_unusual_pictures(kind):
    levels = unusual(**UNUSUAL[kind])
    sizes = [level.size for level in levels]
    assert len(levels) > len(POSE.alpha_blurs) and sizes == sorted(sizes)
    assert [level.last for level in levels] == [False] * (len(levels) - 1) + [True]
    # A rod as long as the bracket, of a few pixels' width, would vanish on the level that the bracket has.
    assert (sizes[0] > unusual()[0].size) == (kind == "thin") and min(sizes[0]) >= 12
    assert levels[-1].harmonics == (0 if kind in ("plain", "mask") else 9)
    assert all((p.mask is not None) == (kind == "mask") for level in levels for p in level.pictures)
    for level in (levels[0], levels[-1]):
        model = level.model([RIGHT, RIGHT._replace(R=rotation(0.1, 0.0, 0.0))])
        assert all(bool(x.isfinite().all()) for x in model[:3])
        seen = model.curvature.diagonal(dim1=1, dim2=2)[:, :5] > 1e-6
        assert not bool(seen.any()) if kind == "unweighted" else bool(seen.all())
