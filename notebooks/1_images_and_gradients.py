# %% [markdown]
# # 1. Images and gradients
#
# A renderer makes an image from a scene. A *differentiable* renderer also says how the image, or a loss of it, changes
# with the scene. This notebook shows what such a gradient consists of, on one triangle, and checks it. It takes some
# seconds.

# %%
import matplotlib.pyplot as plt
import torch
import trimesh

import edgegrad as eg
from edgegrad.image import linear_to_srgb

torch.set_printoptions(precision=4, sci_mode=False)


def show(axis, image, title="", **options):
    """An image (H, W, 3) of radiance, or a signed one (H, W) in blue and red."""
    picture = linear_to_srgb(image.detach().clamp(0, 1)) if image.dim() == 3 else image
    axis.imshow(picture, extent=(0, image.shape[1], image.shape[0], 0), cmap="RdBu_r", **options)
    axis.set_title(title, fontsize=10)
    axis.axis("off")


# %% [markdown]
# ## One triangle
#
# A mesh has vertices and faces, here with a colour at each vertex, interpolated in between. A camera looks at it.
# `eg.render` gives linear radiance, a tensor (height, width, channels).

# %%
verts = torch.tensor([[-0.8, -0.6, 0.2], [0.9, -0.4, -0.3], [0.1, 0.8, 0.1]])
triangle = eg.Mesh(
    verts, torch.tensor([[0, 1, 2]]), colors=torch.tensor([[0.9, 0.3, 0.1], [0.9, 0.8, 0.2], [0.3, 0.5, 0.9]])
)
scene = eg.Scene(triangle, background=torch.tensor([0.06, 0.07, 0.1]))
camera = eg.Camera.look_at(eye=(0.0, 0.0, 3.0), target=(0.0, 0.0, 0.0), up=(0.0, 1.0, 0.0), fov_y=40.0, size=(24, 24))
image = eg.render(scene, camera, spp=256)
print(image.shape, image.dtype)

# %% [markdown]
# ## Where an image changes
#
# A pixel is the mean of the radiance $L(x)$ over its square. Let a parameter $\theta$ move the scene. Then two things
# change:
#
# $$\frac{\partial I}{\partial\theta} =
# \underbrace{\int_{\text{pixel}} \frac{\partial L}{\partial\theta}\, dx}_{\text{interior: colours change}}
# \;+\; \underbrace{\int_{\text{edges in the pixel}} \Delta L \; (v \cdot n)\, dl}_{\text{boundary: edges move}}$$
#
# Inside a face the colours change smoothly; automatic differentiation of the shading finds that. At an edge the
# radiance jumps by $\Delta L$, and as the edge moves with velocity $v$ along its normal $n$, the pixel gains what is on
# one side and loses what is on the other. Automatic differentiation of samples does not see this: no sample's colour
# changes until the edge passes over it, and then it jumps.
#
# edgegrad therefore puts samples *on the edges*. Here are some of them, as the upper vertex moves to the right; the
# arrows are their velocities across the edge.

# %%
moving = verts.clone().requires_grad_()
primary = eg.points.primary_hits(scene.replace(meshes=[triangle.replace(verts=moving)]), camera)
edges = eg.points.edge_samples(primary, count=60)

# The velocity across the edge, straight from the formula: ends of edges move, what is between them follows.
corners, moved = camera.project(verts), camera.project(verts + torch.tensor([[0.0, 0, 0], [0.0, 0, 0], [1e-3, 0, 0]]))
speed = (moved - corners) / 1e-3  # pixels a unit of the parameter
fig, axes = plt.subplots(1, 2, figsize=(7, 3.5))
show(axes[0], image, "24 × 24 pixels")
show(axes[1], image, "samples on the edges, and how they move", alpha=0.35)
for a, b in ((0, 1), (1, 2), (2, 0)):
    along = corners[b] - corners[a]
    normal = torch.stack([along[1], -along[0]]) / along.norm()
    share = ((edges.x - corners[a]) @ along.to(edges.x)) / along.square().sum()  # 0 at a, 1 at b
    here = ((edges.x - corners[a] - share[:, None] * along).norm(dim=1) < 1e-3) & (share > 0) & (share < 1)
    x, share = edges.x[here].float(), share[here].float()
    velocity = (share[:, None] * speed[b] + (1 - share[:, None]) * speed[a]) @ normal
    arrows = velocity[:, None] * normal
    axes[1].scatter(*x.T, s=10, color="black")
    axes[1].quiver(*x.T, *arrows.T, color="tab:red", angles="xy", scale_units="xy", scale=4, width=0.006)
plt.tight_layout()

# %% [markdown]
# *What to see:* the samples lie on the outline alone. Those near the upper corner move most, those of the lower edge
# not at all, for neither of its ends moves.
#
# ## The gradient, three ways
#
# Take a loss of the image, $\ell = \sum_q w_q I_q$ with fixed weights $w$. Its gradient by all nine coordinates of the
# triangle is computed
#
# - by the interior alone (`visibility=False`), which is what automatic differentiation of a ray caster gives,
# - by interior and edges (the default),
# - by central finite differences of the image: $(\ell(\theta + h) - \ell(\theta - h)) / 2h$.

# %%
y, x = torch.meshgrid(torch.arange(24.0), torch.arange(24.0), indexing="ij")
weights = torch.sin(x / 5 + 0.5)[..., None] * torch.tensor([1.0, 0.6, 0.2]) + 0.3 * torch.cos(y / 6)[..., None]


def loss(verts, spp=16, **options):
    moved = scene.replace(meshes=[triangle.replace(verts=verts)])
    return (eg.render(moved, camera, spp, **options) * weights).sum()


def gradient(**options):
    leaf = verts.clone().requires_grad_()
    loss(leaf, sampling=eg.Sampling(surface=20_000, edges=20_000), **options).backward()
    return leaf.grad


def finite_differences(h=0.02, spp=4096):
    unit = torch.eye(9).reshape(9, 3, 3)
    with torch.no_grad():
        return torch.stack([(loss(verts + h * u, spp) - loss(verts - h * u, spp)) / (2 * h) for u in unit]).reshape(
            3, 3
        )


interior, whole, differences = gradient(visibility=False), gradient(), finite_differences()
fig, axis = plt.subplots(figsize=(8, 2.8))
bars = {"interior alone": interior, "interior + edges": whole, "finite differences": differences}
for k, (label, values) in enumerate(bars.items()):
    axis.bar(torch.arange(9) + 0.27 * (k - 1), values.reshape(-1), 0.25, label=label)
axis.set_xticks(range(9), [f"{c}{v}" for v in range(3) for c in "xyz"])
axis.set_xlabel("coordinate of vertex 0, 1, 2")
axis.axhline(0, color="black", linewidth=0.5)
axis.legend(frameon=False, fontsize=8)
plt.tight_layout()
error = (whole - differences).norm() / differences.norm()
error_interior = (interior - differences).norm() / differences.norm()
print(f"off the finite differences: interior alone {error_interior:.0%}, interior + edges {error:.2%}")

# %% [markdown]
# *What to see:* interior + edges and finite differences agree, bar by bar. The interior alone is another vector
# altogether: a descent that follows it goes elsewhere. Finite differences need two images a parameter; the gradient
# costs about one more image for all parameters together.
#
# ## The derivative of every pixel
#
# Reverse mode, above, gives one loss's derivative by all parameters. *Forward mode* gives all pixels' derivatives by
# one parameter, or by several directions in one pass: a tangent for each tensor that moves.

# %%
shape = trimesh.creation.torus(0.7, 0.3, major_sections=48, minor_sections=24)
verts3 = torch.tensor(shape.vertices, dtype=torch.float32)
colors = 0.5 + 0.4 * torch.sin(4.0 * verts3 + torch.tensor([0.0, 2.0, 4.0]))
torus = eg.Mesh(verts3, torch.tensor(shape.faces), colors=colors)
view = eg.Camera.look_at((0.4, -2.2, 2.4), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, (96, 96))
world = eg.Scene(torus, background=torch.tensor([0.9, 0.92, 0.95]))

shift = torch.tensor([1.0, 0.0, 0.0]).expand_as(verts3)
turn = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand_as(verts3), verts3)
zoom = view.K * torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
nothing, still = torch.zeros_like(verts3), torch.zeros_like(zoom)
directions = {torus.verts: torch.stack([shift, turn, nothing]), view.K: torch.stack([still, still, zoom])}
picture, derivatives = eg.jvp(world, view, directions, spp=64)

fig, axes = plt.subplots(1, 4, figsize=(9, 2.5))
show(axes[0], picture, "image")
for axis, values, title in zip(axes[1:], derivatives, ["shift to the right", "turn", "zoom in"]):
    show(axis, values.sum(-1), f"its derivative: {title}", vmin=-6, vmax=6)
plt.tight_layout()

# %% [markdown]
# *What to see:* red pixels brighten, blue ones darken. Outlines stand out, inner and outer: there background and torus
# change places. When the torus rotates about its axis its outline stays where it is, and only colours change.
#
# Forward and reverse mode are the same matrix $J$, from two sides: $\langle v, J u\rangle = \langle J^T v, u\rangle$
# for any image $v$ and direction $u$, up to the noise of their samples. `torch.func.jvp` and `jacfwd` go through
# `render` likewise.

# %%
v = torch.sin(torch.arange(96) / 12.0)[None, :, None].expand(96, 96, 3)
leaf = verts3.clone().requires_grad_()
(eg.render(world.replace(meshes=[torus.replace(verts=leaf)]), view) * v).sum().backward()
forward, reverse = (v * derivatives[0]).sum(), (leaf.grad * shift).sum()
print(f"forward {forward:.1f}, reverse {reverse:.1f}")

# %% [markdown]
# ## The gradient by place
#
# Before any parameter, a loss has a gradient at each place of the image: where what is seen there should go.
# `eg.screen_gradient` gives it, for $\ell = \sum (I - I^*)^2$ with a target $I^*$ in which the torus was rotated and
# shifted.

# %%
angle = torch.tensor(0.25)
R = torch.eye(3)
R[:2, :2] = torch.stack([torch.stack([angle.cos(), -angle.sin()]), torch.stack([angle.sin(), angle.cos()])])
target = eg.render(world.transformed(R, torch.tensor([0.15, 0.0, 0.0])), view, spp=64)
by_place = eg.screen_gradient(world, view, 2 * (picture - target), spp=64)

block = 6  # pixels, summed into one arrow
arrows = -by_place.reshape(16, block, 16, block, 2).sum((1, 3))
arrows /= arrows.norm(dim=-1, keepdim=True).clamp(min=1e-9).sqrt()  # so that small ones show too
place = (torch.arange(16) + 0.5) * block
fig, axes = plt.subplots(1, 3, figsize=(8, 2.9))
show(axes[0], target, "target")
show(axes[1], (picture - target).mean(-1), "image − target", vmin=-0.5, vmax=0.5)
show(axes[2], picture, "where the image should go", alpha=0.4)
axes[2].quiver(place, place, arrows[..., 0], arrows[..., 1], angles="xy", color="tab:red", width=0.006)
plt.tight_layout()

# %% [markdown]
# *What to see:* an outline can only be seen to move across itself. On the left the arrows point inward, on the right
# outward: the torus should go to the right, where the target has it. Chained with how vertices or a camera move each
# place, they are the gradient that an optimiser follows.
#
# ## Check
#
# What this notebook claims, as code: it fails if the gradient is wrong.

# %%
assert error < 0.02, "interior + edges is the gradient"
assert error_interior > 0.3, "the interior alone is not"
assert abs(forward / reverse - 1) < 0.02, "forward and reverse mode agree"
