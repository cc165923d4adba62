# %% [markdown]
# # 8. Extreme cases
#
# Meshes come in nanometres and light years, with faces thinner than a hair, boxes that touch, and planes seen edge-on.
# Image and gradient should be right there too. Here some such cases, against exact integrals in float64.
# `python -m benchmarks.stability` has some hundred.

# %%
import math
import sys

import matplotlib.pyplot as plt
import torch

import edgegrad as eg
from edgegrad.image import linear_to_srgb

sys.path.append("../tests")
from oracles.exact import exact_image

BACKGROUND = torch.tensor([0.12, 0.15, 0.2])
y, x = torch.meshgrid(torch.arange(48.0), torch.arange(48.0), indexing="ij")
WEIGHTS = (torch.sin(x / 7 + y / 11) + 0.3 * torch.cos(y / 5))[..., None] * torch.tensor([1.0, 0.7, 0.5])


def gradient(verts, scene, camera, how):
    """Of a weighted sum of the image, by vertices (V, 3)."""
    leaf = verts.clone().requires_grad_()
    image = how(scene(leaf), camera)
    return torch.autograd.grad((image * WEIGHTS.to(image)).sum(), leaf)[0].double()


def drawn(seeds, **options):
    return [lambda scene, camera, s=s: eg.render(scene, camera, 64, s, **options) for s in range(seeds)]


def mean_gradient(verts, scene, camera, seeds=8, samples=40_000):
    ways = drawn(seeds, sampling=eg.Sampling(surface=samples, edges=samples))
    return torch.stack([gradient(verts, scene, camera, way) for way in ways]).mean(0)


def off(found, exact):
    return ((found - exact).norm() / exact.norm()).item()


def show(images):
    fig, axes = plt.subplots(1, len(images), figsize=(2.2 * len(images), 2.5), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().float().clamp(0, 1)))
        axis.set_title(title, fontsize=9)
        axis.axis("off")
    plt.tight_layout()


worst = {}

# %% [markdown]
# ## Any scale
#
# A cube of size $s$, seen from $4 s$ away, looks the same for every $s$. The derivative by a vertex is that by pixels
# over $s$: so $s \cdot \partial\ell/\partial v$ must not depend on $s$. All in float32, whose numbers end at $3\cdot
# 10^{38}$.

# %%
signs = torch.tensor([[a, b, c] for a in (-1.0, 1.0) for b in (-1.0, 1.0) for c in (-1.0, 1.0)])
quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
faces = torch.tensor([[q[0], q[k], q[k + 1]] for q in quads for k in (1, 2)])
turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -0.5, 0.3], [0.5, 0.0, -0.4], [-0.3, 0.4, 0.0]]))
cube = 0.6 * signs @ turn.T
colors = 0.5 + 0.4 * torch.sin(2.0 * signs @ torch.tensor([[2.1, -0.9, 1.7], [0.7, 2.3, -1.9], [-1.3, 1.1, 0.6]]))
eye = torch.tensor([0.9, 0.6, 3.6])


def boxed(verts):
    return eg.Scene([eg.Mesh(verts, faces, colors=colors.to(verts))], background=BACKGROUND.to(verts))


def camera_at(scale, dtype=torch.float32):
    return eg.Camera.look_at(scale * eye.to(dtype), torch.zeros(3, dtype=dtype), (0.1, 1, 0), 30.0, (48, 48)).to(dtype)


exact = gradient(cube.double(), boxed, camera_at(1.0, torch.float64), exact_image)
scales = [1e-30, 1e-12, 1e-3, 1.0, 1e3, 1e12, 1e30]
for s in scales:
    worst[f"scale {s:.0e}"] = off(s * mean_gradient(s * cube, boxed, camera_at(s)), exact)
show({f"s = {s:.0e}": eg.render(boxed(s * cube), camera_at(s), spp=64) for s in scales[::2]})
print("\n".join(f"{name}: gradient {error:.2%} off" for name, error in worst.items()))

# %% [markdown]
# *What to see:* the same cube four times.
#
# ## Slivers
#
# A triangle 30 pixels long and from 3 to a thousandth of a pixel wide. The thinner it is, the less of the image's
# samples meet it, at last none at all. Edges are sampled by their length, and the gradient stays right; as the triangle
# shrinks, what its two long sides do cancels, and what is left is smaller.

# %%
camera = camera_at(1.0, torch.float64)


def unproject(pixels, depth):
    """World points at pixel positions and depths."""
    q = torch.cat([(pixels - camera.K[:2, 2]) / camera.K[0, 0], torch.ones_like(pixels[:, :1])], 1) * depth[:, None]
    R, t = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return (q - t) @ R


def flat(verts, color=(0.9, 0.5, 0.1)):
    mesh = eg.Mesh(verts, torch.tensor([[0, 1, 2]]), face_colors=torch.tensor([color], dtype=torch.float64))
    return eg.Scene([mesh], background=BACKGROUND.double())


pictures = {}
along = torch.tensor([math.cos(0.4), math.sin(0.4)], dtype=torch.float64)
across = torch.stack([-along[1], along[0]])
for width in (3.0, 0.3, 0.03, 0.001):
    middle = torch.tensor([23.3, 25.1], dtype=torch.float64)
    pixels = torch.stack(
        [middle - 15 * along - width / 2 * across, middle - 15 * along + width / 2 * across, middle + 15 * along]
    )
    sliver = unproject(pixels, torch.tensor([3.7, 3.7, 3.9], dtype=torch.float64))
    found = mean_gradient(sliver, flat, camera)
    worst[f"sliver {width:g} px"] = off(found, gradient(sliver, flat, camera, exact_image))
    pictures[f"{width:g} px wide"] = eg.render(flat(sliver), camera, spp=64)
    print(f"{width:5g} px wide: gradient {worst[f'sliver {width:g} px']:.1e} off")
show(pictures)

# %% [markdown]
# *What to see:* it fades, as it should: a pixel's share of it is what counts. The gradient is there to the last.
#
# ## Boxes that touch
#
# Two boxes side by side, with one side in common. Seen from the front there is a line where they meet. Each has an edge
# there, exactly on the other's. Moved together, nothing opens between them: the line moves as one edge between two
# colours, not as two silhouettes before the background.

# %%
shift = torch.tensor([0.6, 0.0, 0.0], dtype=torch.float64)
half = 0.3 * signs.double()
two = torch.cat([half - shift / 2, half + shift / 2])
sides = torch.rand((24, 3), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def touching(verts):
    boxes = [eg.Mesh(verts[8 * k : 8 * k + 8], faces, face_colors=sides[12 * k : 12 * k + 12]) for k in range(2)]
    return eg.Scene(boxes, background=BACKGROUND.double())


front = eg.Camera.look_at((0.4, 0.9, 4.0), (0, 0, 0), (0, 1, 0), 25.0, (48, 48)).to(torch.float64)


def moved(direction, seeds=8):
    """The derivative for moving both boxes along a direction, and by finite differences."""
    found = (mean_gradient(two, touching, front, seeds) * direction).sum().item()
    h = 0.01
    with torch.no_grad():
        losses = [
            sum(
                (eg.render(touching(two + s * h * direction), front, 1024, k) * WEIGHTS.double()).sum()
                for k in range(4)
            )
            / 4
            for s in (1, -1)
        ]
    return found, ((losses[0] - losses[1]) / (2 * h)).item()


show({"two boxes that touch": eg.render(touching(two), front, spp=256)})
for name, direction in (("right", (1.0, 0.0, 0.0)), ("up", (0.0, 1.0, 0.0)), ("near", (0.0, 0.0, 1.0))):
    found, fd = moved(torch.tensor(direction, dtype=torch.float64))
    worst[f"touching, {name}"] = abs(found / fd - 1)
    print(f"moved {name:5}: gradient {found:8.2f}, finite difference {fd:8.2f}")

# %% [markdown]
# *What to see:* no gap and no seam where the boxes meet.
#
# ## Seen at a grazing angle
#
# A plate that turns until it is edge-on. At a tenth of a degree it is a line far thinner than a pixel, and each of its
# points moves fast across the image as it turns.

# %%
plate = torch.tensor([[-0.7, 0.0, -0.7], [0.7, 0.0, -0.7], [0.7, 0.0, 0.7], [-0.7, 0.0, 0.7]], dtype=torch.float64)
checks = torch.tensor([[0.9, 0.6, 0.2], [0.2, 0.5, 0.9]], dtype=torch.float64)
level = eg.Camera.look_at((0.3, 0.0, 4.0), (0, 0, 0), (0, 1, 0), 30.0, (48, 48)).to(torch.float64)


def tilted(verts):
    mesh = eg.Mesh(verts, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=checks)
    return eg.Scene([mesh], background=BACKGROUND.double())


pictures = {}
for degrees in (30.0, 5.0, 1.0, 0.1):
    a = math.radians(degrees)
    R = torch.tensor([[1, 0, 0], [0, math.cos(a), -math.sin(a)], [0, math.sin(a), math.cos(a)]], dtype=torch.float64)
    verts = plate @ R.T + torch.tensor([0.0, 0.013, 0.0], dtype=torch.float64)
    name = f"{degrees:g}°"
    worst[f"grazing {name}"] = off(mean_gradient(verts, tilted, level), gradient(verts, tilted, level, exact_image))
    pictures[name] = eg.render(tilted(verts), level, spp=256)
    print(f"{name:>4} from edge-on: gradient {worst[f'grazing {name}']:.1e} off")
show(pictures)

# %% [markdown]
# *What to see:* the plate thins out to a line and then fades.
#
# What is known to be limited is listed in docs/limits.md: two finely detailed objects $10^5$ times their size apart in one
# scene, say.
#
# ## Check

# %%
for name, error in worst.items():
    assert error < 0.03, f"{name}: the gradient is {error:.1%} off"
