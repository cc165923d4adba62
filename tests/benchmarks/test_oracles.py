"""The oracles checked without the kernel: exact pixel integrals against analytic ones, their gradient against finite
differences, and the sampled twin (oracles.reference) against both."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import pytest
import torch
from combinations import diagonal
from oracles import reference
from oracles.exact import exact_image, gauss_triangle
from scenes import cube, front_camera, icosphere, occluded_triangle, one_triangle, random_slivers
from torch import Tensor

from edgegrad.camera.camera import Camera
from edgegrad.scene.mesh import DEFAULT_RADIANCE, Mesh
from edgegrad.scene.scene import Scene

pytestmark = pytest.mark.unsanitized

PROJECTIONS = ("perspective", "orthographic")
KINDS = ("plain", "colors", "face_colors", "corner_colors", "texture")


def pixel_camera(height: int, width: int) -> Camera:
    """Orthographic, with world x and y in pixels: a mesh can be drawn in image coordinates."""
    return Camera(torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64), (height, width), "orthographic")


def flat(corners: list[list[float]], z: float = 1.0) -> Mesh:
    """A white convex polygon with the given corners (x, y) in pixels, as a fan of triangles."""
    verts = torch.tensor([[x, y, z] for x, y in corners], dtype=torch.float64)
    faces = torch.tensor([[0, k, k + 1] for k in range(1, len(corners) - 1)])
    return Mesh(verts, faces, face_colors=torch.ones((len(faces), 1), dtype=torch.float64))


def ground() -> Mesh:
    """Two large triangles behind the unit sphere, not quite in one plane."""
    verts = [[-3.0, -2.5, -1.3], [2.7, -2.9, -1.5], [3.1, 2.6, -1.2], [-2.8, 2.4, -1.6]]
    colors = [[0.2, 0.7, 0.3], [0.6, 0.3, 0.2]]
    return Mesh(
        torch.tensor(verts, dtype=torch.float64), torch.tensor([[0, 1, 2], [0, 2, 3]]),
        face_colors=torch.tensor(colors, dtype=torch.float64),
    )  # fmt: skip


SCENES: dict[str, Callable[[Camera], Scene]] = {
    "one triangle": lambda camera: one_triangle(),
    "occluded triangle": lambda camera: occluded_triangle(),
    "cube before a ground": lambda camera: Scene([cube(), ground()]),
    "sphere": lambda camera: Scene(icosphere(3)),
    "slivers": lambda camera: Scene(random_slivers(100, 0, camera)),
}


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def with_verts(scene: Scene, verts: list[Tensor]) -> Scene:
    return scene.replace(meshes=[mesh.replace(verts=v) for mesh, v in zip(scene.meshes, verts, strict=True)])


# -- exact_image: values ----------------------------------------------------------------------------------------------


def test_rectangle() -> None:
    x0, x1, y0, y1 = 2.25, 7.6, -0.5, 5.0  # beyond the image at the top, on a pixel border at the bottom
    image = exact_image(Scene(flat([[x0, y0], [x1, y0], [x1, y1], [x0, y1]])), pixel_camera(8, 10))[..., 0]

    def covered(n: int, low: float, high: float) -> Tensor:
        left = torch.arange(n, dtype=torch.float64)
        return ((left + 1.0).clamp(max=high) - left.clamp(min=low)).clamp(min=0.0)

    torch.testing.assert_close(image, torch.outer(covered(8, y0, y1), covered(10, x0, x1)), atol=1e-13, rtol=0.0)


def test_half_plane() -> None:
    """The part x + y ≤ s of a unit square at (x, y): (u² - 2 (u - 1)₊² + (u - 2)₊²) / 2 with u = (s - x - y)₊."""
    s = 7.3
    image = exact_image(Scene(flat([[s + 50.0, -50.0], [-50.0, s + 50.0], [-50.0, -50.0]])), pixel_camera(6, 9))[..., 0]
    corner = torch.arange(6, dtype=torch.float64)[:, None] + torch.arange(9, dtype=torch.float64)
    u0, u1, u2 = ((s - corner - k).clamp(min=0.0) for k in range(3))
    torch.testing.assert_close(image, 0.5 * (u0**2 - 2.0 * u1**2 + u2**2), atol=1e-11, rtol=0.0)


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_coverage_adds_up_to_the_area(projection: str) -> None:
    camera = front_camera(48, projection)
    mesh = one_triangle().meshes[0].replace(face_colors=torch.ones((1, 1), dtype=torch.float64))
    a, b, c = camera.project(mesh.verts)
    area = 0.5 * torch.linalg.det(torch.stack([b - a, c - a])).abs()
    torch.testing.assert_close(exact_image(Scene(mesh), camera).sum(), area, rtol=1e-12, atol=0.0)


def test_nearer_square_hides_the_farther_one() -> None:
    back = flat([[1.0, 1.0], [6.5, 1.0], [6.5, 6.5], [1.0, 6.5]], z=3.0)
    front = flat([[4.2, 0.5], [9.0, 0.5], [9.0, 5.0], [4.2, 5.0]], z=2.0)
    front = front.replace(face_colors=0.25 * front.face_colors)
    image = exact_image(Scene([front, back]), pixel_camera(10, 10))
    shared = (6.5 - 4.2) * (5.0 - 1.0)
    expected = 5.5 * 5.5 - shared + 0.25 * 4.8 * 4.5
    assert image.sum().item() == pytest.approx(expected, rel=1e-12)


def test_copied_vertices_change_nothing() -> None:
    """A soup of triangles, each with its own vertices, has edges that coincide only by position."""
    camera = front_camera(48)
    sphere = icosphere(1)
    soup = Mesh(
        sphere.verts[sphere.faces].reshape(-1, 3), torch.arange(sphere.faces.numel()).reshape(-1, 3),
        colors=sphere.colors[sphere.faces].reshape(-1, 3),
    )  # fmt: skip
    images, gradients = [], []
    for mesh in (sphere, soup):
        shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        images.append(exact_image(Scene([mesh.transformed(t=shift), ground()]), camera))
        gradients.append(torch.autograd.grad((images[-1] * random(48, 48, 3)).sum(), shift)[0])
    torch.testing.assert_close(*images, atol=1e-12, rtol=0.0)
    torch.testing.assert_close(*gradients, rtol=1e-9, atol=0.0)


def test_intersecting_faces_are_refused() -> None:
    """There the visible surface changes along a line that is no edge; better no answer than a wrong one."""
    tilted = flat([[1.0, 1.0], [6.0, 1.5], [2.0, 6.0]])
    tilted = tilted.replace(verts=tilted.verts + torch.tensor([[0.0, 0.0, -0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]))
    with pytest.raises(AssertionError, match="intersect"):
        exact_image(Scene([tilted, flat([[1.5, 0.5], [5.0, 2.0], [2.5, 5.5]])]), pixel_camera(8, 8))


def test_gauss_rule_is_exact_to_its_degree() -> None:
    """∫ a^i b^j c^k = 2 · i! j! k! / (i + j + k + 2)! over a triangle of unit area, in its barycentrics."""
    for order in (1, 2, 3, 5):
        points, weights = gauss_triangle(order)
        for i in range(2 * order - 1):
            for j in range(2 * order - 1 - i):
                k = 2 * order - 2 - i - j
                numbers = torch.tensor([i, j, k, i + j + k + 2], dtype=torch.float64)
                a, b, c, below = torch.lgamma(numbers + 1.0)
                value = (weights * points[:, 0] ** i * points[:, 1] ** j * points[:, 2] ** k).sum()
                torch.testing.assert_close(value, 2.0 * torch.exp(a + b + c - below), rtol=1e-12, atol=0.0)


@pytest.mark.parametrize("name", ["occluded triangle", "cube before a ground", "sphere"])
def test_gauss_rule_has_converged(name: str) -> None:
    camera = front_camera(48)
    scene = SCENES[name](camera)
    values = []
    for order in (5, 8):
        verts = [mesh.verts.clone().requires_grad_() for mesh in scene.meshes]
        image = exact_image(with_verts(scene, verts), camera, order)
        values.append([image, *torch.autograd.grad((image * random(48, 48, 3)).sum(), verts)])
    for low, high in zip(*values, strict=True):
        assert (low - high).abs().max() < 1e-10 * max(1.0, high.abs().max().item())


# -- exact_image: gradients -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "projection"),
    [
        *diagonal([name for name in SCENES if name != "slivers"], PROJECTIONS),
        *(pytest.param("slivers", projection, marks=pytest.mark.slow) for projection in PROJECTIONS),
    ],
)
def test_exact_gradient(name: str, projection: str) -> None:
    """All inputs moved together, in a random direction, against central differences.

    The step leaves rounding, 1e-16 · 1e3 (the loss) / 1e-7 = 1e-6 absolute, and steps of the second derivative where
    corners pass lines; both stay below 1e-6 of gradients of about 100 and more.
    """
    camera = front_camera(48, projection)
    scene = SCENES[name](camera)
    weight = random(48, 48, 3, seed=1)
    turn = torch.linalg.cross(torch.eye(3, dtype=torch.float64), random(3, seed=2).expand(3, 3))
    n = len(scene.meshes)
    colors = [mesh.colors if mesh.colors is not None else mesh.face_colors for mesh in scene.meshes]
    start = [mesh.verts for mesh in scene.meshes] + colors + [random(3, seed=3).abs()]
    start += [camera.world_to_camera[:3], camera.K[:2]]
    direction = [random(*x.shape, seed=i) for i, x in enumerate(start)]
    direction[-2][:, :3] = camera.world_to_camera[:3, :3] @ turn

    def loss(inputs: list[Tensor]) -> Tensor:
        meshes = [
            mesh.replace(verts=v, **{"face_colors" if mesh.colors is None else "colors": c})
            for mesh, v, c in zip(scene.meshes, inputs[:n], inputs[n : 2 * n], strict=True)
        ]
        *_, background, M, K = inputs
        moved = camera.replace(
            world_to_camera=torch.cat([M, camera.world_to_camera[3:]]), K=torch.cat([K, camera.K[2:]])
        )
        return (weight * exact_image(Scene(meshes, background), moved)).sum()

    inputs = [x.clone().requires_grad_() for x in start]
    gradients = torch.autograd.grad(loss(inputs), inputs)
    exact = sum((g * d).sum().item() for g, d in zip(gradients, direction, strict=True))
    step = 1e-7
    with torch.no_grad():
        ends = [loss([x + s * d for x, d in zip(start, direction, strict=True)]) for s in (step, -step)]
    difference = ((ends[0] - ends[1]) / (2.0 * step)).item()
    assert exact == pytest.approx(difference, rel=1e-6, abs=1e-5)


def test_interior_gradient_alone_is_rejected() -> None:
    """The oracle must show a gradient that lacks its boundary term: of a constant colour, that is all there is."""
    camera = front_camera(48)
    for colored in (True, False):
        mesh = one_triangle().meshes[0]
        if not colored:
            mesh = mesh.replace(face_colors=torch.ones((1, 3), dtype=torch.float64))
        gradients = []
        for image_of in (exact_image, reference.render):
            verts = mesh.verts.clone().requires_grad_()
            image = image_of(Scene(mesh.replace(verts=verts)), camera)
            gradients.append(torch.autograd.grad((image * random(48, 48, 3)).sum(), verts)[0])
        exact, interior = gradients
        assert (interior - exact).norm() > 0.3 * exact.norm()
        if not colored:
            # Only rounding is left of the derivative of barycentrics that sum to one.
            assert interior.norm() < 1e-9 * exact.norm()


def test_interior_gradient_suffices_where_no_edge_is_seen() -> None:
    """Within a face both oracles must agree, up to the midpoint rule's error, O(grid⁻²) of little curvature."""
    camera = front_camera(48).crop(22, 20, 6, 6)
    mesh = one_triangle().meshes[0]
    gradients = []
    for image_of in (exact_image, reference.render):
        verts, M = (x.clone().requires_grad_() for x in (mesh.verts, camera.world_to_camera))
        image = image_of(Scene(mesh.replace(verts=verts)), camera.replace(world_to_camera=M))
        gradients.append(torch.autograd.grad((image * random(6, 6, 3)).sum(), [verts, M]))
    for exact, interior in zip(*gradients, strict=True):
        assert (interior - exact).norm() < 1e-5 * exact.norm()


# -- reference --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "projection"), diagonal(list(SCENES), PROJECTIONS))
def test_reference_converges_to_exact(name: str, projection: str) -> None:
    """A pixel that an edge crosses has an error of O(1/grid), and less where edges lie at odd angles to the grid."""
    camera = front_camera(24, projection)
    scene = SCENES[name](camera)
    exact = exact_image(scene, camera)
    coarse, fine = ((reference.render(scene, camera, grid) - exact).square().mean().sqrt() for grid in (3, 12))
    assert coarse < 0.06
    assert fine < 0.35 * coarse


def colored(kind: str, mesh: Mesh, seed: int = 5) -> Mesh:
    """The mesh with random colours of a kind."""
    V, F = len(mesh.verts), len(mesh.faces)
    shapes = {"colors": (V, 2), "face_colors": (F, 2), "corner_colors": (F, 3, 2), "texture": (3, 5, 2)}
    if kind == "plain":
        return mesh.replace(colors=None)
    value = random(*shapes[kind], seed=seed)
    if kind != "texture":
        return mesh.replace(**{kind: value})
    return mesh.replace(texture=value, uvs=random(V + 1, 2, seed=seed + 1), uv_faces=mesh.faces + 1)


@pytest.mark.parametrize("projection", PROJECTIONS)
@pytest.mark.parametrize("kind", KINDS)
def test_reference_gradient(kind: str, projection: str) -> None:
    camera = front_camera(8, projection)
    scene = Scene([colored(kind, mesh) for mesh in occluded_triangle().meshes], random(2, seed=9))
    points = 1.0 + 6.0 * torch.rand((24, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    faces = reference.closest_faces(scene, camera, points)
    assert set(faces.tolist()) == {-1, 0, 1}
    names = ["verts", *{"plain": [], "texture": ["texture", "uvs"]}.get(kind, [kind])]
    n = len(names)

    def radiance(M: Tensor, K: Tensor, background: Tensor, *values: Tensor) -> Tensor:
        moved = camera.replace(
            world_to_camera=torch.cat([M, camera.world_to_camera[3:]]), K=torch.cat([K, camera.K[2:]])
        )
        meshes = []
        for mesh, fields in zip(scene.meshes, (values[:n], values[n:]), strict=True):
            meshes.append(dataclasses.replace(mesh, **dict(zip(names, fields, strict=True))))
        return reference.radiance(Scene(meshes, background), moved, points, faces)

    inputs = [camera.world_to_camera[:3], camera.K[:2], scene.background]
    inputs += [getattr(mesh, name) for mesh in scene.meshes for name in names]
    assert torch.autograd.gradcheck(radiance, [x.clone().requires_grad_() for x in inputs], fast_mode=True)


def test_perspective_correct_interpolation() -> None:
    """Halfway between the images of two corners at the depths 1 and 3, the second has the weight 1 / (1 + 3)."""
    camera = Camera(torch.eye(4, dtype=torch.float64), torch.eye(3, dtype=torch.float64), (1, 1))
    verts = torch.tensor([[0.0, 0.0, 1.0], [3.0, 0.0, 3.0], [0.0, 5.0, 1.0]], dtype=torch.float64)
    mesh = Mesh(verts, torch.tensor([[0, 1, 2]]), colors=torch.eye(3, dtype=torch.float64))
    value = reference.radiance(Scene(mesh), camera, torch.tensor([[0.5, 0.0]]), torch.tensor([0]))
    torch.testing.assert_close(value, torch.tensor([[0.75, 0.25, 0.0]], dtype=torch.float64))


def test_texture_lookup() -> None:
    """Rows run down while v runs up; texel centres at +0.5; beyond the border the texture repeats."""
    texture = torch.tensor([[[1.0], [2.0]], [[3.0], [4.0]]], dtype=torch.float64)
    quad = flat([[0.0, 4.0], [4.0, 4.0], [4.0, 0.0], [0.0, 0.0]])  # lower left, lower right, upper right, upper left
    uvs = torch.tensor([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], dtype=torch.float64)
    scene = Scene(quad.replace(texture=texture, uvs=uvs, uv_faces=quad.faces))
    points = torch.tensor([[1.0, 1.0], [3.0, 1.0], [1.0, 3.0], [3.0, 3.0], [2.0, 1.0], [1e-12, 1.0], [1.0, 1e-12]])
    values = reference.radiance(scene, pixel_camera(4, 4), points)[:, 0]
    expected = torch.tensor([1.0, 2.0, 3.0, 4.0, 1.5, 1.5, 2.0], dtype=torch.float64)
    torch.testing.assert_close(values, expected, atol=1e-9, rtol=0.0)


def test_what_lies_behind_the_camera() -> None:
    """A face that reaches behind a perspective camera is seen up to its horizon; an orthographic camera sees all."""
    verts = torch.tensor([[-9.0, 1.0, -4.0], [9.0, 1.0, -4.0], [0.0, 1.0, 40.0]], dtype=torch.float64)
    scene = Scene(Mesh(verts, torch.tensor([[0, 1, 2]])))
    K = torch.tensor([[10.0, 0.0, 5.0], [0.0, 10.0, 5.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    camera = Camera(torch.eye(4, dtype=torch.float64), K, (10, 10))
    rows = torch.tensor([[5.0, 0.5], [5.0, 4.5], [5.0, 5.2], [5.0, 5.3], [5.0, 9.5]])  # the horizon is at y = 5 + 10/40
    assert reference.closest_faces(scene, camera, rows).tolist() == [-1, -1, -1, 0, 0]
    tilted = scene.meshes[0].replace(verts=torch.tensor([[0.0, 0.0, -4.0], [9.0, 0.0, -9.0], [0.0, 9.0, 40.0]]))
    assert reference.closest_faces(Scene(tilted), camera.replace(projection="orthographic"), rows + 0.1).max() == 0


def test_boxes_leave_out_no_face() -> None:
    """`closest_faces` tests a block of points against the faces near it; one point at a time must find the same."""
    camera = front_camera(16)
    scene = SCENES["slivers"](camera)
    points = 16.0 * torch.rand((300, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    together = reference.closest_faces(scene, camera, points)
    P, Z = reference._project(scene, camera)
    w = reference._edge_functions(P, points[:, None])
    depth = torch.where((w.amin(-1) >= 0) | (w.amax(-1) <= 0), (w * Z).sum(-1) / w.sum(-1), torch.inf)
    assert torch.equal(together, torch.where(depth.isfinite().any(-1), depth.argmin(-1), -1))


@pytest.mark.parametrize(("filter", "variance"), [("box", 1.0 / 12.0), ("tent", 1.0 / 6.0), ("gaussian", 0.24332)])
def test_filter_weights(filter: str, variance: float) -> None:
    """Rows sum to one and have the filter's variance; for a Gaussian of 0.5 px, cut at three times that, 0.9733 / 4."""
    samples, weights = reference._filter_matrix(5, 64, filter)
    distance = samples - (torch.arange(5, dtype=torch.float64) + 0.5)[:, None]
    torch.testing.assert_close(weights.sum(1), torch.ones(5, dtype=torch.float64))
    torch.testing.assert_close((weights * distance).sum(1), torch.zeros(5, dtype=torch.float64), atol=1e-12, rtol=0.0)
    torch.testing.assert_close((weights * distance**2).sum(1), torch.full((5,), variance).double(), atol=1e-4, rtol=0.0)


@pytest.mark.parametrize("filter", reference.FILTERS)
def test_background_image_fills_what_is_not_covered(filter: str) -> None:
    camera = front_camera((12, 16))
    background = random(12, 16, 3).abs()
    mesh = cube().replace(colors=None)
    white = reference.render(Scene(mesh, torch.ones(3, dtype=torch.float64)), camera, 4, filter)
    coverage = (1.0 - white) / (1.0 - DEFAULT_RADIANCE)
    expected = DEFAULT_RADIANCE * coverage + (1.0 - coverage) * background
    torch.testing.assert_close(reference.render(Scene(mesh, background), camera, 4, filter), expected)
    if filter == "box":
        exact = exact_image(Scene(mesh, background), camera)
        assert (exact - expected).abs().mean() < 0.01


def test_a_point_sees_the_background_of_its_pixel() -> None:
    background = random(4, 6, 1)
    scene = Scene(flat([[1.0, 1.0], [2.0, 1.0], [1.0, 2.0]]), background)
    values = reference.radiance(scene, pixel_camera(4, 6), torch.tensor([[5.5, 3.2], [-0.5, 0.5], [1.2, 1.2]]))
    assert values[:, 0].tolist() == pytest.approx([background[3, 5].item(), background[0, 0].item(), 1.0])


# -- scenes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("mesh", [cube(), icosphere(2)], ids=["cube", "icosphere"])
def test_closed_meshes_are_watertight_and_outward(mesh: Mesh) -> None:
    edges = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    assert {(a, b) for a, b in edges.tolist()} == {(b, a) for a, b in edges.tolist()}
    assert len(torch.unique(edges, dim=0)) == len(edges)
    assert len(mesh.verts) - len(edges) // 2 + len(mesh.faces) == 2
    assert (torch.linalg.det(mesh.verts[mesh.faces]) > 0).all()


@pytest.mark.parametrize("projection", PROJECTIONS)
def test_slivers_lie_in_view_at_depths_of_their_own(projection: str) -> None:
    camera = front_camera((48, 64), projection)
    mesh = random_slivers(30, 1, camera)
    M = camera.world_to_camera
    depth = (mesh.verts @ M[:3, :3].mT + M[:3, 3])[mesh.faces][..., 2]
    assert (depth - depth[:, :1]).abs().max() < 1e-12
    assert torch.sort(depth[:, 0])[0].diff().min() > 1e-3
    pixels = camera.project(mesh.verts)
    assert ((pixels > 0) & (pixels < torch.tensor([64.0, 48.0]))).float().mean() > 0.9
