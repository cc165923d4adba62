"""The terms of photographs (regions, light, contour, depth) against oracles."""

import math

import pytest
import torch
import trimesh
from brackets import CENTER, SIZE, bracket, camera
from motions import about

import edgegrad as eg
from edgegrad.camera.poses import rotation as turned
from edgegrad.files.image import linear_to_srgb, srgb_to_linear
from edgegrad.fit.contour_colors import CONTOUR_BLURS, PIXEL_NOISE, ContourColors, blur_losses, mask_noise
from edgegrad.fit.pose.jacobian import Rendered
from edgegrad.fit.pose.photo import light
from edgegrad.fit.pose.photo.contour import contour_term
from edgegrad.fit.pose.photo.depth import depth_term
from edgegrad.fit.pose.photo.light import FittedLight, _blurred_inside, harmonics_of
from edgegrad.fit.pose.photo.picture import Picture
from edgegrad.fit.pose.photo.region_term import region_term
from edgegrad.fit.pose.photo.surface_interior import AOVS, SurfaceInterior
from edgegrad.fit.region import OUTLIERS, Windows, palette, posterior, smoothed
from edgegrad.fit.views import area_mean


def picture_of(view, radiance):
    """Return a picture without a mask or depth, whose pixels count alike."""
    return Picture(view, radiance, linear_to_srgb(radiance.clamp(0, 1)), None, torch.ones(view.size), None)


def moved(mesh, step, axes, center, size=1.0):
    """Return the mesh after a rotation vector about the centre and a shift, both along axes, the rows of (3, 3), as of
    motions.about()."""
    R = turned(axes.T @ step[:3])
    return mesh.transformed(R, center + size * axes.T @ step[3:] - R @ center)


def test_the_region_terms_gradient_is_that_of_its_loss():
    """The posterior is held fixed. The reference is central differences of renders with many samples."""
    view, mesh = camera(40), bracket(plain=True)
    axes, sigma, h = view.world_to_camera[:3, :3].double(), 0.7, 0.005
    p = torch.rand(1, 5, 5, generator=torch.Generator().manual_seed(3))
    p = torch.nn.functional.interpolate(p[None], size=(40, 40), mode="bilinear")[0, 0].clamp(0.1, 0.9)
    near = (torch.arange(40) < 33).float().expand(40, 40)

    def alpha(step):
        with torch.no_grad():
            scene = moved(mesh, step, axes, CENTER, SIZE)
            return eg.render_aovs(scene, view, ["alpha"], spp=2048, seed=5)["alpha"][..., 0].float()

    def loss(step):
        soft = smoothed(alpha(step)[None], sigma)[0].double()
        return -float((near * (soft * p + (1 - soft) * (1 - p) + OUTLIERS).log()).sum())

    rendered = Rendered(eg.Scene([mesh]), view, ["alpha"], 512, 2)
    tangents = rendered.derivatives(about(CENTER, axes, SIZE))["alpha"][..., 0].float()
    zero = torch.zeros(6, dtype=torch.float64)
    normal, mean = region_term(p, alpha(zero), tangents, near, sigma)
    steps = h * torch.eye(6, dtype=torch.float64)
    expected = torch.tensor([(loss(step) - loss(-step)) / (2 * h) for step in steps]).double()
    assert float((normal.gradient - expected).norm() / expected.norm()) < 0.03, (normal.gradient, expected)
    assert mean == pytest.approx(loss(zero) / float(near.sum()), rel=1e-4)
    # Fisher's information: of each pixel the gradient's square.
    soft = smoothed(alpha(zero)[None], sigma)[0].double()
    slope = (2 * p - 1) / (soft * p + (1 - soft) * (1 - p) + OUTLIERS) * near
    J = smoothed(tangents, sigma).double() * slope
    torch.testing.assert_close(normal.curvature, torch.einsum("ahw,bhw->ab", J, J), rtol=1e-4, atol=1e-6)


def test_the_posterior_separates_colours_near_the_contour_alone():
    """The left object is red on green, the right one green on red: one pair of histograms for the picture would show
    nothing."""
    view = camera(60)
    alpha = torch.zeros(60, 60)
    alpha[20:40, 5:25] = alpha[20:40, 35:55] = 1.0
    red, green = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.1, 0.8, 0.1])
    left = (torch.arange(60) < 30).expand(60, 60)
    image = torch.where(((alpha > 0.5) == left)[..., None], red, green)
    picture = picture_of(view, image)
    colours = palette(picture.display, 0)
    P = posterior(
        Windows(picture.size, colours.labels(picture.display), colours.colours, 6.0), alpha, torch.ones(60, 60)
    )
    edge = smoothed(alpha[None], 1.5)[0]
    near = (edge > 0.02) & (edge < 0.98)
    assert float(P[near & (alpha > 0.5)].min()) > 0.8 and float(P[near & (alpha < 0.5)].max()) < 0.2
    whole = posterior(
        Windows(picture.size, colours.labels(picture.display), colours.colours, 1000.0), alpha, torch.ones(60, 60)
    )
    assert float(whole[near & (alpha > 0.5)].min()) < 0.6


def ball(size=64, step=None, spp=64):
    """Return a camera, and the surface of a sphere with smooth colours as it sees it."""
    sphere = trimesh.creation.icosphere(subdivisions=4)
    verts = torch.tensor(sphere.vertices.copy())
    waves = torch.tensor([[5.0, 1.0, 2.0], [-1.0, 6.0, 2.0], [2.0, -3.0, 5.0]]).double()
    colors = (0.5 + 0.3 * torch.sin(verts @ waves.T)).float()
    mesh = eg.Mesh(verts, torch.tensor(sphere.faces.copy()), colors=colors)
    view = eg.Camera.look_at((0.0, 0.0, 3.2), (0, 0, 0), fov_y=45.0, size=(size, size)).to(torch.float64)
    axes, center = view.world_to_camera[:3, :3], torch.zeros(3).double()
    if step is not None:
        mesh = moved(mesh, step, axes, center)
    with torch.no_grad():
        channels = eg.render_aovs(mesh, view, list(AOVS), spp=spp, seed=1)
    return view, SurfaceInterior.from_channels(view, channels, about(center, axes))


LIGHT = torch.tensor([
    [0.8, 0.1, 0.2, 0.15, 0.05, -0.04, 0.02, 0.03, -0.05],
    [0.6, -0.1, 0.15, 0.2, 0.02, 0.06, 0.03, -0.03, 0.04],
    [0.5, 0.05, 0.25, 0.1, -0.03, 0.02, -0.02, 0.05, 0.02],
])  # fmt: skip


def under(surface, coefficients):
    """Return the radiance (h, w, 3) of a surface in a light."""
    Y = harmonics_of(surface.normals)[..., : coefficients.shape[1]]
    return surface.channels["image"].float() * torch.einsum("hwn,cn->hwc", Y, coefficients)


def test_an_exposure_is_found():
    view, surface = ball()
    gain = torch.tensor([[1.7], [0.6], [0.9]])
    for harmonics in (1, 9):
        lit = FittedLight.from_picture(picture_of(view, under(surface, gain)), surface, harmonics)
        torch.testing.assert_close(lit.coefficients[:, :1], gain, rtol=2e-3, atol=0)
        assert float(lit.coefficients[:, 1:].abs().sum()) < 0.02


@pytest.mark.parametrize("malformed", [False, True])
def test_the_light_of_a_matte_ball_is_found(malformed, monkeypatch):
    """A tenth of the ball may have a shadow and a highlight, which the model lacks."""
    view, surface = ball()
    image, inside = under(surface, LIGHT), surface.inside
    malformed_image = image.clone()
    if malformed:
        malformed_image[20:26, 20:36] *= 0.3
        malformed_image[40:44, 34:42] = 0.9
    free = inside & (smoothed((malformed_image != image).any(-1).float()[None], 1.0)[0] == 0.0)

    def off(lit):
        return float(
            (lit.predicted - _blurred_inside(image.movedim(-1, 0), inside).movedim(0, -1))[free].norm()
            / image[free].norm()
        )

    assert off(FittedLight.from_picture(picture_of(view, malformed_image), surface, 9)) < 0.03  # the ridge
    monkeypatch.setattr(light, "LIGHT_RIDGE", 0.0)
    lit = FittedLight.from_picture(picture_of(view, malformed_image), surface, 9)
    assert off(lit) < (0.02 if malformed else 3e-4)
    # Half of a ball hardly separates the harmonics of z, and float32 solves for them: rounding differs by processor.
    assert float((lit.coefficients - LIGHT).norm() / LIGHT.norm()) < (0.2 if malformed else 0.08)


@pytest.mark.parametrize(("harmonics", "most"), [(1, 0.06), (9, 0.2)])
def test_a_step_of_the_light_term_undoes_a_small_motion(harmonics, most):
    """The motion is half a pixel and less, in a light that is solved for. Rotations of a ball look nearly like shifts,
    so the error of the step counts by how much of the picture it changes."""
    step = torch.tensor([0.008, -0.01, 0.012, 0.006, -0.005, 0.02]).double()
    view, surface = ball()
    _, there = ball(step=step)
    normal = FittedLight.from_picture(picture_of(view, under(there, LIGHT[:, :harmonics])), surface, harmonics).term()
    off = -torch.linalg.solve(normal.curvature, normal.gradient) - step
    share = float(off @ normal.curvature @ off) / float(step @ normal.curvature @ step)
    assert share**0.5 < most


@pytest.mark.parametrize(
    ("angle", "front", "behind"),
    [(0.0, (0.7, 0.4, 0.2), (0.3, 0.45, 0.5)), (0.5, (0.9, 0.6, 0.1), (0.1, 0.15, 0.2))],
)
def test_a_contour_is_found_to_a_fiftieth_of_a_pixel(angle, front, behind):
    """A straight blurred edge between two textures is half a pixel off. Radiances are mixed, not display values, by
    which a bright contour before something dark would be found 0.2 pixels too far out."""
    view, n, shift = camera(48), 48, 0.5
    x, y = torch.meshgrid(torch.arange(n) + 0.0, torch.arange(n) + 0.0, indexing="xy")
    along = x * math.cos(angle) + y * math.sin(angle)
    noise = 0.02 * torch.randn(n, n, 3, generator=torch.Generator().manual_seed(0))

    def alpha(at):
        return torch.special.ndtr((along - at) / 0.9)

    middle = 24.3 * math.cos(angle) + 23.7 * math.sin(angle)
    a = alpha(middle + shift)[..., None]
    front, behind = (srgb_to_linear(torch.tensor(colour)) for colour in (front, behind))
    display = linear_to_srgb(a * front + (1 - a) * behind) + noise
    picture = picture_of(view, srgb_to_linear(display))
    near, at = torch.ones(n, n), 0.0
    for _ in range(4):
        tangents = -torch.exp(-0.5 * ((along - middle - at) / 0.9).square()) / (0.9 * math.sqrt(2 * math.pi))
        sides = ContourColors.from_image(picture.display, alpha(middle + at), near)
        normal = contour_term(picture, sides, tangents[None])
        at -= float(normal.gradient / normal.curvature)
    assert at == pytest.approx(shift, abs=0.02)
    assert contour_term(picture, ContourColors.from_image(picture.display, alpha(1e3), near), tangents[None]) is None


def test_the_noise_of_a_mask_is_that_of_its_pixels():
    """A mask of a disc holds zeros and ones also where a pixel is mixed; it is taken whole and reduced."""
    n, fine = 96, (torch.arange(960) + 0.5) / 10
    disc = (fine - 47.4).square() + (fine[:, None] - 48.3).square() < 37.3**2
    exact = area_mean(disc[..., None].float(), (n, n))[..., 0]
    hard = (exact > 0.5).float()
    for factor, size in ((1.0, n), (1 / 3, n // 3)):
        right, seen = (area_mean(one[..., None], (size, size))[..., 0] for one in (exact, hard))
        off = (seen - right)[(right > 0.02) & (right < 0.98)].square().mean().sqrt()
        assert mask_noise(hard, factor) == pytest.approx(float(off), rel=0.3), factor
    assert mask_noise(exact, 1.0) == mask_noise(smoothed(hard[None], 0.7)[0], 1.0) == PIXEL_NOISE


@pytest.mark.parametrize("blur", CONTOUR_BLURS)
def test_how_sharp_a_contour_is(blur):
    """A noisy disc lies before something dark. The blur that it was taken with leaves the smallest residual."""
    view, n = camera(64), 64
    y, x = torch.meshgrid(torch.arange(n) + 0.5, torch.arange(n) + 0.5, indexing="ij")
    alpha = (17.3 - ((x - 31.6).square() + (y - 32.2).square()).sqrt()).add(0.5).clamp(0.0, 1.0)
    front, behind = (srgb_to_linear(torch.tensor(colour)) for colour in ((0.9, 0.6, 0.1), (0.1, 0.15, 0.2)))
    mixed = smoothed(alpha[None], blur)[0][..., None]
    noise = 0.02 * torch.randn(n, n, 3, generator=torch.Generator().manual_seed(0))
    picture = picture_of(view, srgb_to_linear(linear_to_srgb(mixed * front + (1 - mixed) * behind) + noise))
    sides = ContourColors.from_image(picture.display, smoothed(alpha[None], max(CONTOUR_BLURS))[0], torch.ones(n, n))
    losses = blur_losses(sides, picture.display, picture.weight, alpha)
    assert CONTOUR_BLURS[int(losses.argmin())] == blur, losses


@pytest.mark.parametrize("malformed", [False, True])
def test_a_shift_of_depth_is_found(malformed):
    """A third may not be measured, while something stands before the object."""
    view, mesh = camera(48).to(torch.float64), bracket()
    axes = view.world_to_camera[:3, :3].double()
    step = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.01]).double()

    def seen(one):
        with torch.no_grad():
            return eg.render_aovs(one, view, list(AOVS), spp=64, seed=1)

    surface = SurfaceInterior.from_channels(view, seen(mesh), about(CENTER, axes, SIZE))
    there = seen(moved(mesh, step, axes, CENTER, SIZE))
    measured = (there["depth"] / there["alpha"].clamp(min=1e-6))[..., 0].float()
    measured[there["alpha"][..., 0] < 0.5] = torch.nan
    if malformed:
        measured[::3] = torch.nan
        measured[:, 20:24] = 2.0
    normal = depth_term(surface, measured, torch.ones(48, 48), SIZE)
    found = -torch.linalg.solve(normal.curvature, normal.gradient)
    assert float((found - step).norm()) < (0.0015 if malformed else 0.0005), found
    assert float(found[5]) == pytest.approx(0.01, rel=0.03)
    assert depth_term(surface, torch.full((48, 48), torch.nan), torch.ones(48, 48), SIZE) is None
