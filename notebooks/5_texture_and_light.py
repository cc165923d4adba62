# %% [markdown]
# # 5. Texture, light, and the gradient of a shadow
#
# The colours of a surface, its light, and its shadows are all found from pictures. The border of a shadow is an edge,
# too, and moves with caster, receiver and light.

# %%
import math

import matplotlib.pyplot as plt
import torch
import torch.nn.functional as F
import trimesh

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, fit_scene, fit_texture
from edgegrad.image import linear_to_srgb


def mean(render, seeds=4):
    """The mean over seeds: of a lit scene a face is shaded at few points of a pixel, however many samples it has."""
    with torch.no_grad():
        return sum(render(seed) for seed in range(seeds)) / seeds


def show(signed=(), vmax=2.0, **images):
    fig, axes = plt.subplots(1, len(images), figsize=(1.75 * len(images), 2.0), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        if title in signed:
            axis.imshow(image.sum(-1), cmap="RdBu_r", vmin=-vmax, vmax=vmax)
        else:
            axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)))
        axis.set_title(title.replace("_", " "), fontsize=10)
        axis.axis("off")
    plt.tight_layout()


# %% [markdown]
# ## A texture from six pictures
#
# A torus with texture coordinates, painted with blotches. `fit_texture` gets the shape, cameras and pictures.

# %%
rings, sides = 48, 24
u, v = (
    grid.reshape(-1) for grid in torch.meshgrid(torch.arange(rings + 1.0), torch.arange(sides + 1.0), indexing="ij")
)
a, b = u * math.tau / rings, v * math.tau / sides
verts = torch.stack([(0.7 + 0.3 * b.cos()) * a.cos(), (0.7 + 0.3 * b.cos()) * a.sin(), 0.3 * b.sin()], 1)
i, j = (grid.reshape(-1) for grid in torch.meshgrid(torch.arange(rings), torch.arange(sides), indexing="ij"))
corner = i * (sides + 1) + j
faces = torch.cat(
    [
        torch.stack([corner, corner + sides + 1, corner + sides + 2], 1),
        torch.stack([corner, corner + sides + 2, corner + 1], 1),
    ]
)
noise = torch.rand((1, 3, 6, 12), generator=torch.Generator().manual_seed(4))
texture = F.interpolate(noise, (64, 128), mode="bicubic")[0].movedim(0, -1).clamp(0.05, 0.95)
uvs = torch.stack([u / rings, v / sides], 1)
bare = eg.Mesh(verts, faces, uvs=uvs, uv_faces=faces)
painted = bare.replace(texture=texture)

around = [(2.6, 0.3, 1.6), (-0.9, 2.4, 1.7), (-1.5, -2.2, 1.5), (1.4, 1.9, -1.9), (-2.6, 0.2, -1.6), (1.0, -2.3, -1.9)]
cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0, 0, 1), 40.0, (96, 96)) for eye in around]
pictures = [eg.render(painted, camera, spp=64, seed=1000 + k) for k, camera in enumerate(cameras)]
fit = fit_texture(bare, pictures, cameras, (64, 128), options=FitOptions(seed=0, steps=60, spp=4, progress=False))

new = eg.Camera.look_at((0.8, -2.0, 2.2), (0, 0, 0), (0, 0, 1), 40.0, (96, 96))  # none of the six
held_out = [eg.render(mesh, new, spp=64, seed=k) for k, mesh in enumerate((painted, fit.mesh))]
psnr = -10 * math.log10((held_out[0] - held_out[1]).square().mean())
show(true_texture=texture, found_texture=fit.mesh.texture)
show(a_new_view=held_out[0], with_the_texture_found=held_out[1])
print(f"{fit.seconds:.0f} s; {psnr:.1f} dB in a view that was not among the six")

# %% [markdown]
# *What to see:* no difference. Where no camera looks, texels take the colours of their surroundings, since the
# texture is found as the sum of an image pyramid, whose coarse levels reach there.
#
# ## Lights
#
# A mesh with a `Material` is lit by the lights of its scene and casts shadows. A point light gives hard borders, a
# panel soft ones, and a sky, an image of all directions, hardly any. For each shaded point, a point of an extended light
# is drawn; more `light_samples` mean less noise.

# %%
shape = trimesh.creation.torus(0.6, 0.22, major_sections=64, minor_sections=32)
shape.apply_transform(trimesh.transformations.rotation_matrix(1.1, [1, 0.3, 0.2]))
shape.apply_translation([0, 0, 0.85])
verts, faces = torch.tensor(shape.vertices, dtype=torch.float32), torch.tensor(shape.faces)
colors = 0.5 + 0.3 * torch.sin(3.0 * verts + torch.tensor([0.0, 1.0, 2.0]))
matt, plastic = eg.Material(), eg.Material(metallic=0.0, roughness=0.25)
ring = eg.Mesh(verts, faces, colors=colors, material=matt)
ring = ring.replace(normals=ring.vertex_normals())
gray = eg.Material(base_color=torch.tensor([0.6, 0.6, 0.6]))
ground = eg.shapes.rectangle(u=(3.0, 0.0, 0.0), v=(0.0, 3.0, 0.0), material=gray)
camera = eg.Camera.look_at((0.9, -3.4, 2.6), (0.0, 0.0, 0.5), (0.0, 0.0, 1.0), 40.0, (80, 80))

position = torch.tensor([1.3, -0.9, 3.2])
light = eg.lights.PointLight(position, 25.0)
vector = torch.tensor
emitting = eg.Material(base_color=0.0, emission=16.0)
panel = eg.shapes.rectangle(position, (0.6, 0.0, 0.2), (0.0, 0.5, 0.1), material=emitting)
height = torch.linspace(1, -1, 16)[:, None, None].expand(16, 32, 3)
up_is_z = vector([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
sky = eg.lights.Environment(0.5 + 0.4 * height * vector([0.2, 0.6, 1.0]), rotation=up_is_z)


def picture(material, light, **options):
    scene = eg.Scene([ring.replace(material=material), ground], lights=[light])
    return mean(lambda seed: eg.render(scene, camera, 8, seed, **options))


show(
    point=picture(matt, light),
    point_on_plastic=picture(plastic, light),
    panel=picture(matt, panel, sampling=eg.Sampling(lights=8)),
    sky=picture(matt, sky, sampling=eg.Sampling(lights=64)),
)

# %% [markdown]
# *What to see:* the same ring, four times. Plastic has a highlight; under the panel the shadow is sharp where the ring
# is near the ground and soft where it is far.
#
# ## The gradient of a shadow
#
# `eg.jvp` shows how each pixel changes as the light moves to the right. Next to it are the same without the boundary
# term, and a finite difference of two pictures.

# %%
right = torch.tensor([1.0, 0.0, 0.0])


def lit(place, lift=0.0):
    return eg.Scene(
        [ring.transformed(t=lift * vector([0.0, 0.0, 1.0])), ground], lights=[eg.lights.PointLight(place, 25.0)]
    )


def derivative(seeds, **options):
    direction = {position: right[None]}
    return sum(eg.jvp(lit(position), camera, direction, 8, seed, **options)[1][0] for seed in range(seeds)) / seeds


whole, inside = derivative(6), derivative(3, visibility=False)
step = 0.06
high, low = (mean(lambda seed, s=s: eg.render(lit(position + s * step * right), camera, 8, seed), 16) for s in (1, -1))
difference = (high - low) / (2 * step)
show(
    ("derivative", "without_boundaries", "finite_difference"),
    image=picture(matt, light),
    derivative=whole,
    without_boundaries=inside,
    finite_difference=difference,
)


def blocks(image):
    """Sums over 8 × 8 pixels, in which noise averages out."""
    return image.reshape(10, 8, 10, 8, 3).sum((1, 3))


def ratio(a, b):
    """The factor c by which c b comes closest to a."""
    return ((blocks(a) * blocks(b)).sum() / blocks(b).square().sum()).item()


print(f"over the finite difference: {ratio(whole, difference):.3f}, without boundaries {ratio(inside, difference):.3f}")

# %% [markdown]
# *What to see:* as the light goes right, the shadow goes left. On its border it is all or nothing: blue on the left,
# where shadow comes, red on the right, where light comes. Without the boundary term only the shading's slow change is
# left.
#
# ## Where the light is
#
# One picture shows where the light stands, and how high the ring hangs.

# %%
truth = position, torch.tensor(0.0)
start = vector([0.8, -0.4, 2.8]), torch.tensor(0.15)
target = mean(lambda seed: eg.render(lit(*truth), camera, 16, 1000 + seed))
place, lift = (value.clone().requires_grad_() for value in start)
optimizer = torch.optim.Adam([place, lift], lr=0.08)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, 80, eta_min=1e-4)
for seed in range(80):
    optimizer.zero_grad()
    (eg.render(lit(place, lift), camera, 2, seed) - target).square().mean().backward()
    optimizer.step()
    schedule.step()
off = [(p.detach() - truth[0]).norm().item() for p in (start[0], place)]
print(
    f"the light is off by {off[0]:.2f} at the start, {off[1]:.3f} at the end; the ring is {lift.item():+.3f} too high"
)
show(
    target=target,
    start=mean(lambda seed: eg.render(lit(*start), camera, 8, seed)),
    found=mean(lambda seed: eg.render(lit(place, lift), camera, 8, seed)),
)

# %% [markdown]
# *What to see:* start and target differ in where the shadow lies and how bright the ground is; what was found looks
# like the target. `examples/` has longer fits: a sun and a pose, an environment in a mirror, a shape from its shadow
# alone.
#
# ## What a ball is made of
#
# Base colour, metallic and roughness of one ball are found from four pictures of it under a known sky. What the ball
# mirrors shows how rough it is; what it mirrors at its outline, how much of a metal.

# %%
ball = eg.shapes.sphere(subdivisions=3)
ball = ball.replace(normals=ball.verts)
image = torch.linspace(0.9, 0.2, 32)[:, None, None].repeat(1, 64, 3)
for row, column, radiance in ((6, 10, 6.0), (10, 42, 9.0), (17, 26, 4.0)):
    image[row : row + 4, column : column + 4] = radiance
studio = eg.lights.Environment(image, visible=False)
eyes = [(3.2, 0.8, 1.0), (-1.1, -0.6, 3.2), (-3.2, 1.2, -1.2), (1.0, -1.0, -3.3)]
cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 40.0, (48, 48)) for eye in eyes]


def made(values):
    return eg.Scene([ball.replace(material=eg.Material(**values))], lights=[studio])


gold = {"base_color": vector([0.9, 0.65, 0.25]), "metallic": vector(0.7), "roughness": vector(0.3)}
pictures = [
    eg.render(made(gold), camera, 64, 1000 + k, sampling=eg.Sampling(lights=2)) for k, camera in enumerate(cameras)
]
sought = {name: Parameter(0.02, torch.full_like(value, 0.5), low=0.0, high=1.0) for name, value in gold.items()}
options = {"steps": 300, "spp": 4, "views_per_step": 1, "loss_tolerance": 0.0, "progress": False}
fit = fit_scene(made, pictures, cameras, sought, options=FitOptions(seed=0, **options))
made_of = {name: (fit.values[name] - value).abs().max().item() for name, value in gold.items()}
print("off by " + ", ".join(f"{value:.4f} in {name.replace('_', ' ')}" for name, value in made_of.items()))
new = eg.Camera.look_at((2.4, 1.2, -2.0), (0, 0, 0), (0, 1, 0), 36.0, (48, 48))  # none of the four
balls = [mean(lambda seed, s=s: eg.render(s, new, 64, seed)) for s in (made(gold), fit.start, fit.scene)]
plt.figure(figsize=(4.8, 1.9))
plt.imshow(linear_to_srgb(torch.cat(balls, 1).clamp(0, 1)))
plt.title("as it is, at the start, as found", fontsize=10)
plt.axis("off")
plt.tight_layout()

# %% [markdown]
# *What to see:* grey and half a metal at the start, gold at the end. A darker metal looks much like one that is less of
# a metal and brighter, so these two are found last. `examples/material.py` does the same for a scan whose base colour
# is a texture.
#
# ## Walls that light one another
#
# Where three walls meet, each sends light to the other two. Gauss–Newton finds the colours of a room's corner from
# two pictures: once in direct light alone, once with indirect light from wall to wall, `bounces=3`.

# %%
colors = {"floor": vector([0.75, 0.75, 0.75]), "left": vector([0.7, 0.2, 0.15]), "right": vector([0.25, 0.35, 0.7])}
o, x, y, z, xy, yz, xz = ([2.0 * float(axis in name) for axis in "xyz"] for name in ("", *"xyz", "xy", "yz", "xz"))
walls = {"floor": vector([o, x, xy, y]), "left": vector([o, y, yz, z]), "right": vector([o, z, xz, x])}
emitting = eg.Material(base_color=0.0, emission=60.0)
bulb = eg.shapes.rectangle((1.1, 1.1, 3.2), (0.25, 0.0, 0.0), (0.0, -0.25, 0.0), material=emitting)
halves = torch.tensor([[0, 1, 2], [0, 2, 3]])


def room(values):
    meshes = [eg.Mesh(wall, halves, material=eg.Material(values[name])) for name, wall in walls.items()]
    return eg.Scene([*meshes, bulb])


eyes = (4.5, 3.6, 2.6), (3.4, 4.6, 2.0)
cameras = [eg.Camera.look_at(eye, (0.7, 0.7, 0.7), (0, 0, 1), 32.0, (48, 48)) for eye in eyes]
pictures = [eg.render(room(colors), camera, 256, 1000 + k, bounces=3) for k, camera in enumerate(cameras)]
sought = {name: Parameter(0.03, torch.full((3,), 0.5), low=0.0, high=1.0) for name in colors}
options = {"method": "gauss-newton", "steps": 30, "spp": 16, "progress": False}
wrong, took, corners = {}, 0.0, [pictures[0]]
for bounces in (1, 3):
    fit = fit_scene(room, pictures, cameras, sought, options=FitOptions(seed=0, bounces=bounces, **options))
    wrong[bounces] = max((fit.values[name] / color - 1).abs().max().item() for name, color in colors.items())
    took += fit.seconds
    corners.append(eg.render(room(fit.values), cameras[0], 64, bounces=3))
print(f"{took:.0f} s; off by {100 * wrong[1]:.0f} % in direct light, by {100 * wrong[3]:.1f} % with three bounces")
plt.figure(figsize=(4.8, 1.9))
plt.imshow(linear_to_srgb(torch.cat(corners, 1).clamp(0, 1)))
plt.title("as it is, found in direct light, with three bounces", fontsize=10)
plt.axis("off")
plt.tight_layout()

# %% [markdown]
# *What to see:* the corner in the middle is too bright: what its walls get from each other was taken for colours of
# their own. On the right the colours are those of the pictures. `examples/corner.py` has pictures of eight bounces.
#
# ## Check

# %%
assert psnr > 30
assert abs(ratio(whole, difference) - 1) < 0.03, "the derivative is that of the image, shadow and all"
assert abs(ratio(inside, difference) - 1) > 0.1, "without boundaries it is not"
assert off[1] < 0.15 * off[0] and abs(lift.item()) < 0.02
assert made_of["roughness"] < 0.01 and made_of["metallic"] < 0.02 and made_of["base_color"] < 0.01
assert wrong[3] < 0.01 < 0.1 < wrong[1]
