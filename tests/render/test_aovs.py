"""render_aovs(): values and derivatives of all channels, against exact integrals over pixels, a ray tracer in PyTorch, and
finite differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest
import torch
from finite_differences import check, estimate, right_ratio, rotation
from oracles import reference
from oracles.exact import exact_image
from scenes import cube, front_camera, icosphere, one_triangle, smooth_adjoint
from torch import Tensor

import edgegrad as eg
from edgegrad.aovs import AOVS, IDS

pytestmark = pytest.mark.watched

F64 = torch.float64
SIZE = 24
AFFINE = ["alpha", "position", "depth", "normal", "barycentrics", "uv"]  # what exact_image can integrate
RANDOM = torch.Generator().manual_seed(5)


def textured(mesh: eg.Mesh, seams: bool = True) -> eg.Mesh:
    """Return the mesh with uvs of its own for every face, which jump at all edges."""
    F = len(mesh.faces)
    uvs = torch.rand((3 * F, 2), dtype=F64, generator=torch.Generator().manual_seed(1)) if seams else mesh.verts[:, :2]
    uv_faces = torch.arange(3 * F).reshape(F, 3) if seams else mesh.faces
    y, x = torch.meshgrid(torch.linspace(0, 3, 16, dtype=F64), torch.linspace(0, 3, 16, dtype=F64), indexing="ij")
    texture = torch.stack([torch.sin(x + y), torch.cos(x - y), torch.sin(2 * y)], -1) * 0.5 + 0.5
    return mesh.replace(texture=texture, uvs=uvs, uv_faces=uv_faces)


def two_meshes(seams: bool = True) -> eg.Scene:
    """A ball of 80 faces, and a triangle that hides a part of it."""
    ball = textured(icosphere(1), seams)
    triangle = textured(one_triangle().meshes[0].transformed(t=torch.tensor([0.5, 0.3, 1.3], dtype=F64)), seams)
    return eg.Scene([ball, triangle], torch.tensor([0.2, 0.3, 0.4], dtype=F64))


def distorted_camera(size: int = SIZE) -> eg.Camera:
    view = front_camera(size)
    M = view.world_to_camera
    return eg.Camera.from_opencv(
        M[:3, :3], M[:3, 3], view.K, view.size, torch.tensor([-0.2, 0.05, 0.01, -0.01], dtype=F64)
    )


CAMERAS: dict[str, Callable[[], eg.Camera]] = {
    "perspective": lambda: front_camera(SIZE),
    "orthographic": lambda: front_camera(SIZE, "orthographic"),
    "distorted": distorted_camera,
}


# -- what is independent of render_aovs ---------------------------------------------------------------------------------


def corner_values(mesh: eg.Mesh, camera: eg.Camera, name: str) -> Tensor:
    """A channel at the corners of the faces (F, 3, c), made anew from its definition."""
    p = mesh.verts[mesh.faces]
    if name == "alpha":
        return torch.ones_like(p[..., :1])
    if name == "position":
        return p
    if name == "depth":
        M = camera.world_to_camera
        return p @ M[2, :3, None] + M[2, 3]
    if name == "normal":
        across = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        return (across / across.norm(dim=-1, keepdim=True))[:, None].expand(-1, 3, -1)
    if name == "barycentrics":
        return torch.eye(3, dtype=p.dtype).expand(len(p), 3, 3)
    assert name == "uv" and mesh.uvs is not None and mesh.uv_faces is not None
    return mesh.uvs[mesh.uv_faces]


def as_colors(scene: eg.Scene, camera: eg.Camera, name: str) -> eg.Scene:
    return eg.Scene([eg.Mesh(m.verts, m.faces, corner_colors=corner_values(m, camera, name)) for m in scene.meshes])


def moved(scene: eg.Scene, camera: eg.Camera, theta: Tensor) -> tuple[eg.Scene, eg.Camera]:
    """theta (3,): vertices bend, the camera moves, its focal length grows."""
    meshes = [
        m.replace(verts=m.verts * (1 + theta[0] * (1.0 + 0.5 * torch.sin(3 * m.verts.roll(1, -1)))))
        for m in scene.meshes
    ]
    shift = theta[1] * torch.tensor([[0.7], [-0.5], [0.4]], dtype=F64)
    M = torch.cat([rotation((0.48, 0.6, 0.64), theta[1]), shift], 1)
    M = torch.cat([M, torch.eye(4, dtype=F64)[3:]])
    lens = torch.zeros_like(camera.K)
    lens[:2, :2] = camera.K[:2, :2]
    camera = camera.replace(world_to_camera=M @ camera.world_to_camera, K=camera.K + theta[2] * lens)
    return scene.replace(meshes=meshes), camera


def products(channels: dict[str, Tensor]) -> dict[str, Tensor]:
    """Each channel times a smooth adjoint."""
    return {name: (x * smooth_adjoint(*x.shape[-3:])).sum() for name, x in channels.items()}


# -- values -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_values_are_exact_integrals(projection: str) -> None:
    scene, camera = two_meshes(), CAMERAS[projection]()
    found = eg.render_aovs(scene, camera, AFFINE, spp=4096, seed=0)
    for name in AFFINE:
        exact = exact_image(as_colors(scene, camera, name), camera)
        assert found[name].shape == exact.shape
        # A lattice of 4,096 points is off by some thousandths of the jump where edges cut a pixel.
        error = (found[name] - exact).abs() / exact.abs().max()
        assert error.max() < 0.01 and error.mean() < 3e-4, name


def test_shading_normals() -> None:
    """Means of the faces around a vertex by area, interpolated, of length 1: at points that a tracer in PyTorch finds."""
    mesh, camera, grid = cube(), front_camera(12), 16
    p = mesh.verts[mesh.faces]
    across = torch.linalg.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    around = torch.stack([across[(mesh.faces == v).any(1)].sum(0) for v in range(len(mesh.verts))])
    around = around / around.norm(dim=-1, keepdim=True)
    steps = (torch.arange(12 * grid, dtype=F64) + 0.5) / grid
    points = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    one = eg.Scene([eg.Mesh(mesh.verts, mesh.faces, colors=around)])
    normals = reference.radiance(one, camera, points)
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp(min=1e-300)
    expected = normals.reshape(12, grid, 12, grid, 3).mean((1, 3))
    found = eg.render_aovs(mesh, camera, ["shading_normal", "alpha"], spp=4096, seed=0)
    assert (found["shading_normal"] - expected).abs().max() < 0.02  # the grid's error where an edge cuts a pixel
    # Within a face, far more exactly: one pixel wholly inside a face that is seen nearly face on.
    inside = (found["alpha"][..., 0] == 1) & (expected.norm(dim=-1) > 0.99)
    assert inside.any() and (found["shading_normal"] - expected)[inside].abs().max() < 2e-3


@pytest.mark.parametrize("lens", CAMERAS)
def test_ids_are_of_the_ray_through_the_centre(lens: str) -> None:
    scene, camera = two_meshes(), CAMERAS[lens]()
    found = eg.render_aovs(scene, camera, ["face_id", "mesh_id"], seed=0)
    assert list(found) == ["face_id", "mesh_id"]
    assert all(x.shape == (SIZE, SIZE, 1) and x.dtype == torch.int64 and not x.requires_grad for x in found.values())
    mesh, face = found["mesh_id"][..., 0], found["face_id"][..., 0]
    if lens == "distorted":  # projecting the middle of what is said to be seen stays within reach of the pixel
        offset = torch.tensor([0, len(scene.meshes[0].faces)])
        assert set(mesh.unique().tolist()) == {-1, 0, 1} and (face[mesh < 0] == -1).all()
        alpha = eg.render_aovs(scene, camera, ["alpha"], spp=256, seed=0)["alpha"][..., 0]
        assert ((mesh >= 0) == (alpha > 0.5))[(alpha == 0) | (alpha == 1)].all()
        middles = torch.cat([m.verts[m.faces].mean(1) for m in scene.meshes])
        y, x = torch.nonzero(mesh >= 0).unbind(-1)
        near = camera.project(middles[face[y, x] + offset[mesh[y, x]]]) - torch.stack([x + 0.5, y + 0.5], -1)
        assert near[mesh[y, x] == 0].norm(dim=-1).max() < 4
        return
    y, x = torch.meshgrid(torch.arange(SIZE, dtype=F64) + 0.5, torch.arange(SIZE, dtype=F64) + 0.5, indexing="ij")
    truth = reference.closest_faces(scene, camera, torch.stack([x, y], -1).reshape(-1, 2)).reshape(SIZE, SIZE)
    first = len(scene.meshes[0].faces)
    assert torch.equal(mesh, torch.where(truth < 0, -1, (truth >= first).long()))
    assert torch.equal(face, torch.where(truth >= first, truth - first, truth))


@pytest.mark.parametrize(
    "kind", ["colors", "face_colors", "one", "four", "five", "texture", "plain", "image background"]
)
def test_the_image_is_the_same_to_the_bit(kind: str) -> None:
    ball = icosphere(2)
    values = torch.rand((len(ball.faces), 5), dtype=F64, generator=RANDOM)
    width = {"one": 1, "four": 4, "five": 5}.get(kind, 3)
    mesh = {
        "colors": ball,
        "texture": textured(ball),
        "plain": eg.Mesh(ball.verts, ball.faces),
        "image background": ball,
    }.get(kind) or ball.replace(face_colors=values[:, :width])
    background = torch.rand((SIZE, SIZE, 3), dtype=F64, generator=RANDOM) if kind == "image background" else None
    scene, camera = eg.Scene([mesh], background), front_camera(SIZE)
    names = ["alpha", "image", *(name for name in AOVS if name not in ("alpha", "image", "uv"))]
    for filter in ("box", "gaussian"):
        image = eg.render(scene, camera, 16, 3, filter=filter)
        for chosen in (names, ["image", "alpha"], ["image"]):
            assert torch.equal(eg.render_aovs(scene, camera, chosen, 16, 3, filter=filter)["image"], image)


def test_a_pixel_holds_premultiplied_sums() -> None:
    """Divided by alpha, the depth of a half covered pixel lies on the surface."""
    verts = torch.tensor([[-2.0, -2.0, 5.0], [0.0, 4.0, 5.0], [0.0, -3.0, 5.0]])
    K = torch.tensor([[8.0, 0.0, 4.25], [0.0, 8.0, 4.0], [0.0, 0.0, 1.0]])
    camera = eg.Camera(torch.eye(4), K, (8, 8))
    found = eg.render_aovs(
        eg.Mesh(verts, torch.tensor([[0, 1, 2]])), camera, ["depth", "alpha", "normal"], spp=256, seed=0
    )
    alpha, depth = found["alpha"][4, 4, 0], found["depth"][4, 4, 0]
    assert 0.2 < alpha < 0.3 and abs(depth / alpha - 5) < 1e-5
    assert torch.equal(found["normal"][4, 3], torch.tensor([0.0, 0.0, -1.0]))
    assert (found["depth"][found["alpha"] == 0] == 0).all()


# -- derivatives --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_gradients_of_exact_integrals(projection: str) -> None:
    """The derivative of alpha is that of exact coverage."""
    scene, camera = two_meshes(), CAMERAS[projection]()
    found: dict[str, list[Tensor]] = {name: [] for name in AFFINE}
    for seed in range(6):
        theta = torch.zeros(3, dtype=F64, requires_grad=True)
        channels = eg.render_aovs(
            *moved(scene, camera, theta), AFFINE, 16, seed, sampling=eg.Sampling(surface=10_000, edges=20_000)
        )
        for name, product in products(channels).items():
            found[name].append(torch.autograd.grad(product, theta, retain_graph=True)[0])
    for name in AFFINE:
        theta = torch.zeros(3, dtype=F64, requires_grad=True)
        there, view = moved(scene, camera, theta)
        image = exact_image(as_colors(there, view, name), view)
        (truth,) = torch.autograd.grad((image * smooth_adjoint(*image.shape)).sum(), theta)
        scale = truth.abs().max().item()
        for k, what in enumerate(("verts", "pose", "focal length")):
            # Sums of both signs that nearly cancel are left to the other parameters.
            if abs(truth[k]) > 0.5 * scale:
                check(f"{name} by {what}", truth[k].item(), estimate([g[k].item() for g in found[name]]))


def finite_difference_ratio(lens: str, k: int, names: list[str], step: float = 5e-3, spp: int = 8192) -> None:
    scene, camera = two_meshes(seams=False), CAMERAS[lens]()
    direction = torch.eye(3, dtype=F64)[k]
    differences: dict[str, list[float]] = {name: [] for name in names}
    gradients: dict[str, list[float]] = {name: [] for name in names}
    tested: list[str] = []
    for seed in range(4):
        with torch.no_grad():
            high, low = (
                products(eg.render_aovs(*moved(scene, camera, h * direction), names, spp, seed)) for h in (step, -step)
            )
        for name in names:
            differences[name].append(((high[name] - low[name]) / (2 * step)).item())
    for seed in range(8):
        theta = torch.zeros(3, dtype=F64, requires_grad=True)
        options: dict[str, Any] = {"sampling": eg.Sampling(surface=20_000, edges=40_000)}
        for name, product in products(eg.render_aovs(*moved(scene, camera, theta), names, 16, seed, **options)).items():
            gradients[name].append(torch.autograd.grad(product, theta, retain_graph=True)[0][k].item())
    for name in names:
        fd = estimate(differences[name])
        if abs(fd.mean) > 100 * fd.error:  # no sum of both signs that nearly cancel
            right_ratio(fd, estimate(gradients[name]))
            tested.append(name)
    assert len(tested) >= len(names) - 2, f"too noisy to decide: {differences}"


@pytest.mark.unwatched
def test_finite_differences_of_a_direction() -> None:
    finite_difference_ratio("perspective", 0, ["shading_normal"], spp=1024)


@pytest.mark.slow
@pytest.mark.parametrize("k", range(3), ids=["verts", "pose", "focal length"])
@pytest.mark.parametrize("lens", CAMERAS)
def test_finite_differences(lens: str, k: int) -> None:
    finite_difference_ratio(lens, k, [*AFFINE, "shading_normal"])


@pytest.mark.parametrize("name", ["normal", "barycentrics", "uv", "shading_normal"])
def test_channels_that_jump_between_faces_have_creases(name: str) -> None:
    """A turning cube whose faces have normals, barycentrics and uvs of their own: without what moves at edges the gradient
    is another one. Shading normals of shared vertices are continuous, and have none."""
    mesh, camera = textured(cube()), front_camera(4 * SIZE)
    # A patch of ones around the corner of the cube that is nearest to the camera, with no silhouette in it.
    tip = mesh.verts[(mesh.verts @ camera.world_to_camera[2, :3]).argmin()]
    x, y = camera.project(tip).int().tolist()
    patch = torch.zeros((*camera.size, 1), dtype=F64)
    patch[y - 2 : y + 3, x - 2 : x + 3] = 1.0

    def gradient(visibility: bool, **options: Any) -> Tensor:
        verts = mesh.verts.clone().requires_grad_()
        found = eg.render_aovs(
            mesh.replace(verts=verts), camera, [name], visibility=visibility, **{"seed": 0, **options}
        )[name]
        return torch.autograd.grad((found * patch * torch.tensor([1.0, 0.3, -0.6][: found.shape[-1]])).sum(), verts)[0]

    many = {"sampling": eg.Sampling(surface=20_000, edges=20_000)}
    moving, still = (gradient(visibility, **many) for visibility in (True, False))
    if name == "shading_normal":
        assert torch.equal(moving, still)
    else:
        assert (moving - still).norm() > 0.3 * moving.norm()


def test_sharp_shading_normals_of_split_vertices() -> None:
    """Vertices of their own keep an edge sharp: then the shading normal is that of the face, creases included."""
    mesh, camera = cube(), front_camera(SIZE)

    def both(visibility: bool) -> list[Tensor]:
        out = []
        for name in ("normal", "shading_normal"):
            verts = mesh.verts.clone().requires_grad_()
            split = eg.Mesh(verts[mesh.faces.reshape(-1)], torch.arange(mesh.faces.numel()).reshape(-1, 3))
            options: dict[str, Any] = {"visibility": visibility, "sampling": eg.Sampling(surface=20_000, edges=20_000)}
            found = eg.render_aovs(split, camera, [name], **{"seed": 0, **options})[name]
            out += [found.detach(), torch.autograd.grad(products({name: found})[name], verts)[0]]
        return out

    normal, by_normal, shading, by_shading = both(True)
    assert (normal - shading).abs().max() < 1e-12
    assert (by_normal - by_shading).norm() < 0.01 * by_normal.norm()
    assert (by_normal - both(False)[1]).norm() > 0.1 * by_normal.norm()


# -- as render() does ---------------------------------------------------------------------------------------------------


def test_channels_of_one_call_share_their_samples() -> None:
    scene, camera = two_meshes(), front_camera(SIZE)
    every = eg.render_aovs(scene, camera, AOVS, 4, 7)
    assert list(every) == list(AOVS)
    for name in AOVS:
        alone = eg.render_aovs(scene, camera, [name], 4, 7)[name]
        # Where uvs are asked for, faces have a texture, and their samples are added up one by one.
        assert (
            torch.equal(alone, every[name]) if name in ("image", *IDS) else (alone - every[name]).abs().max() < 1e-14
        ), name


def test_a_batch_of_cameras_and_float32() -> None:
    scene = two_meshes().to(torch.float32)
    one = front_camera(SIZE)
    other = one.replace(world_to_camera=one.world_to_camera + torch.tensor([[0.0, 0, 0, 0.2]] * 3 + [[0.0] * 4]))
    both = one.replace(world_to_camera=torch.stack([one.world_to_camera, other.world_to_camera]))
    batch = eg.render_aovs(scene, both, AOVS, 16, seed=0)
    for i, camera in enumerate((one, other)):
        single = eg.render_aovs(scene, camera, AOVS, 16, seed=0)
        for name in AOVS:
            assert batch[name].shape == (2, *single[name].shape)
            assert batch[name].dtype == (torch.int64 if name in IDS else torch.float32)
            if i == 0 or name in IDS:  # later cameras have samples of their own
                assert torch.equal(batch[name][i], single[name])
    # The gradient by each camera is that of its own channels.
    world = both.world_to_camera.clone().requires_grad_()
    found = eg.render_aovs(scene, both.replace(world_to_camera=world), ["depth", "alpha"], 16, seed=0)
    (grad,) = torch.autograd.grad(cast(Tensor, sum(products({n: x[0] for n, x in found.items()}).values())), world)
    assert (grad[1] == 0).all() and (grad[0] != 0).any()


@pytest.mark.unwatched
def test_transforms() -> None:
    """Forward mode and reverse mode give one number, and torch.vmap is a loop."""
    scene, camera = two_meshes(), front_camera(SIZE)
    names = ["alpha", "depth", "normal", "shading_normal", "uv", "position", "barycentrics"]
    many: dict[str, Any] = {"sampling": eg.Sampling(surface=10_000, edges=20_000)}
    direction = torch.tensor([0.3, 1.0, 0.2], dtype=F64)

    def channels(theta: Tensor) -> dict[str, Tensor]:
        return eg.render_aovs(*moved(scene, camera, theta), names, 16, **{"seed": 0, **many})

    still = channels(torch.zeros(3, dtype=F64))
    primal, tangent = cast(Any, torch.func.jvp)(channels, (torch.zeros(3, dtype=F64),), (direction,))
    theta = torch.zeros(3, dtype=F64, requires_grad=True)
    for name, product in products(channels(theta)).items():
        assert torch.equal(primal[name], still[name])
        (reverse,) = torch.autograd.grad(product, theta, retain_graph=True)
        forward = products({name: tangent[name]})[name]
        assert abs(forward - reverse @ direction) < 0.03 * (reverse * direction).abs().sum(), name
    ids = torch.func.vmap(lambda t: eg.render_aovs(*moved(scene, camera, t), ["face_id", "alpha"], seed=0))
    rows = torch.stack([torch.zeros(3, dtype=F64), 0.1 * direction])
    found = ids(rows)
    for i, row in enumerate(rows):
        for name, x in eg.render_aovs(*moved(scene, camera, row), ["face_id", "alpha"], seed=0).items():
            assert torch.equal(found[name][i], x)


def test_jvp_of_channels() -> None:
    scene, camera = two_meshes(), front_camera(SIZE)
    verts = scene.meshes[0].verts
    tangents = {verts: torch.stack([torch.ones_like(verts), verts])}
    found, derivatives = eg.jvp(scene, camera, tangents, aovs=["alpha", "depth"], seed=0)
    assert {n: x.shape for n, x in found.items()} == dict.fromkeys(["alpha", "depth"], (SIZE, SIZE, 1))
    assert {n: x.shape for n, x in derivatives.items()} == dict.fromkeys(["alpha", "depth"], (2, SIZE, SIZE, 1))
    image, image_dot = eg.jvp(scene, camera, tangents, seed=0)
    both = eg.jvp(scene, camera, tangents, aovs=["image", "alpha"], seed=0)
    assert torch.equal(both[0]["image"], image) and both[1]["image"].shape == image_dot.shape
    with pytest.raises(ValueError, match="aovs: expected channels with derivatives, got 'face_id'"):
        eg.jvp(scene, camera, tangents, aovs=["face_id"], seed=0)


def test_a_texture_gets_the_images_gradient() -> None:
    """Channels besides the image change nothing about what the image's own loss does to it."""
    mesh, camera = textured(icosphere(1)), front_camera(SIZE)
    assert mesh.texture is not None
    texture = mesh.texture.clone().requires_grad_()
    found = eg.render_aovs(
        mesh.replace(texture=texture), camera, ["image", "uv", "alpha"], sampling=eg.Sampling(surface=50_000), seed=0
    )
    (grad,) = torch.autograd.grad(products(found)["image"], texture)
    alone = eg.render(mesh.replace(texture=texture), camera, sampling=eg.Sampling(surface=50_000), seed=0)
    (truth,) = torch.autograd.grad((alone * smooth_adjoint(*alone.shape)).sum(), texture)
    assert (grad - truth).norm() < 0.02 * truth.norm()


@pytest.mark.parametrize(
    ("aovs", "error", "message"),
    [
        ("alpha", TypeError, r"aovs: expected a list of names, such as \[.image., .alpha.\], got 'alpha'"),
        (3, TypeError, "aovs: expected a list of names.*got 3"),
        ([], ValueError, "aovs: expected at least one of image, alpha, .*, got none"),
        (["alpha", "normals"], ValueError, "aovs: expected names among image, .*, got 'normals'"),
        (["alpha", "depth", "alpha"], ValueError, "aovs: expected each name once, got 'alpha' twice"),
        ([None], ValueError, "aovs: expected names among .*, got None"),
        ([["alpha"]], ValueError, "aovs: expected names among .*, got .*alpha"),
        (["uv"], ValueError, r"aovs: expected uvs of all meshes for 'uv', got none of meshes\[1\]; give it uvs"),
    ],
)
def test_messages(aovs: object, error: type[Exception], message: str) -> None:
    scene = eg.Scene([textured(icosphere(0)), icosphere(0)])
    with pytest.raises(error, match=message):
        eg.render_aovs(scene, front_camera(SIZE), aovs, seed=0)  # type: ignore[arg-type]


def test_faces_without_area() -> None:
    """They are never seen, and their normals, which do not exist, do no harm."""
    mesh = icosphere(1)
    faces = torch.cat([mesh.faces, torch.tensor([[3, 3, 4], [5, 5, 5]])])
    verts = mesh.verts.clone().requires_grad_()
    names = ["normal", "shading_normal", "depth"]
    found = eg.render_aovs(eg.Mesh(verts, faces), front_camera(SIZE), names, seed=0)
    plain = eg.render_aovs(eg.Mesh(mesh.verts, mesh.faces), front_camera(SIZE), names, seed=0)
    assert all(torch.equal(found[name], plain[name]) for name in names)
    (grad,) = torch.autograd.grad(cast(Tensor, sum(products(found).values())), verts)
    assert grad.isfinite().all()
