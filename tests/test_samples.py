"""Parts to build renderers from: any rays, the hits of an image, samples, shadow rays, mipmaps, and how steps are found."""

from __future__ import annotations

import math

import pytest
import torch
from scenes import front_camera, icosphere, smooth_adjoint, smooth_colors
from torch import Tensor

import edgegrad as eg

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
    hits = eg.trace(mesh, origins, directions)
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
        hits = eg.trace(mesh.replace(verts=verts), origins, directions)
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
        eg.trace(ball(), origins, directions)


def test_no_rays_and_no_hits():
    assert len(eg.trace(ball(), torch.zeros(0, 3), torch.zeros(0, 3))) == 0
    assert len(eg.trace(ball(), torch.tensor([0.0, 0, 5]), torch.tensor([0.0, 0, 1]))) == 0


# -- shadow rays ------------------------------------------------------------------------------------------------------


def test_a_convex_body_sees_what_its_faces_look_at():
    mesh = ball(3)
    hits = eg.primary_hits(mesh, front_camera(SIZE)).hits
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
    hits = eg.primary_hits(mesh, camera, spp=4).hits
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


def test_rays_pass_through_what_is_cut_out():
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
    hits = eg.trace(scene, origins, torch.tensor([0.0, 0.0, 1.0], dtype=F64))
    assert torch.equal(hits.mesh, (x < 0).long())
    below = hits.select(hits.mesh == 1)
    # From the floor straight back: through the hole; and a light far to the right is behind what is left of the screen.
    assert bool(below.visible(below.position - torch.tensor([0.0, 0, 5], dtype=F64)).all())
    near = below.select(below.position[:, 0] > -0.5)
    assert not bool(near.visible(torch.tensor([2.0, 0.3, -2.0], dtype=F64)).any())


def test_points_to_see_are_checked():
    hits = eg.primary_hits(ball(), front_camera(SIZE)).hits
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
    """What is seen at a place, and the ray that goes there and its derivative by the place, beside the hits of an image."""
    primary = eg.primary_hits(ball(1), views()[view], spp=4)
    hits, frame = primary.hits, primary.frame
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

    def shader(hits: eg.Hits) -> Tensor:
        return hits.interpolate(colors) * (1 + 0.5 * hits.position)

    primary = eg.primary_hits(mesh.replace(verts=verts), camera, spp=256 if own_interior else 16, seed=seed)
    if own_interior:
        image = primary.image(shader(primary.hits), background)
    else:
        with torch.no_grad():
            image = primary.image(shader(primary.hits), background)
        inside = eg.surface_samples(primary, 20000)
        shaded = inside.image(shader(inside.hits))
        image = image + (shaded - shaded.detach())
    edges = eg.edge_samples(primary, 20000, creases=False)
    with torch.no_grad():
        jump = edges.jump(shader(edges.hits))
    return eg.attach_boundary(image, edges, jump, background)


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
            creases=False,
            surface_samples=20000,
            edge_samples=20000,
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
        assert noise < 0.035 * size, f"{name}: too noisy to tell"
        assert difference < 3 * noise, f"{name}: {float(difference / size):.2%}"


def test_jumps_at_edges_alone_move_a_silhouette():
    """A disc's area grows by its circumference: of a flat square, 4 sides."""
    size = torch.tensor(0.5, dtype=F64, requires_grad=True)
    corner = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    mesh = eg.Mesh(size * corner, torch.tensor([[0, 1, 2], [0, 2, 3]]))
    K = torch.tensor([[10.0, 0, 12], [0, 10.0, 12], [0, 0, 1]], dtype=F64)
    camera = eg.Camera(torch.eye(4, dtype=F64), K, (SIZE, SIZE), "orthographic")
    primary = eg.primary_hits(mesh, camera)
    edges = eg.edge_samples(primary, 400, creases=False)
    image = torch.zeros((SIZE, SIZE, 1), dtype=F64)
    attached = eg.attach_boundary(image, edges, edges.jump(torch.ones((len(edges.hits), 1), dtype=F64)))
    assert torch.equal(attached, image)
    (grad,) = torch.autograd.grad(attached.sum(), size)
    assert torch.allclose(grad, torch.tensor(8 * 0.5 * 100.0, dtype=F64), rtol=1e-6)
    with pytest.raises(RuntimeError, match="second derivatives"):
        verts = (size * corner).detach().requires_grad_()
        edges = eg.edge_samples(eg.primary_hits(mesh.replace(verts=verts), camera), 400)
        jump = edges.jump(torch.ones((len(edges.hits), 1), dtype=F64))
        (first,) = torch.autograd.grad(eg.attach_boundary(image, edges, jump).square().sum(), verts, create_graph=True)
        torch.autograd.grad(first.sum(), verts)


def test_what_parts_are_given_is_checked():
    primary = eg.primary_hits(ball(), front_camera(SIZE))
    edges = eg.edge_samples(primary, 100)
    with pytest.raises(ValueError, match=r"radiance: expected shape"):
        primary.image(torch.zeros(3, 3))
    with pytest.raises(TypeError, match=r"primary: expected what primary_hits\(\) returned, got Mesh"):
        eg.surface_samples(ball())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"count: expected"):
        eg.edge_samples(primary, 0)
    with pytest.raises(TypeError, match=r"creases: expected True, False or a tensor"):
        eg.edge_samples(primary, creases="auto")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"image: expected shape"):
        eg.attach_boundary(torch.zeros(3, 3, 3), edges, torch.zeros(len(edges), 3))
    w = torch.eye(4).expand(2, 4, 4)
    with pytest.raises(ValueError, match=r"camera: expected one camera, got a batch of 2"):
        eg.primary_hits(ball(), front_camera(SIZE).replace(world_to_camera=w))


# -- mipmaps ----------------------------------------------------------------------------------------------------------


def facing(texture: Tensor, pixels_a_texel: float) -> tuple[eg.Mesh, eg.Camera]:
    """A square that shows a texture in so many pixels a texel."""
    h, w = texture.shape[:2]
    verts = torch.tensor([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], dtype=F64)
    uvs = torch.tensor([[0, 1], [1, 1], [1, 0], [0, 0]], dtype=F64)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    f = pixels_a_texel
    size = round(h * f), round(w * f)
    K = torch.tensor([[f, 0, 0], [0, f, 0], [0, 0, 1]], dtype=F64)
    camera = eg.Camera(torch.eye(4, dtype=F64), K, size)
    return eg.Mesh(verts, faces, texture=texture, uvs=uvs, uv_faces=faces), camera


@pytest.mark.parametrize("levels", [0, 1, 2, 3])
def test_mipmaps_show_means_of_texels(levels: int):
    texture = torch.rand((32, 64, 3), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 0.5**levels)
    hits = eg.primary_hits(mesh, camera, spp=1).hits
    mean = torch.nn.functional.avg_pool2d(texture.movedim(-1, 0), 2**levels).movedim(0, -1)
    expected = hits.sample(mean, uv=hits.uv)
    assert torch.allclose(hits.sample(texture, mipmap=True), expected, atol=1e-9)


def test_between_two_levels_mipmaps_are_linear():
    texture = torch.rand((32, 32, 2), generator=torch.Generator().manual_seed(0), dtype=F64)
    mesh, camera = facing(texture, 2**-1.25)
    hits = eg.primary_hits(mesh, camera, spp=1).hits
    levels = [torch.nn.functional.avg_pool2d(texture.movedim(-1, 0), 2**k).movedim(0, -1) for k in (1, 2)]
    low, high = (hits.sample(level, uv=hits.uv) for level in levels)
    assert torch.allclose(hits.sample(texture, mipmap=True), 0.75 * low + 0.25 * high, atol=1e-6)


def test_texels_get_gradients_through_mipmaps():
    texture = torch.rand((8, 8, 1), dtype=F64)
    mesh, camera = facing(texture, 0.5)

    def value(texture: Tensor) -> Tensor:
        return eg.primary_hits(mesh, camera, spp=1).hits.sample(texture, mipmap=True)

    assert torch.autograd.gradcheck(value, texture.requires_grad_())


def test_mipmaps_need_neighbours():
    texture = torch.rand((8, 8, 1), dtype=F64)
    mesh, camera = facing(texture, 0.5)
    hits = eg.primary_hits(mesh, camera, spp=1).hits
    with pytest.raises(ValueError, match="mipmap: expected the surface's own texture coordinates"):
        hits.sample(texture, uv=hits.uv, mipmap=True)
    rays = eg.trace(mesh, torch.zeros(3), torch.tensor([1.0, 1.0, 1.0]))
    with pytest.raises(ValueError, match="mipmap: expected hits of a camera"):
        rays.sample(texture, mipmap=True)
    with pytest.raises(ValueError, match=r"mipmap: expected filter="):
        hits.sample(texture, mipmap=True, filter="nearest")


@pytest.mark.parametrize(
    ("wrap", "expected"),
    [("repeat", [2, 0, 1, 2, 0]), ("clamp", [0, 0, 1, 2, 2]), ("mirror", [0, 0, 1, 2, 2])],
)
def test_beyond_the_rim(wrap: str, expected: list[int]):
    texture = torch.arange(3.0, dtype=F64).reshape(1, 3, 1)
    mesh, camera = facing(texture, 1.0)
    hits = eg.primary_hits(mesh, camera, spp=1).hits
    for k, value in zip((-1, 0, 1, 2, 3), expected, strict=True):
        uv = torch.tensor([(k + 0.5) / 3, 0.5], dtype=F64).expand(len(hits), 2)
        for filter in ("nearest", "linear"):
            assert torch.allclose(
                hits.sample(texture, uv=uv, wrap=wrap, filter=filter), torch.tensor(float(value)).double()
            )
    far = torch.tensor([4.5 / 3 + 2, 0.5], dtype=F64).expand(
        len(hits), 2
    )  # texel 10: mirrored 1, repeated 1, clamped 2
    assert torch.allclose(
        hits.sample(texture, uv=far, wrap=wrap), torch.tensor(2.0 if wrap == "clamp" else 1.0).double()
    )


# -- steps ------------------------------------------------------------------------------------------------------------


def square(turn: float = 0.0) -> eg.Mesh:
    corner = torch.tensor([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=F64)
    c, s = math.cos(turn), math.sin(turn)
    R = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=F64)
    return eg.Mesh(corner @ R.T, torch.tensor([[0, 1, 2], [0, 2, 3]]))


def flat_camera(size: int) -> eg.Camera:
    K = torch.tensor([[0.4 * size, 0, size / 2], [0, 0.4 * size, size / 2], [0, 0, 1]], dtype=F64)
    return eg.Camera(torch.eye(4, dtype=F64), K, (size, size), "orthographic")


def test_a_straight_step_is_exact():
    """The area beside a line x = a across a square of side 2 is 2 (1 − a) scale² pixels; its derivative is −2 scale²."""
    a = torch.tensor(0.137, dtype=F64, requires_grad=True)
    image = eg.render(
        square(), flat_camera(32), shader=lambda hits: hits.where(hits.position[:, 0] - a, 3.0, 1.0), step_spacing=0.5
    )
    (grad,) = torch.autograd.grad(image.sum(), a)
    scale = 0.4 * 32
    # Horizontal lines cross it once each; how many there are is chance, by one.
    assert float(grad) == pytest.approx(-2 * 2 * scale**2, rel=1.01 * 0.5 / (2 * scale))


@pytest.mark.parametrize("spacing", [2.0, 1.0, 0.5])
def test_a_discs_area_grows_by_its_circumference(spacing: float):
    def gradient(seed: int) -> Tensor:
        r = torch.tensor(0.6, dtype=F64, requires_grad=True)
        image = eg.render(
            square(0.3),
            flat_camera(32),
            seed=seed,
            shader=lambda hits: hits.where(r - (hits.position[:, :2] - 0.05).norm(dim=1), 1.0, 0.0),
            step_spacing=spacing,
        )
        return torch.autograd.grad(image.sum(), r)[0]

    found = torch.stack([gradient(seed) for seed in range(24)])
    exact = 2 * math.pi * 0.6 * (0.4 * 32) ** 2
    error = float(found.std()) / 24**0.5
    assert error < 0.01 * exact
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 1e-3 * exact)


def test_texels_between_neighbouring_points_all_count():
    """Stripes finer than the lines are apart: moving them changes each pixel of a coarse image, all of them together nothing;
    their duty moves the mean."""

    def gradient(seed: int) -> Tensor:
        duty = torch.tensor(0.3, dtype=F64, requires_grad=True)

        def stripes(hits: eg.Hits) -> Tensor:
            x = 20.3 * hits.position[:, 0]
            return (hits.floor(x) - hits.floor(x - duty))[:, None]  # 1 in the first `duty` of each stripe

        image = eg.render(square(0.2), flat_camera(24), seed=seed, shader=stripes)
        return torch.autograd.grad(image.sum(), duty)[0]

    found = torch.stack([gradient(seed) for seed in range(16)])
    exact = 4 * (0.4 * 24) ** 2
    error = float(found.std()) / 4
    assert error < 0.02 * exact
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 5e-3 * exact)


def test_a_step_that_is_said_twice_counts_once():
    def gradient(twice: bool) -> Tensor:
        a = torch.tensor(0.137, dtype=F64, requires_grad=True)

        def shader(hits: eg.Hits) -> Tensor:
            s = hits.position[:, 0] + 0.3 * hits.position[:, 1] - a
            # The product of two jumps at one place, 1 → 4, or the whole at once.
            return hits.where(s, 2.0, 1.0) * hits.where(-2 * s, 1.0, 2.0) if twice else hits.where(s, 4.0, 1.0)

        return torch.autograd.grad(eg.render(square(), flat_camera(32), shader=shader).sum(), a)[0]

    assert torch.allclose(gradient(True), gradient(False))


def test_a_jump_of_the_function_is_no_step():
    """Where s jumps over zero, at a silhouette before another surface or by itself, nothing is said to move."""
    a = torch.tensor(0.0, dtype=F64, requires_grad=True)
    back, front = square(), square(0.4)
    scene = eg.Scene([back, front.replace(verts=0.5 * front.verts - torch.tensor([0.0, 0.0, 1.0], dtype=F64))])

    def shader(hits: eg.Hits) -> Tensor:
        by_mesh = torch.where(hits.mesh == 1, 1.0, -1.0)
        by_place = torch.where(hits.position[:, 1] > 0.7, 2.0, -1.0)
        return hits.where(by_mesh + a, 1.0, 0.0) + hits.where(by_place + a, 1.0, 0.0)

    (grad,) = torch.autograd.grad(eg.render(scene, flat_camera(32), shader=shader).sum(), a)
    assert float(grad) == 0


def test_steps_beside_silhouettes_are_found():
    """A step that runs into the shadow line of another surface: the part beside it counts as well."""

    def gradient(seed: int) -> Tensor:
        a = torch.tensor(0.1, dtype=F64, requires_grad=True)
        back, front = square(), square()
        # Slats before a striped back: between two lies 1.3 px of it.
        slats = [
            front.replace(
                verts=front.verts * torch.tensor([0.05, 0.9, 1], dtype=F64) + torch.tensor([0.2 * k, 0, -1]).double()
            )
            for k in range(-3, 4)
        ]
        image = eg.render(
            eg.Scene([back, *slats]),
            flat_camera(32),
            seed=seed,
            shader=lambda hits: hits.where(hits.position[:, 1] - a, 1.0, 0.0) * (hits.mesh == 0)[:, None],
        )
        return torch.autograd.grad(image.sum(), a)[0]

    found = torch.stack([gradient(seed) for seed in range(24)])
    exact = -(2 - 7 * 0.1) * (0.4 * 32) ** 2
    error = float(found.std()) / 24**0.5
    assert error < 0.012 * abs(exact)
    assert float(found.mean()) == pytest.approx(exact, abs=4 * error + 0.005 * abs(exact))


def test_steps_in_forward_mode_and_under_transforms():
    adjoint = smooth_adjoint(SIZE, SIZE, 3)
    mesh, camera = ball(), front_camera(SIZE)

    def image(a: Tensor, verts: Tensor) -> Tensor:
        def shader(hits: eg.Hits) -> Tensor:
            return hits.where(hits.position[:, 0] * (1 + a) - 0.1, 0.4 + 0.5 * hits.shading_normal, 0.2 + a)

        return eg.render(mesh.replace(verts=verts), camera, seed=3, shader=shader)

    a, verts = torch.tensor(0.2, dtype=F64), mesh.verts
    a_dot = torch.tensor(0.7, dtype=F64)
    verts_dot = 0.1 * torch.sin(3 * verts)
    leaves = a.clone().requires_grad_(), verts.clone().requires_grad_()
    bars = torch.autograd.grad((image(*leaves) * adjoint).sum(), leaves)
    expected = (bars[0] * a_dot).sum() + (bars[1] * verts_dot).sum()
    dot = torch.func.jvp(image, (a, verts), (a_dot, verts_dot))[1]
    assert torch.allclose((dot * adjoint).sum(), expected, rtol=1e-6)
    func = torch.func.grad(lambda a, v: (image(a, v) * adjoint).sum(), argnums=(0, 1))(a, verts)
    for x, y in zip(func, bars, strict=True):
        assert torch.allclose(x, y, rtol=1e-6, atol=1e-9)


def test_steps_that_are_not_always_asked_for():
    def shader(hits: eg.Hits) -> Tensor:
        return hits.where(hits.depth - 3, 1.0, 0.0) if len(hits) > 50 else torch.ones(len(hits), 1)

    mesh = ball()
    with pytest.raises(ValueError, match=r"shader: expected as many calls of hits\.where\(\)"):
        eg.render(
            mesh.replace(verts=mesh.verts.clone().requires_grad_()), front_camera(SIZE), shader=shader, edge_samples=3
        )


def test_what_steps_are_given_is_checked():
    def refused(shader: object, message: str, kind: type[Exception] = ValueError) -> None:
        with pytest.raises(kind, match=message):
            eg.render(ball(), front_camera(SIZE), shader=shader)  # type: ignore[arg-type]

    refused(lambda hits: hits.where(hits.position, 1.0, 0.0), r"s: expected shape")
    refused(lambda hits: hits.where(hits.depth, hits.position[:5], 0.0), r"a: expected rows \(N, C\)")
    refused(lambda hits: hits.where(hits.face, 1.0, 0.0), r"s: ", TypeError)
    refused(
        lambda hits: hits.where(hits.depth, torch.ones(3), torch.ones(2)), r"b: expected as many channels as a has, 3"
    )
    refused(lambda hits: hits.where(hits.depth, hits.depth, 0.0), r"a: expected rows .* a number a point is value")
    refused(lambda hits: hits.where(hits.depth / 0, 1.0, 0.0), r"s: expected finite numbers, got inf")
    refused(lambda hits: hits.sample(torch.ones(2, 2, 1), uv=hits.position[:, :2], wrap=5), r"wrap: expected")  # type: ignore[arg-type]
    refused(lambda hits: hits.select(torch.ones(3, dtype=torch.bool)).normal, r"index: expected shape")
    refused(lambda hits: hits.select(hits.face + len(hits)).normal, r"index: expected numbers below")
    refused(lambda hits: hits.select(hits.depth).normal, r"index: expected integers", TypeError)
    refused(lambda hits: hits.floor(hits.face), r"t: ", TypeError)
    with pytest.raises(ValueError, match=r"step_spacing: expected a number from 0\.015625 to 64, got 0"):
        eg.render(ball(), front_camera(SIZE), step_spacing=0)
    with pytest.raises(TypeError, match=r"step_spacing: expected a number, got str"):
        eg.render(ball(), front_camera(SIZE), step_spacing="1")  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", ["where", "floor", "nearest"])
def test_borders_along_edges(kind: str):
    """A border that runs exactly along edges of the mesh, of a grid of 4 × 4 squares: x = θ, with an edge at 0."""
    grid = torch.stack(torch.meshgrid(*[torch.linspace(-1, 1, 5, dtype=F64)] * 2, indexing="ij"), -1).reshape(-1, 2)
    corner = torch.tensor(
        [[5 * i + j for i, j in ((a, b), (a + 1, b), (a + 1, b + 1), (a, b + 1))] for a in range(4) for b in range(4)]
    )
    faces = torch.cat([corner[:, :3], corner[:, [0, 2, 3]]])
    mesh = eg.Mesh(torch.nn.functional.pad(grid, (0, 1)), faces)
    texture = torch.tensor([[[0.0], [1.0]]], dtype=F64)

    def gradient(seed: int) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)

        def shader(hits: eg.Hits) -> Tensor:
            s = hits.position[:, 0] - theta
            if kind == "where":
                return hits.where(s, 1.0, 0.0)
            if kind == "floor":
                return 1 + hits.floor(0.5 * s)[:, None]
            return hits.sample(texture, uv=torch.stack([0.5 + s / 4, 0.5 + 0 * s], 1), filter="nearest")

        return torch.autograd.grad(eg.render(mesh, flat_camera(32), seed=seed, shader=shader).sum(), theta)[0]

    found = torch.stack([gradient(seed) for seed in range(8)]).mean()
    assert float(found) == pytest.approx(-2 * (0.4 * 32) ** 2, rel=0.03)


def test_steps_of_some_points_are_steps_of_all():
    """Two materials, each asked for its own points."""

    def gradient(selected: bool) -> Tensor:
        theta = torch.zeros((), dtype=F64, requires_grad=True)
        back, front = square(), square(0.4)
        front = front.replace(verts=0.4 * front.verts - torch.tensor([0.0, 0.0, 1.0], dtype=F64))

        def of_back(hits: eg.Hits) -> Tensor:
            return hits.where(hits.position[:, 0] - 0.7 - theta, 1.0, 0.3)

        def of_front(hits: eg.Hits) -> Tensor:
            return 0.1 * hits.floor(7 * hits.position[:, 1] + theta)[:, None]

        def shader(hits: eg.Hits) -> Tensor:
            front = hits.mesh == 1
            if not selected:
                return torch.where(front[:, None], of_front(hits), of_back(hits))
            color = torch.zeros((len(hits), 1), dtype=F64)
            color = color.index_put(((~front).nonzero()[:, 0],), of_back(hits.select(~front)))
            return color.index_put((front.nonzero()[:, 0],), of_front(hits.select(front)))

        image = eg.render(eg.Scene([back, front]), flat_camera(32), shader=shader, check_shader=True)
        return torch.autograd.grad((image * smooth_adjoint(32, 32, 1)).sum(), theta)[0]

    one, all = gradient(True), gradient(False)
    assert abs(float(all)) > 1
    assert float(one) == pytest.approx(float(all), rel=1e-6)


def test_many_directions_of_steps_in_one_pass():
    mesh, camera = ball(), front_camera(SIZE)

    def shader(hits: eg.Hits) -> Tensor:
        return hits.where(hits.position[:, 0] - 0.1, 1.0, 0.2) + hits.floor(3 * hits.position[:, 1:2])

    directions = torch.stack([0.1 * torch.sin(k * mesh.verts) for k in (1, 2, 3)])
    _, dots = eg.jvp(mesh, camera, {mesh.verts: directions}, seed=3, shader=shader)
    for direction, dot in zip(directions, dots, strict=True):
        _, one = torch.func.jvp(
            lambda v: eg.render(mesh.replace(verts=v), camera, seed=3, shader=shader), (mesh.verts,), (direction,)
        )[:2]
        assert torch.allclose(dot, one, atol=1e-9)
