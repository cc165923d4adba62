"""Shadow boundaries, against exact areas: a rectangle casts its shadow on a plane, and a camera below it sees nothing else."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable

import pytest
import torch
from finite_differences import check, estimate
from lit_scenes import vector
from sampling_options import with_sampling
from torch import Tensor

import edgegrad as eg

pytestmark = [pytest.mark.quick, pytest.mark.watched]

FOCAL, HEIGHT, SIZE = 45.0, 0.9, 96  # of the camera: px, world units above the plane, px
CORNERS = ((-0.3, -0.2), (0.35, -0.2), (0.35, 0.25), (-0.3, 0.25))
DOUBLE = torch.float64


class Setting:
    """All that may move: the caster's corners (4, 2) and height, the light, the plane's height, the camera."""

    motions: dict[str, Callable[[Setting, Tensor], None]]

    def __init__(self) -> None:
        self.corners = torch.tensor(CORNERS, dtype=DOUBLE)
        self.height = torch.tensor(1.4, dtype=DOUBLE)
        self.light = vector(0.2, 0.1, 4.0)  # its place, or the direction towards it
        self.ground = torch.tensor(0.0, dtype=DOUBLE)
        self.camera = vector(0.05, -0.04, HEIGHT)
        self.focal = torch.tensor(FOCAL, dtype=DOUBLE)

    def scene(self, lights: Callable[[Setting], eg.Mesh | object]) -> eg.Scene:
        caster = torch.cat([self.corners, self.height.expand(4, 1)], 1)
        square = torch.tensor([[-9.0, -9], [9, -9], [9, 9], [-9, 9]], dtype=DOUBLE)
        ground = torch.cat([square, self.ground.expand(4, 1)], 1)
        faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
        return eg.Scene([eg.Mesh(ground, faces), eg.Mesh(caster, faces)], lights=[lights(self)])

    def view(self) -> eg.Camera:
        """Straight down, x to the right and y down in the image."""
        rotation = torch.tensor([[1.0, 0, 0], [0, -1, 0], [0, 0, -1]], dtype=DOUBLE)
        pose = torch.cat([rotation, (-rotation @ self.camera)[:, None]], 1)
        pose = torch.cat([pose, vector(0, 0, 0, 1)[None]])
        zero, one, middle = (torch.tensor(n, dtype=DOUBLE) for n in (0.0, 1.0, SIZE / 2))
        K = torch.stack([self.focal, zero, middle, zero, self.focal, middle, zero, zero, one]).reshape(3, 3)
        return eg.Camera(world_to_camera=pose, K=K, size=(SIZE, SIZE))

    def outline(self) -> Tensor:
        """(N, 2) of what of the caster is there."""
        return self.corners

    def shadow(self, light: Tensor, infinite: bool) -> Tensor:
        """Its corners in the image (N, 2)."""
        outline = self.outline()
        n = len(outline)
        p = torch.cat([outline, self.height.expand(n, 1)], 1)
        d = -light.expand(n, 3) if infinite else p - light
        y = p + ((self.ground - self.height) / d[:, 2])[:, None] * d
        x = (y - self.camera)[:, :2] * torch.tensor([1.0, -1.0]) * self.focal / (self.camera[2] - self.ground)
        return x + SIZE / 2


def moment(polygon: Tensor) -> Tensor:
    """∫ (1 + x / 40) dx over a polygon (N, 2), by Green's theorem."""
    x, y = polygon.unbind(1)
    x1, y1 = x.roll(-1), y.roll(-1)
    wedge = x * y1 - x1 * y
    return (wedge.sum() / 2 + ((x + x1) * wedge).sum() / 6 / 40) * torch.sign(wedge.sum().detach())


def adjoint() -> Tensor:
    """Return an adjoint whose image through a tent filter is 1 + x / 40, away from the border."""
    x = torch.arange(SIZE, dtype=DOUBLE) + 0.5
    return (1 + x / 40).expand(SIZE, SIZE)[:, :, None]


def visibility(hits: eg.points.Hits) -> Tensor:
    (light,) = hits.lights
    return hits.visible_from(light, hits.light_points(light))[:, None]


def point(s: Setting) -> object:
    return eg.lights.PointLight(s.light)


def sun(s: Setting) -> object:
    return eg.lights.DirectionalLight(-s.light)


def spot(s: Setting) -> object:
    return eg.lights.SpotLight(s.light, vector(0, 0, -1), outer_angle=1.0)


LIGHTS = {"point": point, "sun": sun, "spot": spot}
MOTIONS: dict[str, Callable[[Setting, Tensor], None]] = {
    "caster moves": lambda s, t: setattr(s, "corners", s.corners + t * vector(1.0, 0.3)),
    "caster grows": lambda s, t: setattr(s, "corners", s.corners * (1 + t)),
    "one corner": lambda s, t: setattr(
        s, "corners", s.corners + t * torch.eye(4, dtype=DOUBLE)[:, :1] * vector(1, 0.5)
    ),
    "caster rises": lambda s, t: setattr(s, "height", s.height + t),
    "light moves": lambda s, t: setattr(s, "light", s.light + t * vector(1.0, -0.4, 0.3)),
    "ground rises": lambda s, t: setattr(s, "ground", s.ground + t),
    "camera moves": lambda s, t: setattr(s, "camera", s.camera + t * vector(0.7, 0.2, 0.5)),
    "focal length": lambda s, t: setattr(s, "focal", s.focal * (1 + t)),
}
Setting.motions = MOTIONS


def gradient(
    motion: str, lights: Callable[[Setting], object], seed: int, kind: type[Setting] = Setting, **options: object
) -> float:
    setting, theta = kind(), torch.zeros((), dtype=DOUBLE, requires_grad=True)
    setting.motions[motion](setting, theta)
    image = eg.render(
        setting.scene(lights),
        setting.view(),
        spp=4,
        seed=seed,
        filter="tent",
        shader=visibility,
        **with_sampling(options, creases=False),
    )
    return torch.autograd.grad((image * adjoint()).sum(), theta)[0].item()


def exact(motion: str, points: Tensor | None = None, infinite: bool = False, kind: type[Setting] = Setting) -> float:
    """Return the derivative of what is lit, minus the shadow; the mean over points of a light as offsets (K, 3) if given."""
    setting, theta = kind(), torch.zeros((), dtype=DOUBLE, requires_grad=True)
    setting.motions[motion](setting, theta)
    offsets = torch.zeros((1, 3), dtype=DOUBLE) if points is None else points
    shadows = [moment(setting.shadow(setting.light + offset, infinite)) for offset in offsets]
    return -torch.autograd.grad(torch.stack(shadows).mean(), theta)[0].item()


# All motions by one light, and what each light makes of its own.
@pytest.mark.parametrize(
    ("motion", "light"),
    [
        pytest.param(
            motion,
            light,
            marks=[] if light == "point" or motion in ("light moves", "caster rises") else [pytest.mark.slow],
        )
        for motion in MOTIONS
        for light in LIGHTS
    ],
)
def test_shadow_of_a_rectangle(motion: str, light: str) -> None:
    found = estimate([gradient(motion, LIGHTS[light], seed) for seed in range(4)])
    check(f"{light}, {motion}", exact(motion, infinite=light == "sun"), found)


U, V = vector(0.5, 0.0, 0.1), vector(0.0, 0.4, 0.0)  # half the sides of an emissive rectangle


def panel(s: Setting) -> object:
    return eg.shapes.rectangle(s.light, U, V, material=eg.Material(base_color=0.0, emission=1.0))


def of_panel(motion: str, kind: type[Setting] = Setting) -> float:
    """The mean over all points of the panel: Gauss and Legendre's rule with five points a side."""
    nodes = torch.tensor([-math.sqrt(5 + 2 * math.sqrt(10 / 7)), -math.sqrt(5 - 2 * math.sqrt(10 / 7)), 0.0])
    nodes = torch.cat([nodes, -nodes[:2].flip(0)]).double() / 3
    heavy, light = (322 + 13 * math.sqrt(70)) / 900, (322 - 13 * math.sqrt(70)) / 900
    weight = vector(light, heavy, 128 / 225, heavy, light) / 2
    return sum(
        float(wa * wb) * exact(motion, (a * U + b * V)[None], kind=kind)
        for a, wa in zip(nodes, weight, strict=True)
        for b, wb in zip(nodes, weight, strict=True)
    )


OF_PANELS = ("caster moves", "caster rises", "light moves", "ground rises")


@pytest.mark.parametrize(
    "motion", [motion if motion in OF_PANELS else pytest.param(motion, marks=pytest.mark.slow) for motion in MOTIONS]
)
def test_penumbra_of_a_rectangle(motion: str) -> None:
    found = estimate([gradient(motion, panel, seed) for seed in range(4)])
    check(f"panel, {motion}", of_panel(motion), found)


def sky(s: Setting) -> object:
    return eg.lights.Environment(vector(1.0), visible=False)


def of_sky(motion: str, kind: type[Setting] = Setting) -> float:
    """Return the derivative of the sky's light: the caster hides the solid angle that it is seen under (van Oosterom and
    Strackee 1983)."""
    setting, theta = kind(), torch.zeros((), dtype=DOUBLE, requires_grad=True)
    setting.motions[motion](setting, theta)
    pixel = torch.arange(SIZE, dtype=DOUBLE) + 0.5 - SIZE / 2
    y, x = torch.meshgrid(-pixel, pixel, indexing="ij")
    place = (
        torch.stack([x, y, -setting.focal.expand(SIZE, SIZE)], -1) * (setting.camera[2] / setting.focal)
        + setting.camera
    )
    outline = setting.outline()
    corners = torch.cat([outline, setting.height.expand(len(outline), 1)], 1)
    a, *others = torch.nn.functional.normalize(corners - place[:, :, None], dim=-1).unbind(2)
    hidden = torch.zeros(SIZE, SIZE, dtype=DOUBLE)
    for b, c in itertools.pairwise(others):
        volume = (a * torch.linalg.cross(b, c)).sum(-1)
        around = 1 + (a * b).sum(-1) + (b * c).sum(-1) + (c * a).sum(-1)
        hidden = hidden + 2 * torch.atan2(volume, around) / (4 * math.pi)
    return -torch.autograd.grad((hidden[:, :, None] * adjoint()).sum(), theta)[0].item()


def test_shadow_before_an_even_sky() -> None:
    found = estimate([gradient("caster grows", sky, seed) for seed in range(32)])
    check("sky, caster grows", of_sky("caster grows"), found)


def emitter(s: Setting) -> object:
    """The panel as 800 faces."""
    n = 20
    x, y = torch.meshgrid(torch.linspace(-1, 1, n + 1), torch.linspace(-1, 1, n + 1), indexing="ij")
    verts = s.light + x.reshape(-1, 1).double() * U + y.reshape(-1, 1).double() * V
    corner = (torch.arange(n)[:, None] * (n + 1) + torch.arange(n)).reshape(-1, 1)
    faces = torch.cat([corner + torch.tensor([0, n + 1, n + 2]), corner + torch.tensor([0, n + 2, 1])])
    return eg.Mesh(verts, faces, material=eg.Material(emission=torch.ones(1, dtype=DOUBLE), two_sided=True))


@pytest.mark.unwatched
def test_emitter_of_many_faces() -> None:
    """It casts the shadows of a panel of two faces, and moves with all its vertices."""
    for motion in ("caster moves", "light moves"):
        few = estimate([gradient(motion, panel, seed) for seed in range(4)])
        many = estimate([gradient(motion, emitter, seed) for seed in range(4)])
        check(f"light, {motion}", few.mean, many)


def test_triangles_of_directions() -> None:
    """They cover the sphere, each once, and where many directions are they are small."""
    from edgegrad.points.shadows import triangles_of

    generator = torch.Generator().manual_seed(0)
    directions = torch.randn((1 << 12, 3), generator=generator, dtype=DOUBLE)
    directions[: 1 << 11] = vector(0.3, -0.2, 0.9) + 0.01 * directions[: 1 << 11]
    corner, chance = triangles_of(torch.nn.functional.normalize(directions, dim=1))
    # Of a solid angle, by Van Oosterom and Strackee (1983).
    a, b, c = torch.nn.functional.normalize(corner, dim=2).unbind(1)
    volume = torch.linalg.det(torch.stack([a, b, c], 1)).abs()
    angle = 2 * torch.atan2(volume, 1 + (a * b).sum(1) + (b * c).sum(1) + (c * a).sum(1))
    assert angle.sum().item() == pytest.approx(4 * torch.pi)
    assert chance.max() < 1.5 / 12
    assert angle[chance > 0.02].min() < 0.01


@pytest.mark.parametrize("mode", ["MASK", "BLEND"])
@pytest.mark.parametrize("alpha", [0.4, 0.9])
def test_masked_faces_cast_no_shadow(mode, alpha):
    """Shadow rays pass where alpha is below ½: the gradient is then that without shadows; above, it is another."""
    square = torch.tensor([[-0.8, -0.3, 1.0], [0.8, -0.3, 1.0], [0.8, 0.9, 1.0], [-0.8, 0.9, 1.0]])
    faces, uvs = torch.tensor([[0, 1, 2], [0, 2, 3]]), torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    below = torch.tensor([[-3.0, -1, -3], [-3, -1, 3], [3, -1, 3], [3, -1, -3]])
    floor = eg.Mesh(below, faces, material=eg.Material(0.6))
    camera = eg.Camera.look_at((0, 2.5, 4), (0, -0.3, 0), fov_y=45, size=(32, 32))
    found = []
    for shadows in (True, False):
        verts = square.clone().requires_grad_()
        appearance = {"alpha": torch.full((2, 2), alpha), "material": eg.Material(0.5, alpha_mode=mode)}
        sheet = eg.Mesh(verts, faces, uvs=uvs, uv_faces=faces, **appearance)
        scene = eg.Scene([sheet, floor], lights=[eg.lights.PointLight(torch.tensor([1.2, 2.5, 2.5]), 15.0)])
        image = eg.render(scene, camera, spp=16, shadows=shadows, seed=0)
        (image * torch.linspace(-1, 1, 32)[:, None, None]).sum().backward()
        found.append(verts.grad)
    with_shadows, without = found
    if alpha < 0.5:
        torch.testing.assert_close(with_shadows, without, rtol=1e-4, atol=1e-4)
    else:
        assert float((with_shadows - without).norm()) > 0.2 * float(without.norm())


def test_shadows_fall_on_each_of_two_transparent_sheets():
    """Sheets of alpha 0.4, one behind the other as seen from the light, side by side as seen from the camera, before black: the
    image and its gradient are 0.4 of those of each as if it were opaque and the other were not there."""
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=DOUBLE)
    camera = eg.Camera.look_at((0.8, 0, 5), (0.8, 0, 0), up=(0.37, 1, 0), fov_y=50, size=(48, 48))
    weights = (
        torch.linspace(-1, 1.5, 48, dtype=DOUBLE)[:, None, None] * torch.linspace(0.2, 1, 48, dtype=DOUBLE)[:, None]
    )

    def upright(x0: float, x1: float, y0: float, y1: float, z: float) -> Tensor:
        return torch.tensor([[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]], dtype=DOUBLE)

    near, far = upright(-1.5, 0.3, -1, 1, 0), upright(0.5, 3, -1.4, 1.4, -1.5)

    def gradient(alpha: float | None, *sheets: Tensor) -> Tensor:
        caster, light = upright(-1.9, -1.4, -0.4, 0.3, 1.2).requires_grad_(), vector(-3.5, 0.3, 3.4).requires_grad_()
        appearance = {"material": eg.Material(0.8)}
        if alpha is not None:
            appearance = {
                "material": eg.Material(0.8, alpha_mode="BLEND"),
                "alpha": torch.full((2, 2), alpha, dtype=DOUBLE),
            }
        meshes = [eg.Mesh(sheet, faces, uvs=uvs, uv_faces=faces, **appearance) for sheet in sheets]
        scene = eg.Scene(
            [*meshes, eg.Mesh(caster, faces, material=eg.Material(0.3))], lights=[eg.lights.PointLight(light, 30.0)]
        )
        image = eg.render(scene, camera, spp=16, sampling=eg.Sampling(edges=1 << 14), seed=0)
        (image * weights).sum().backward()
        assert caster.grad is not None and light.grad is not None
        return torch.cat([caster.grad, light.grad[None]])

    both, first, second = gradient(0.4, near, far), gradient(None, near), gradient(None, far)
    assert second.norm() > 0.1 * first.norm()  # that of each is told from none
    torch.testing.assert_close(both, 0.4 * (first + second), rtol=0, atol=0.01 * float(both.norm()))
