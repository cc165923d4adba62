"""Radiance of a fixed sample, its face given, and its derivatives: what one interior sample of the gradient does.

The kernel's adjoint is checked against central differences of the kernel (gradcheck); its values and gradients against
the float64 twin in PyTorch.
"""

from __future__ import annotations

import math

import pytest
import torch
from kernel_parts import parts
from oracles import reference
from scenes import cube, front_camera, smooth_colors
from torch import Tensor
from torch.autograd.function import once_differentiable

import edgegrad as eg
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.operators import kernel_camera, kernel_scene
from edgegrad.kernel.request import FILTERS, PackedCamera, pack_camera

pytestmark = pytest.mark.quick

F64 = torch.float64


class Shade(torch.autograd.Function):
    """Radiance (N, C) at the points (N, 2) of the given faces (N,)."""

    @staticmethod
    def forward(ctx, verts, colors, uvs, texels, world_to_camera, K, flat, view, faces, points):
        flat = flat._replace(verts=verts, colors=colors, uvs=uvs, texels=texels)
        packed = PackedCamera(world_to_camera[None], K[None], *view)
        kernel = kernel_scene(flat), kernel_camera(packed)
        radiance = torch.empty((len(points), flat.background.shape[-1]), dtype=F64)
        parts.shade_at(*kernel, faces.int().numpy(), points.numpy(), radiance.numpy())
        ctx.save_for_backward(verts, colors, uvs, texels, world_to_camera, K)
        ctx.rest = kernel, faces, points
        return radiance

    @staticmethod
    @once_differentiable
    def backward(ctx, radiance_bar):
        (scene, camera), faces, points = ctx.rest
        grads = [torch.zeros_like(x) for x in ctx.saved_tensors]
        arrays = [x.numpy() for x in (faces.int(), points, radiance_bar.contiguous(), *grads)]
        parts.shade_at_vjp(scene, camera, *arrays)
        return (*grads, None, None, None, None)


def shade(scene: eg.Scene, camera: eg.Camera, faces: Tensor, points: Tensor) -> Tensor:
    flat = flatten(scene)
    assert flat.colors.dtype == F64
    view = pack_camera(camera)[2:]
    # The kernel's scene is built in forward from the four that may require gradients, and the rest.
    fixed = flat._replace(**{n: t.detach() for n, t in flat._asdict().items() if isinstance(t, Tensor)})
    return Shade.apply(
        flat.verts, flat.colors, flat.uvs, flat.texels, camera.world_to_camera, camera.K, fixed, view, faces, points
    )


# -- scenes -----------------------------------------------------------------------------------------------------------

VERTS = torch.tensor([[-0.9, -0.8, 0.2], [0.9, -0.7, -0.3], [0.8, 0.9, 0.4], [-0.7, 0.8, -0.1]], dtype=F64)
FACES = torch.tensor([[0, 1, 2], [2, 3, 0]])
UVS = torch.tensor(
    [[0.1, 0.15], [0.93, 0.07], [1.31, 1.2], [-0.35, 0.81], [0.4, 0.6]], dtype=F64
)  # beyond a texture's border
UV_FACES = torch.tensor([[0, 1, 2], [4, 3, 0]])
CHANNELS = 2


def values(*shape: int) -> Tensor:
    """Anything but constant."""
    n = torch.tensor(shape).prod()
    return smooth_colors(torch.stack([torch.arange(n) * k for k in (1.0, 0.37, -0.61)], -1).double())[:, 0].reshape(
        shape
    )


APPEARANCES = {
    "colors": {"colors": values(4, CHANNELS)},
    "face_colors": {"face_colors": values(2, CHANNELS)},
    "corner_colors": {"corner_colors": values(2, 3, CHANNELS)},
    "texture": {"texture": values(3, 4, CHANNELS), "uvs": UVS},
    "clamp": {"texture": values(3, 4, CHANNELS), "uvs": UVS, "wrap": "clamp"},
    "mirror": {"texture": values(3, 4, CHANNELS), "uvs": 3.0 * UVS - 1.0, "wrap": ("mirror", "repeat")},
    "nearest": {
        "texture": values(3, 4, CHANNELS),
        "uvs": 3.0 * UVS - 1.0,
        "wrap": ("clamp", "mirror"),
        "filter": "nearest",
    },
}
VIEWS = ["perspective", "orthographic"]


def mesh(appearance: str, verts: Tensor = VERTS) -> eg.Mesh:
    return eg.Mesh(
        verts, FACES, uv_faces=UV_FACES if "uvs" in APPEARANCES[appearance] else None, **APPEARANCES[appearance]
    )


def skewed_camera(view: str) -> eg.Camera:
    """Not square pixels, and not a right angle between their sides."""
    camera = front_camera((20, 24), view)
    return camera.replace(
        K=camera.K * torch.tensor([[1.0], [1.2], [1.0]], dtype=F64) + torch.diag(torch.ones(2, dtype=F64), 1)
    )


def samples(scene: eg.Scene, camera: eg.Camera) -> tuple[Tensor, Tensor]:
    """Two points on each face (N,) where they are seen in the image (N, 2), hidden or not."""
    corners = torch.cat([m.verts[m.faces] for m in scene.meshes]).detach()
    barycentrics = torch.tensor([[0.2, 0.31, 0.49], [0.55, 0.24, 0.21]], dtype=F64)
    faces = torch.arange(len(corners)).repeat_interleave(2)
    return faces, camera.project((barycentrics @ corners).reshape(-1, 3)).detach()


# -- against central differences --------------------------------------------------------------------------------------


# gradcheck steps by 1e-6 in double: errors of 1e-12 from third derivatives and, from rounding, 1e-10 of the radiance
# (≤ 1) and 1e-9 of the pixel positions (≤ 30) that it depends on. Below, a thousand times that.
STEP, ATOL, RTOL = 1e-6, 1e-6, 1e-6


def check_gradient(scene: eg.Scene, camera: eg.Camera, inputs: dict[str, Tensor]) -> None:
    """Check gradients in fields of the first mesh, and in the upper rows of "world_to_camera" and "K"; their last rows are
    fixed."""
    faces, points = samples(scene, camera)
    names = list(inputs)

    def function(*tensors: Tensor) -> Tensor:
        given = dict(zip(names, tensors, strict=True))
        of_camera = {
            name: torch.cat([given.pop(name), getattr(camera, name)[-1:]])
            for name in ("world_to_camera", "K")
            if name in given
        }
        meshes = [scene.meshes[0].replace(**given), *scene.meshes[1:]]
        return shade(scene.replace(meshes=meshes), camera.replace(**of_camera), faces, points)

    leaves = [t.detach().clone().requires_grad_() for t in inputs.values()]
    assert torch.autograd.gradcheck(function, leaves, eps=STEP, atol=ATOL, rtol=RTOL)


@pytest.mark.parametrize(
    ("appearance", "view"),
    [
        pytest.param(
            appearance,
            view,
            marks=[pytest.mark.slow] if "uvs" in APPEARANCES[appearance] and view != VIEWS[k % 2] else [],
        )
        for k, appearance in enumerate(APPEARANCES)
        for view in VIEWS
    ],
)
def test_gradcheck(appearance, view):
    """Every input at once: vertices, its appearance, the pose's entries and those of K."""
    camera = skewed_camera(view)
    tensors = {name: value for name, value in APPEARANCES[appearance].items() if isinstance(value, Tensor)}
    inputs = {"verts": VERTS, **tensors, "world_to_camera": camera.world_to_camera[:3], "K": camera.K[:2]}
    check_gradient(eg.Scene(mesh(appearance)), camera, inputs)


@pytest.mark.parametrize("appearance", ["colors", "texture"])
def test_gradcheck_of_a_face_that_reaches_behind_the_camera(appearance):
    """A floor under the camera, of which the part before it is seen."""
    camera = skewed_camera("perspective")
    to_world = torch.linalg.inv(camera.world_to_camera)
    q = torch.tensor([[-3.0, 0.9, 6.0], [3.0, 1.0, 6.0], [2.0, 0.8, -4.0], [-2.0, 1.1, -5.0]], dtype=F64)
    verts = q @ to_world[:3, :3].mT + to_world[:3, 3]
    scene = eg.Scene(mesh(appearance, verts))
    faces = torch.tensor([0, 0, 1])
    points = torch.tensor([[12.0, 16.5], [15.2, 18.1], [10.3, 19.2]], dtype=F64)
    torch.testing.assert_close(shade(scene, camera, faces, points), reference.radiance(scene, camera, points, faces))

    def function(verts: Tensor, pose: Tensor) -> Tensor:
        moved = camera.replace(world_to_camera=torch.cat([pose, camera.world_to_camera[3:]]))
        return shade(scene.replace(meshes=[scene.meshes[0].replace(verts=verts)]), moved, faces, points)

    leaves = [t.clone().requires_grad_() for t in (verts, camera.world_to_camera[:3])]
    assert torch.autograd.gradcheck(function, leaves, eps=STEP, atol=ATOL, rtol=RTOL)


def test_gradcheck_rejects_a_wrong_gradient():
    """Colours taken for those of the mesh turned by one face: the check must not be blind to it."""
    scene, camera = eg.Scene(mesh("corner_colors")), skewed_camera("perspective")
    faces, points = samples(scene, camera)
    right = APPEARANCES["corner_colors"]["corner_colors"].clone().requires_grad_()

    def wrong(colors: Tensor) -> Tensor:
        value = shade(eg.Scene(scene.meshes[0].replace(corner_colors=colors)), camera, faces, points)
        other = shade(eg.Scene(scene.meshes[0].replace(corner_colors=colors.flip(0))), camera, faces, points)
        return value.detach() + other - other.detach()

    with pytest.raises(RuntimeError, match="Jacobian mismatch"):
        torch.autograd.gradcheck(wrong, [right], eps=STEP, atol=ATOL, rtol=RTOL)


# -- against the float64 twin -----------------------------------------------------------------------------------------


def mixed_scene() -> eg.Scene:
    """All appearances at once, two textures of different size, and a mesh without any, at different places."""
    meshes = [
        mesh(appearance, VERTS + torch.tensor([0.1 * i, 0.0, -0.2 * i])) for i, appearance in enumerate(APPEARANCES)
    ]
    other = mesh("texture", VERTS * 0.7).replace(
        texture=values(5, 2, CHANNELS), uvs=UVS + 0.1, uv_faces=UV_FACES.flip(0)
    )
    return eg.Scene([*meshes, eg.Mesh(VERTS * 0.5, FACES), other])


def leaves_of(scene: eg.Scene, camera: eg.Camera) -> tuple[eg.Scene, eg.Camera, dict[str, Tensor]]:
    """Return the same, with leaves that require gradients for all floating-point tensors."""
    leaves = {}

    def leaf(name: str, tensor: Tensor) -> Tensor:
        leaves[name] = tensor.detach().clone().requires_grad_()
        return leaves[name]

    meshes = []
    for i, m in enumerate(scene.meshes):
        fields = {n: v for n, v in vars(m).items() if isinstance(v, Tensor) and v.is_floating_point()}
        meshes.append(m.replace(**{n: leaf(f"{n} of mesh {i}", v) for n, v in fields.items()}))
    camera = camera.replace(world_to_camera=leaf("world_to_camera", camera.world_to_camera), K=leaf("K", camera.K))
    return eg.Scene(meshes), camera, leaves


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("appearance", [*APPEARANCES, "mixed"])
def test_equals_the_twin(appearance, view):
    """Value and gradient, to what rounding in double leaves: two formulas for the same barycentrics."""
    scene = mixed_scene() if appearance == "mixed" else eg.Scene(mesh(appearance))
    scene, camera, leaves = leaves_of(scene, skewed_camera(view))
    faces, points = samples(scene, camera)
    ours, twin = shade(scene, camera, faces, points), reference.radiance(scene, camera, points, faces)
    torch.testing.assert_close(ours, twin, rtol=0, atol=1e-12)

    bar = values(*ours.shape)
    grads = [
        torch.autograd.grad((image * bar).sum(), list(leaves.values()), allow_unused=True) for image in (ours, twin)
    ]
    for name, a, b in zip(leaves, *grads, strict=True):
        # The last row of K is fixed; only the twin, written with homogeneous coordinates, has a derivative there.
        rows = slice(2) if name == "K" else slice(None)
        a, b = (torch.zeros_like(leaves[name]) if g is None else g for g in (a, b))
        atol = 1e-9 * max(1.0, float(b.abs().max()))
        torch.testing.assert_close(a[rows], b[rows], rtol=0, atol=atol, msg=lambda text, name=name: f"{name}: {text}")


@pytest.mark.parametrize("filter", FILTERS)
@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
@pytest.mark.parametrize(("degrees", "spp"), [(0, 5), (20, 7), (20, 16), (45, 5), (45, 20), (-45, 1), (-45, 100)])
def test_pixels_that_nothing_can_reach(degrees: int, spp: int, projection: str, filter: str) -> None:
    """No ray is cast far from a bar across the picture. Vertices of no face, no farther away than its ends, widen the octagon
    in which rays are cast; they change no bit, also where pixels share the last samples of a batch."""
    bar = cube()
    bar = bar.replace(verts=bar.verts / bar.verts.abs().amax(0) * torch.tensor([1.0, 0.04, 0.04], dtype=F64))
    assert bar.colors is not None
    more = torch.tensor([[0.0, 0.9, 0.0], [0.0, -0.9, 0.0], [0.0, 0.0, 0.9]], dtype=F64)
    wide = bar.replace(verts=torch.cat([bar.verts, more]), colors=torch.cat([bar.colors, bar.colors[:3]]))
    angle = torch.tensor(math.radians(degrees), dtype=F64)
    roll = torch.eye(3, dtype=F64)
    roll[:2, :2] = torch.stack([angle.cos(), -angle.sin(), angle.sin(), angle.cos()]).reshape(2, 2)
    camera = eg.Camera.look_at((0.4, 0.3, 2.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 60.0, (64, 80))
    if projection == "orthographic":
        half = torch.tensor([[0.5, 0.5, 1.0], [0.5, 0.5, 1.0], [1.0, 1.0, 1.0]], dtype=F64)
        camera = camera.replace(projection=projection, K=camera.K * half)
    background = torch.rand(64, 80, 3, generator=torch.Generator().manual_seed(0), dtype=F64)
    found = []
    for mesh in (bar, wide):
        behind = background.clone().requires_grad_()
        image = eg.render(eg.Scene([mesh.transformed(roll)], behind), camera, spp, filter=filter, seed=0)
        image.sum().backward()
        found.append((image.detach(), behind.grad))
    (image, coverage), (wide_image, wide_coverage) = found
    assert torch.equal(image, wide_image) and torch.equal(coverage, wide_coverage)
    assert (image != background).any()
    for rows in (slice(8), slice(-8, None)):
        # In the middle of the sides above and below.
        assert torch.equal(image[rows, 30:50], background[rows, 30:50])
