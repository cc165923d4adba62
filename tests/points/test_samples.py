"""Parts to build renderers from: any rays, the hits of an image, samples and shadow rays."""

from __future__ import annotations

import math

import pytest
import torch
from scenes import front_camera, icosphere, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

pytestmark = pytest.mark.watched

F64 = torch.float64
SIZE = 24


def ball(level: int = 2) -> eg.Mesh:
    mesh = icosphere(level)
    return mesh.replace(verts=0.9 * mesh.verts, colors=smooth_colors(mesh.verts))


def floor_and_wall() -> eg.Mesh:
    """The floor y = 0 for z in [0, 2], the wall z = 0 for y in [0, 2]; both for x in [-1, 1]."""
    verts = torch.tensor([[-1, 0, 2], [1, 0, 2], [1, 0, 0], [-1, 0, 0], [-1, 2, 0], [1, 2, 0]], dtype=F64)
    return eg.Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3], [3, 2, 5], [3, 5, 4]]))


# -- any rays ---------------------------------------------------------------------------------------------------------


def test_rays_meet_a_sphere_where_its_faces_are():
    generator = torch.Generator().manual_seed(0)
    origins = torch.tensor([0.1, -0.2, 4.0], dtype=F64)
    directions = torch.randn((500, 3), generator=generator, dtype=F64) * 0.2 + torch.tensor([0.0, 0.0, -2.0], dtype=F64)
    mesh = ball()
    hits = eg.points.trace(mesh, origins, directions)
    # Möller and Trumbore's test of all rays against all faces, in double.
    q = mesh.verts[mesh.faces]
    e1, e2 = q[:, 1] - q[:, 0], q[:, 2] - q[:, 0]
    p = torch.linalg.cross(directions[:, None], e2[None].expand(500, -1, -1))
    s = (origins - q[:, 0])[None]
    r = torch.linalg.cross(s, e1[None])
    scale = 1 / (e1 * p).sum(-1)
    u, v, t = (s * p).sum(-1) * scale, (directions[:, None] * r).sum(-1) * scale, (e2 * r).sum(-1) * scale
    t = torch.where((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0), t, math.inf)
    nearest, face = t.min(1)
    met = nearest.isfinite()
    assert 100 < int(met.sum()) < 450
    assert torch.equal(hits.ray, met.nonzero()[:, 0])
    assert torch.equal(hits.face, face[met])
    assert torch.allclose(hits.depth, nearest[met], rtol=1e-12)
    assert torch.allclose(hits.position, origins + nearest[met, None] * directions[met], atol=1e-12)
    assert torch.allclose(hits.view, -torch.nn.functional.normalize(directions[met], dim=1), atol=1e-12)
    with pytest.raises(ValueError, match=r"hits\.pixel: expected hits of a camera"):
        _ = hits.pixel


def test_hits_of_rays_are_differentiable():
    mesh = ball(1)
    directions = torch.tensor([[0.1, 0.2, -1.0], [-0.15, 0.1, -1.0]], dtype=F64)
    colors = mesh.colors
    assert colors is not None

    def value(verts: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
        hits = eg.points.trace(mesh.replace(verts=verts), origins, directions)
        return torch.cat([hits.position, hits.depth[:, None], hits.interpolate(colors), hits.view, hits.normal], 1)

    origins = torch.tensor([[0.0, 0.05, 3.0], [0.2, 0.0, 3.0]], dtype=F64)
    inputs = [t.clone().requires_grad_() for t in (mesh.verts, origins, directions)]
    assert torch.autograd.gradcheck(value, inputs, eps=1e-6, atol=1e-6)


@pytest.mark.parametrize(
    ("origins", "directions", "message"),
    [
        (torch.zeros(4, 3), torch.zeros(4, 3), r"directions: expected lengths above zero, got zeros in row 0"),
        (torch.zeros(4, 3), torch.ones(3, 3), r"directions: expected as many rows as the other, 4, got 3"),
        (torch.zeros(4, 2), torch.ones(4, 3), r"origins: expected shape"),
        (torch.full((1, 3), torch.nan), torch.ones(1, 3), r"origins"),
    ],
)
def test_rays_that_cannot_be(origins: Tensor, directions: Tensor, message: str):
    with pytest.raises(ValueError, match=message):
        eg.points.trace(ball(), origins, directions)


def test_no_rays_and_no_hits():
    assert len(eg.points.trace(ball(), torch.zeros(0, 3), torch.zeros(0, 3))) == 0
    assert len(eg.points.trace(ball(), torch.tensor([0.0, 0, 5]), torch.tensor([0.0, 0, 1]))) == 0


# -- shadow rays ------------------------------------------------------------------------------------------------------


def test_a_convex_body_sees_what_its_faces_look_at():
    mesh = ball(3)
    hits = eg.points.primary_hits(mesh, front_camera(SIZE), seed=0).hits
    light = torch.tensor([3.0, 2.0, 1.5], dtype=F64)
    facing = (hits.normal * (light - hits.position)).sum(1)
    visible = hits.visible(light)
    assert visible.dtype == torch.bool
    assert torch.equal(visible, facing > 0)
    assert 0.2 < float(visible.double().mean()) < 0.8


@pytest.mark.parametrize("dtype", [torch.float32, F64])
@pytest.mark.parametrize("far", [0.0, 1000.0])
def test_what_joins_at_an_edge_hides_what_lies_beyond_and_no_more(dtype: torch.dtype, far: float):
    """A light behind the wall at height 1: the floor sees it where the line passes above the wall; nowhere else."""
    mesh = floor_and_wall()
    mesh = mesh.replace(verts=(mesh.verts + far).to(dtype))
    camera = eg.Camera.look_at(
        eye=(far, far + 4.0, far + 4.0),
        target=(far, far + 0.5, far + 0.7),
        up=(0.0, 1.0, 0.0),
        fov_y=40.0,
        size=(48, 48),
    )
    hits = eg.points.primary_hits(mesh, camera, spp=4, seed=0).hits
    z = hits.position[:, 2].double() - far
    floor = hits.face < 2
    behind = torch.tensor([far, far + 3.0, far - 1.0], dtype=dtype)
    # From (x, 0, z) to (·, 3, −1): at z = 0 the line is 3 z / (z + 1) high, above the wall where that is more than 2.
    expected = 3 * z / (z + 1) > 2
    apart = (3 * z / (z + 1) - 2).abs() > (1e-6 if not far else 5e-3)
    assert torch.equal(hits.visible(behind)[floor & apart], expected[floor & apart])
    # Before both: all is seen, next to where they join too.
    before = torch.tensor([far, far + 3.0, far + 3.0], dtype=dtype)
    assert bool(hits.visible(before).all())
    # A point on the wall itself is seen from the floor.
    on_wall = torch.tensor([far + 0.1, far + 1.0, far], dtype=dtype)
    assert bool(hits.visible(on_wall)[floor].all())


def test_rays_pass_through_what_is_masked():
    """A square screen of which the left half is cut out, before a floor."""
    uvs = torch.tensor([[0.0, 0], [1, 0], [1, 1], [0, 1]], dtype=F64)
    corner = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    alpha = torch.tensor([[0.0, 1.0]], dtype=F64)
    screen = eg.Mesh(corner, faces, uvs=uvs, uv_faces=faces, alpha=alpha, wrap="clamp")
    floor = eg.Mesh(3 * corner + torch.tensor([0.0, 0, 1], dtype=F64), faces)
    scene = eg.Scene([screen, floor])
    x = torch.linspace(-0.95, 0.95, 20, dtype=F64)
    origins = torch.stack([x, torch.full_like(x, 0.3), torch.full_like(x, -2.0)], 1)
    hits = eg.points.trace(scene, origins, torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    assert torch.equal(hits.mesh, (x < 0).long())
    below = hits.select(hits.mesh == 1)
    # From the floor straight back: through the hole; and a light far to the right is behind what is left of the screen.
    assert bool(below.visible(below.position - torch.tensor([0.0, 0, 5], dtype=F64)).all())
    near = below.select(below.position[:, 0] > -0.5)
    assert not bool(near.visible(torch.tensor([2.0, 0.3, -2.0], dtype=F64)).any())


def test_points_to_see_are_checked():
    hits = eg.points.primary_hits(ball(), front_camera(SIZE), seed=0).hits
    with pytest.raises(ValueError, match=r"points: expected shape"):
        hits.visible(torch.zeros(2, 3))


# -- places in the image ------------------------------------------------------------------------------------------------


def views() -> dict[str, eg.Camera]:
    straight = front_camera(SIZE)
    flat = straight.K.clone()
    flat[:2, :2] /= 3.0
    return {
        "perspective": straight,
        "orthographic": eg.Camera(straight.world_to_camera, flat, (SIZE, SIZE), "orthographic"),
        "distorted": straight.replace(distortion=torch.tensor([-0.4, 0.3, 0.02, -0.01], dtype=F64)),
        "panorama": eg.Camera.panorama(straight.world_to_camera, (SIZE, 2 * SIZE)),
    }


@pytest.mark.parametrize("view", views())
def test_places_show_what_pixels_do(view: str):
    """Compare what is seen at a place, the ray that goes there and its derivative by the place with the hits of an image."""
    primary = eg.points.primary_hits(ball(1), views()[view], spp=4, seed=0)
    hits, frame = primary.hits, primary.context
    x = hits.pixel
    places = frame.sampler.hits_at(x)
    assert float((places.face == hits.face).double().mean()) > 0.999
    same = places.face == hits.face
    assert torch.allclose(places.b[same], hits.barycentrics[same][:, 1:], atol=1e-6)
    rays = frame.sampler.rays_at(x)
    b = frame.view.barycentrics(frame.surfaces, hits.face, rays.along)
    assert torch.allclose(b, hits.barycentrics, atol=1e-5)
    step = 1e-4
    for axis in range(2):
        moved = torch.zeros_like(x).index_fill(1, torch.tensor(axis), step)
        ends = [frame.sampler.rays_at(x + sign * moved).along for sign in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        # Beyond the side of a cube the scale of a ray is another.
        near = (ends[0] - ends[1]).norm(dim=1) < 100 * step
        assert float(near.double().mean()) > 0.99
        assert torch.allclose(slope[near], rays.along_by_x[near, :, axis], atol=1e-5, rtol=1e-4)


# -- the parts of an image --------------------------------------------------------------------------------------------


def pipeline(verts: Tensor, camera: eg.Camera, seed: int, own_interior: bool) -> Tensor:
    mesh = ball()
    background = torch.tensor([0.2, 0.5, 0.3], dtype=F64)
    colors = mesh.colors
    assert colors is not None

    def shader(hits: eg.points.Hits) -> Tensor:
        return hits.interpolate(colors) * (1 + 0.5 * hits.position)

    primary = eg.points.primary_hits(mesh.replace(verts=verts), camera, spp=256 if own_interior else 16, seed=seed)
    if own_interior:
        image = primary.image(shader(primary.hits), background)
    else:
        with torch.no_grad():
            image = primary.image(shader(primary.hits), background)
        inside = eg.points.surface_samples(primary, 20000)
        shaded = inside.image(shader(inside.hits))
        image = image + (shaded - shaded.detach())
    edges = eg.points.edge_samples(primary, 20000, creases=False)
    with torch.no_grad():
        jump = edges.jump(shader(edges.hits))
    return eg.points.attach_boundary(image, edges, jump, background)


@pytest.mark.parametrize("own_interior", [True, False])
def test_a_pipeline_of_ones_own_is_the_shaders(own_interior: bool):
    camera, mesh = front_camera(SIZE), ball()
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    colors = mesh.colors
    assert colors is not None

    def whole(verts: Tensor, camera: eg.Camera, seed: int) -> Tensor:
        return eg.render(
            eg.Scene([mesh.replace(verts=verts)], torch.tensor([0.2, 0.5, 0.3], dtype=F64)),
            camera,
            seed=seed,
            shader=lambda hits: hits.interpolate(colors) * (1 + 0.5 * hits.position),
            sampling=eg.Sampling(creases=False, surface=20000, edges=20000),
            spp=16,
        )

    def gradients(image_of: object, seed: int) -> tuple[Tensor, ...]:
        verts, K = mesh.verts.clone().requires_grad_(), camera.K.clone().requires_grad_()
        image = image_of(verts, camera.replace(K=K), seed)  # type: ignore[operator]
        return (image.detach(), *torch.autograd.grad((image * adjoint).sum(), (verts, K)))

    def own(verts: Tensor, camera: eg.Camera, seed: int) -> Tensor:
        return pipeline(verts, camera, seed, own_interior)

    runs = [[gradients(f, seed + 100 * k) for seed in range(6)] for k, f in enumerate((whole, own))]
    first = gradients(whole, 0)[0], gradients(own, 0)[0]
    assert torch.allclose(*first, atol=0.2 if own_interior else 1e-6)  # the same samples, or more of them
    for name, k in (("verts", 1), ("K", 2)):
        a, b = (torch.stack([run[k] for run in r]) for r in runs)
        difference, size = (a.mean(0) - b.mean(0)).norm(), a.mean(0).norm()
        noise = ((a.var(0) + b.var(0)) / 6).sum().sqrt()
        assert noise < 0.035 * size, f"{name}: too noisy to decide"
        assert difference < 3 * noise, f"{name}: {float(difference / size):.2%}"


def test_jumps_at_edges_alone_move_a_silhouette():
    """A disc's area grows by its circumference: of a flat square, 4 sides."""
    size = torch.tensor(0.5, dtype=F64, requires_grad=True)
    corner = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    mesh = eg.Mesh(size * corner, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    K = torch.tensor([[10.0, 0, 12], [0, 10.0, 12], [0, 0, 1]], dtype=F64)
    camera = eg.Camera(torch.eye(4, dtype=F64), K, (SIZE, SIZE), "orthographic")
    primary = eg.points.primary_hits(mesh, camera, seed=0)
    edges = eg.points.edge_samples(primary, 400, creases=False)
    image = torch.zeros((SIZE, SIZE, 1), dtype=F64)
    attached = eg.points.attach_boundary(image, edges, edges.jump(torch.ones((len(edges.hits), 1), dtype=F64)))
    assert torch.equal(attached, image)
    (grad,) = torch.autograd.grad(attached.sum(), size)
    assert torch.allclose(grad, torch.tensor(8 * 0.5 * 100.0, dtype=F64), rtol=1e-6)
    with pytest.raises(RuntimeError, match="second derivatives"):
        verts = (size * corner).detach().requires_grad_()
        edges = eg.points.edge_samples(eg.points.primary_hits(mesh.replace(verts=verts), camera, seed=0), 400)
        jump = edges.jump(torch.ones((len(edges.hits), 1), dtype=F64))
        (first,) = torch.autograd.grad(
            eg.points.attach_boundary(image, edges, jump).square().sum(), verts, create_graph=True
        )
        torch.autograd.grad(first.sum(), verts)


def test_attached_edges_keep_the_type_and_have_no_second_derivatives():
    """The image's own graph does not have how coverage moves, so second derivatives by it are refused, too."""
    verts, color = ball().verts.clone().requires_grad_(), torch.rand(3, dtype=F64, requires_grad=True)
    primary = eg.points.primary_hits(ball().replace(verts=verts), front_camera(SIZE), seed=0)
    edges = eg.points.edge_samples(primary, 200)
    jump = edges.jump(torch.ones((len(edges.hits), 3), dtype=F64))
    image = primary.image(torch.ones((len(primary.hits), 3), dtype=F64), color)
    (by_verts,) = torch.autograd.grad(
        eg.points.attach_boundary(image, edges, jump, color).pow(2).sum(), verts, create_graph=True
    )
    with pytest.raises(RuntimeError, match="second derivatives"):
        torch.autograd.grad(by_verts.sum(), color)

    def single(verts: Tensor) -> Tensor:
        edges = eg.points.edge_samples(
            eg.points.primary_hits(ball().replace(verts=verts), front_camera(SIZE), seed=0), 200
        )
        return eg.points.attach_boundary(
            torch.zeros(SIZE, SIZE, 3), edges, edges.jump(torch.ones((len(edges.hits), 3), dtype=F64))
        )

    found = torch.func.jvp(single, (ball().verts,), (ball().verts,))
    assert [part.dtype for part in found] == [torch.float32] * 2 and float(found[1].abs().sum()) > 0


def test_what_parts_are_given_is_checked():
    primary = eg.points.primary_hits(ball(), front_camera(SIZE), seed=0)
    edges = eg.points.edge_samples(primary, 100)
    with pytest.raises(ValueError, match=r"radiance: expected shape"):
        primary.image(torch.zeros(3, 3))
    with pytest.raises(TypeError, match=r"primary: expected what primary_hits\(\) returned, got Mesh"):
        eg.points.surface_samples(ball())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"count: expected"):
        eg.points.edge_samples(primary, 0)
    with pytest.raises(TypeError, match=r"creases: expected True, False or a tensor"):
        eg.points.edge_samples(primary, creases="auto")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"image: expected shape"):
        eg.points.attach_boundary(torch.zeros(3, 3, 3), edges, torch.zeros(len(edges), 3))
    for call in (eg.points.surface_samples, eg.points.edge_samples):
        with pytest.raises(MemoryError, match=r"got about .* TB \(samples"), torch.no_grad():
            call(primary, 10**12)
    with pytest.raises(TypeError, match=r"samples: expected what edge_samples\(\) returned, got PrimaryHits"):
        eg.points.attach_boundary(torch.zeros(SIZE, SIZE, 3), primary, torch.zeros(len(edges), 3))  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"image: expected a tensor, array or nested sequence of numbers, got NoneType"):
        eg.points.attach_boundary(None, edges, torch.zeros(len(edges), 3))  # type: ignore[arg-type]
    w = torch.eye(4).expand(2, 4, 4)
    with pytest.raises(ValueError, match=r"camera: expected one camera, got a batch of 2"):
        eg.points.primary_hits(ball(), front_camera(SIZE).replace(world_to_camera=w), seed=0)
