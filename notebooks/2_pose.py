# %% [markdown]
# # 2. A pose from one picture
#
# Where is a known object, and how is it rotated? Render it where it might be, compare with the picture, and follow the
# gradient. This notebook does so by hand in a dozen lines, and then by `fit_pose`, which starts from further away and
# lets something stand before the object.

# %%
import math

import matplotlib.pyplot as plt
import roma  # rotations
import torch
import trimesh

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_pose
from edgegrad.image import linear_to_srgb


def show(**images):
    fig, axes = plt.subplots(1, len(images), figsize=(2.5 * len(images), 2.8), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)))
        axis.set_title(title.replace("_", " "), fontsize=10)
        axis.axis("off")
    plt.tight_layout()


# %% [markdown]
# ## An object, a camera, a picture
#
# A bumpy stone with colours. The object is known; the pose that made the picture is not: a rotation by 20° and a shift.

# %%
ball = trimesh.creation.icosphere(subdivisions=4)
n = torch.tensor(ball.vertices, dtype=torch.float32)
waves = torch.tensor([[2.1, 0.3, 1.2], [-0.7, 2.6, 0.4], [0.9, -1.5, 2.3]])
verts = n * (1 + 0.12 * torch.sin(n @ waves.T).sum(1, keepdim=True)) * torch.tensor([1.0, 0.7, 0.8])
colors = torch.tensor([0.55, 0.4, 0.3]) + 0.25 * torch.sin(3 * n @ waves + torch.tensor([0.0, 0.8, 1.6]))
stone = eg.Mesh(verts, torch.tensor(ball.faces), colors=colors)
behind = torch.tensor([0.1, 0.15, 0.25])
camera = eg.Camera.look_at(eye=(0.5, 0.8, 4.0), target=(0, 0, 0), up=(0, 1, 0), fov_y=40, size=(96, 96))

true_w = torch.tensor([0.16, -0.25, 0.18])  # a rotation vector: axis times angle
true_t = torch.tensor([0.12, -0.08, 0.1])


def posed(w, t):
    return eg.Scene(stone.transformed(roma.rotvec_to_rotmat(w), t), background=behind)


with torch.no_grad():
    target = eg.render(posed(true_w, true_t), camera, spp=256, seed=12345)
    start = eg.render(posed(torch.zeros(3), torch.zeros(3)), camera, spp=256)
show(picture=target, start=start, difference=0.5 + target - start)

# %% [markdown]
# *What to see:* inside, colours differ; along the outline, stone and background have changed places. There the
# boundary term works, and much of what shows the pose is there.
#
# ## The slope of the loss
#
# The loss is the mean squared difference. Along one coordinate, the shift to the right, it can be drawn. Its slope, by
# the gradient with and without the boundary term, is drawn into it. To see what the outline does alone, the stone is
# plain white for this.

# %%
white = eg.Mesh(verts, stone.faces, colors=torch.full_like(verts, 0.9))


def plain(x):
    return eg.Scene(white.transformed(t=torch.stack([x, x.new_zeros(()), x.new_zeros(())])), background=behind)


with torch.no_grad():
    white_target = eg.render(plain(torch.tensor(0.2)), camera, spp=256)


def loss(x, spp=64, **options):
    return (eg.render(plain(x), camera, spp, **options) - white_target).square().mean()


def slope(x, **options):
    x = x.clone().requires_grad_()
    return torch.autograd.grad(loss(x, sampling=eg.Sampling(edges=20_000), **options), x)[0]


xs = torch.linspace(-0.1, 0.45, 23)
places, h = xs[2:-1:4], 0.004  # an eighth of a pixel: near its minimum the loss is curved
with torch.no_grad():
    values = torch.stack([loss(x) for x in xs])
    differences = torch.stack([(loss(x + h, 1024) - loss(x - h, 1024)) / (2 * h) for x in places])
slopes = torch.stack([slope(x) for x in places])
slopes_without = torch.stack([slope(x, visibility=False) for x in places])

plt.figure(figsize=(6, 3))
plt.plot(xs, values, color="0.75", linewidth=4, label="loss")
styles = {"slope by the gradient": (slopes, "tab:red"), "without the boundary term": (slopes_without, "tab:blue")}
for label, (by, color) in styles.items():
    for k, x in enumerate(places):
        with torch.no_grad():
            height = loss(x)
        ends = torch.stack([x - 0.04, x + 0.04])
        plt.plot(ends, height + by[k] * (ends - x), color=color, linewidth=1.5, label=label if k == 0 else None)
plt.xlabel("shift to the right")
plt.legend(frameon=False)
plt.tight_layout()
slope_error = (slopes - differences).norm() / differences.norm()
print(
    f"off the finite differences: {slope_error:.2%} with the boundary term, "
    f"{(slopes_without - differences).norm() / differences.norm():.0%} without"
)

# %% [markdown]
# *What to see:* the red slopes are tangents of the loss. The blue ones are flat: inside a face of one colour nothing
# changes, so without the boundary term there is no gradient at all.
#
# ## By hand
#
# Adam finds a rotation vector and a translation. Each step draws new samples, so that the error of few samples averages
# out.

# %%
w, t = torch.zeros(3, requires_grad=True), torch.zeros(3, requires_grad=True)
optimizer = torch.optim.Adam([w, t], lr=0.02)
schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.98)
losses, turned = [], []
for _ in range(140):
    optimizer.zero_grad()
    value = (eg.render(posed(w, t), camera, spp=4) - target).square().mean()
    value.backward()
    optimizer.step()
    schedule.step()
    losses.append(value.item())
    turned.append(math.degrees(roma.rotvec_geodesic_distance(w.detach(), true_w)))

fig, axes = plt.subplots(1, 2, figsize=(8, 2.6))
for axis, curve, title in zip(axes, (losses, turned), ("loss", "rotation off by, degrees")):
    axis.semilogy(curve)
    axis.set_title(title, fontsize=10)
    axis.set_xlabel("step")
plt.tight_layout()
by_hand = turned[-1]
print(f"rotation off by {by_hand:.3f}°, translation by {(t.detach() - true_t).norm():.4f}")

# %% [markdown]
# *What to see:* the loss ends at the noise of four samples a pixel, and goes no lower. The pose goes on improving, since
# the gradient is right on average.
#
# ## In one call
#
# `fit_pose` does this from coarse to fine, with steps that know the curvature (Gauss–Newton). It says whether it
# believes what it found.

# %%
fit = fit_pose(eg.Scene([stone], behind), target, camera, options=FitOptions(seed=0, progress=False))
print(f"{fit.reason} after {fit.steps} steps in {fit.seconds:.1f} s")
print(
    f"rotation off by {math.degrees(roma.rotmat_geodesic_distance(fit.R.float(), roma.rotvec_to_rotmat(true_w))):.3f}°"
)
fit.plot()

# %% [markdown]
# *What to see:* the last picture is the difference that is left, brightened: noise, most of it at edges.
#
# ## Something stands before it
#
# A striped board covers a part of the stone, which the fit does not know. A squared loss would follow the board.
# `fit_pose` counts a pixel that is far off no more than one that is a tenth of the picture's range off.

# %%
y, x = torch.meshgrid(torch.arange(96), torch.arange(96), indexing="ij")
board = (x + 0.4 * y < 55)[..., None] & (x > 12)[..., None]
stripes = torch.where(y[..., None] // 6 % 2 == 0, 0.8, 0.05).expand(96, 96, 3)
covered_target = torch.where(board, stripes, target)
covered = fit_pose(eg.Scene([stone], behind), covered_target, camera, options=FitOptions(seed=0, progress=False))
off = math.degrees(roma.rotmat_geodesic_distance(covered.R.float(), roma.rotvec_to_rotmat(true_w)))
alpha = eg.render_aovs(posed(true_w, true_t), camera, ["alpha"])["alpha"] > 0.5
print(
    f"{(board & alpha).sum() / alpha.sum():.0%} of the stone is covered; rotation off by {off:.2f}°; {covered.reason}"
)
print(f"the picture shows {covered.explained:.0%} of the render's edges")
show(picture=covered_target, fit=eg.render(stone.transformed(covered.R.float(), covered.t.float()), camera, spp=64))

# %% [markdown]
# *What to see:* the stone lies where its visible part says. `explained` is the share of the render's edges that the
# picture shows too: what is behind the board cannot be among them.
#
# From the shell, with your own files: `edgegrad fit-pose model.glb photo.png --fov 40 --out fit/`. `examples/pose.py`
# counts how many of many random starts succeed.
#
# ## Check

# %%
assert slope_error < 0.02, "the gradient is the slope of the loss"
assert slopes_without.norm() < 0.1 * differences.norm()
assert by_hand < 0.3 and (t.detach() - true_t).norm() < 0.02
assert fit.converged and off < 1.0
