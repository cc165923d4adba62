# %% [markdown]
# # 6. A shader of your own
#
# A shader is a function from points on surfaces to radiance, in PyTorch: a formula, a network, a table. Whatever it
# uses gets its gradient. Silhouettes around it have right gradients without the shader's help, and so have discontinuities
# within it that it declares.

# %%
import math

import matplotlib.pyplot as plt
import torch
import trimesh

import edgegrad as eg
from edgegrad.image import linear_to_srgb

ring = trimesh.creation.torus(0.7, 0.1, major_sections=48, minor_sections=24)
surface = torch.tensor(ring.vertices, dtype=torch.float32)
middle = torch.nn.functional.pad(torch.nn.functional.normalize(surface[:, :2], dim=1) * 0.7, (0, 1))


def torus(tube):
    """With the radius 0.7, and `tube` for that of its tube, a number or a tensor."""
    return eg.Mesh(middle + tube * (surface - middle) / 0.1, torch.tensor(ring.faces))


mesh = torus(0.3)
camera = eg.Camera.look_at((0.4, -2.2, 2.4), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 40.0, (96, 96))


def show(**images):
    fig, axes = plt.subplots(1, len(images), figsize=(2.4 * len(images), 2.7), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)))
        axis.set_title(title.replace("_", " "), fontsize=10)
        axis.axis("off")
    plt.tight_layout()


# %% [markdown]
# ## What a shader sees
#
# `hits` holds N points: `position`, `normal`, `shading_normal`, `uv`, `view` (the direction to the eye), `depth`,
# `face` and more, each made when it is asked for. `hits.visible(light)` casts shadow rays. The shader returns (N, C).

# %%
light = torch.tensor([1.5, -0.5, 3.0])


def clay(hits):
    to_light = torch.nn.functional.normalize(light - hits.position, dim=1)
    lambert = (hits.shading_normal * to_light).sum(1, keepdim=True).clamp(min=0)
    return 0.1 + 0.8 * lambert * hits.visible(light)[:, None] * torch.tensor([0.9, 0.6, 0.4])


def glossy(hits):
    """Paint with a highlight (Blinn 1977)."""
    towards = torch.nn.functional.normalize(torch.tensor([0.5, -0.6, 0.7]), dim=0)
    half = torch.nn.functional.normalize(hits.view + towards, dim=1)
    matt = (hits.shading_normal @ towards).clamp(min=0)[:, None]
    shine = (hits.shading_normal * half).sum(1, keepdim=True).clamp(min=0) ** 12
    paint = 0.5 + 0.3 * torch.sin(3 * hits.position + torch.tensor([0.0, 1.0, 2.0]))
    return paint * (0.25 + 0.75 * matt) + 0.5 * shine


with torch.no_grad():
    show(
        normals=eg.render(mesh, camera, shader=lambda hits: 0.5 + 0.5 * hits.shading_normal),
        clay=eg.render(mesh, camera, shader=clay),
        glossy=eg.render(mesh, camera, shader=glossy),
    )

# %% [markdown]
# ## Silhouettes for nothing
#
# How does the image's sum change as the tube grows? The shader knows nothing of silhouettes. The renderer evaluates it
# on both sides of each edge and adds the boundary term. Next to it are the gradient without that term, and
# finite differences.

# %%


def brightness(tube, seed=0, spp=16, **options):
    return eg.render(torus(tube), camera, spp, seed, shader=glossy, **options).sum()


def slope(seeds=4, **options):
    tube = torch.tensor(0.3, requires_grad=True)
    return sum(torch.autograd.grad(brightness(tube, s, **options), tube)[0].item() for s in range(seeds)) / seeds


with torch.no_grad():
    h = 0.005
    grow_fd = sum((brightness(0.3 + h, s, 64) - brightness(0.3 - h, s, 64)).item() for s in range(4)) / (8 * h)
grow, grow_inside = slope(), slope(visibility=False)
print(f"gradient {grow:.0f}, finite difference {grow_fd:.0f}, without the boundary term {grow_inside:.0f}")

# %% [markdown]
# ## Discontinuities within a face
#
# Stripes are edges that no mesh has. Where a shader jumps it says so: `hits.where(s, a, b)` is `a` where $s > 0$ and
# `b` elsewhere, and the border $s = 0$ has a gradient. In `torch.where` torch finds no gradient at all.

# %%


def painted(turn, where=None):
    def shader(hits):
        angle = torch.atan2(hits.position[:, 1], hits.position[:, 0])
        s = torch.sin(6 * (angle - turn))
        red, white = torch.tensor([0.8, 0.1, 0.1]), torch.tensor([0.9, 0.9, 0.9])
        stripes = hits.where(s, red, white) if where is None else where((s > 0)[:, None], red, white)
        return stripes * (0.3 + 0.7 * hits.shading_normal[:, 2:].clamp(min=0))

    return shader


weights = torch.sin(torch.arange(96) / 6.0)[:, None, None] * torch.cos(torch.arange(96) / 7.0)[:, None]


def loss(turn, seed=0, spp=16, **options):
    return (eg.render(mesh, camera, spp, seed, shader=painted(turn, **options)) * weights).sum()


def turned(seed, **options):
    turn = torch.tensor(0.1, requires_grad=True)
    value = loss(turn, seed, **options)
    return torch.autograd.grad(value, turn)[0].item() if value.requires_grad else 0.0


with torch.no_grad():
    h = 0.02
    turn_fd = sum((loss(0.1 + h, s, 64) - loss(0.1 - h, s, 64)).item() for s in range(12)) / (24 * h)
    show(
        hits_where=eg.render(mesh, camera, 64, shader=painted(0.1)),
        torch_where=eg.render(mesh, camera, 64, shader=painted(0.1, torch.where)),
    )
turn = sum(turned(seed) for seed in range(8)) / 8
print(f"turning the stripes: gradient {turn:.1f}, finite difference {turn_fd:.1f}")
print(f"with torch.where {turned(0, where=torch.where):.1f}")

# %% [markdown]
# *What to see:* with `hits.where` the borders are smooth, too, since pixels that they run through are shaded at more
# points. The gradients differ more: that of `torch.where` is zero.
#
# ## A network, and a shape under it
#
# The appearance and the thickness of a torus are found from six pictures of the glossy one. The network takes a point, its
# normal and the direction to the eye, and gives a colour. Its weights have gradients by torch; the thickness has its
# own mainly from the silhouettes.

# %%
torch.manual_seed(0)
layers = [torch.nn.Linear(9, 48), torch.nn.SiLU(), torch.nn.Linear(48, 48), torch.nn.SiLU(), torch.nn.Linear(48, 3)]
network = torch.nn.Sequential(*layers, torch.nn.Softplus())


def paint(hits):
    return network(torch.cat([hits.position, hits.shading_normal, hits.view], 1))


around = torch.arange(6) * math.tau / 6
cameras = [
    eg.Camera.look_at((2.6 * a.cos(), 2.6 * a.sin(), 1.2 + 0.8 * (k % 2)), (0, 0, 0), (0, 0, 1), size=(72, 72))
    for k, a in enumerate(around)
]
with torch.no_grad():
    targets = [eg.render(mesh, c, 64, 1000, shader=glossy) for c in cameras]
    before = eg.render(torus(0.22), cameras[0], 64, shader=paint)
tube = torch.tensor(0.22, requires_grad=True)
optimizer = torch.optim.Adam([{"params": network.parameters(), "lr": 5e-3}, {"params": [tube], "lr": 3e-3}])
for step in range(150):
    k = step % len(cameras)
    optimizer.zero_grad()
    (eg.render(torus(tube), cameras[k], 8, step, shader=paint) - targets[k]).square().mean().backward()
    optimizer.step()
with torch.no_grad():
    show(target=targets[0], start=before, found=eg.render(torus(tube), cameras[0], 64, shader=paint))
print(f"radius of the tube: 0.22 at the start, {tube.item():.4f} found, 0.3 in truth")

# %% [markdown]
# *What to see:* the network has learnt the paint and some of the highlight; the torus under it has its true thickness.
#
# ## Parts to build from
#
# `render(…, shader=fn)` is made of public parts. Here it is by hand; `eg.points.trace` follows any other rays, for reflections
# or light that bounces.

# %%
tube = torch.tensor(0.3, requires_grad=True)
primary = eg.points.primary_hits(torus(tube), camera)
image = primary.image(glossy(primary.hits))  # with the gradient inside faces
edges = eg.points.edge_samples(primary, creases=False)
with torch.no_grad():
    jump = edges.jump(glossy(edges.hits))
image = eg.points.attach_boundary(image, edges, jump)  # and of what moves at silhouettes
by_parts = torch.autograd.grad(image.sum(), tube)[0].item()
print(primary, edges, f"gradient {by_parts:.0f}", sep="\n")

# %% [markdown]
# ## Check

# %%
assert abs(grow / grow_fd - 1) < 0.03 and abs(grow_inside / grow_fd - 1) > 0.3, "silhouettes around a shader"
assert abs(turn / turn_fd - 1) < 0.03, "discontinuities within it"
assert abs(by_parts / grow_fd - 1) < 0.03, "the same by parts"
