# %% [markdown]
# # 11. Things that bend
#
# A *rig* is a differentiable function from few numbers to meshes: a skinned character, a body model, a robot. `eg.rig.load` reads
# one from a glTF file, `Rig.from_function` takes any function, `eg.rig.load` a URDF. Here a body of twenty joints is made from
# arrays, bent, and its pose found again from four silhouettes.
#
# It needs `pip install '.[rigs]'`, and a clone of the repository for the body of `examples/figure.py`.

# %%
import sys

import matplotlib.pyplot as plt
import torch

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_rig, track_rig
from edgegrad.image import linear_to_srgb

sys.path.append("../examples")
import body
import figure

WHITE = torch.ones(3)


def show(**images):
    fig, axes = plt.subplots(1, len(images), figsize=(2.6 * len(images), 2.7), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)), cmap="gray")
        axis.set_title(title.replace("_", " "), fontsize=10)
        axis.axis("off")
    plt.tight_layout()


# %% [markdown]
# ## Bending
#
# Rotations are about each joint's own axes, from rest: rotation vectors in radians, quaternions or matrices, all of them or
# some by name.

# %%
rig = figure.figure(colored=True)
print(rig)
camera = figure.cameras(160)[0]
bends = {
    "rest": {},
    "arms": {"left arm": [0.0, 0.0, 0.9], "right arm": [0.0, 0.0, -0.9]},
    "and_a_knee": {
        "left arm": [0.0, 0.0, 0.9],
        "right arm": [0.0, 0.0, -0.9],
        "left hip": [-0.9, 0, 0],
        "left knee": [1.2, 0, 0],
    },
}
show(**{name: eg.render(eg.Scene(rig.posed(bend), background=WHITE), camera, 32) for name, bend in bends.items()})

# %% [markdown]
# *What to see:* limbs stay whole where they bend, since their vertices hang on both bones.
#
# ## Gradients
#
# Whatever a pose is given may require a gradient. Here: how the silhouette's area changes with the angle of the left elbow,
# against a finite difference.

# %%
angle = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)


def area(angle, spp=64, **options):
    bent = rig.posed({"left elbow": torch.stack([angle, 0 * angle, 0 * angle])})
    return eg.render_aovs(bent, camera, ["alpha"], spp=spp, **options)["alpha"].sum()


area(angle).backward()
with torch.no_grad():
    h = 0.02
    slope = float(area(angle + h, 1024) - area(angle - h, 1024)) / (2 * h)
print(f"gradient {angle.grad:.1f}, finite difference {slope:.1f} pixels per radian")

# %% [markdown]
# ## A pose from four silhouettes
#
# Each joint is rotated by up to 40° about a random axis. From rest, `fit_rig` goes from coarse pictures to fine ones. A
# silhouette does not say which limb it shows, so a descent may end with a leg in the other's place: limbs are drawn anew
# where pixels are off, until the masks are explained.

# %%
rig = rig.with_limits(rotations=(-0.75, 0.75))
cameras = figure.cameras(128)
truth = figure.pose(3)
masks = [eg.render_aovs(rig.posed(truth), camera, ["alpha"], spp=64)["alpha"] for camera in cameras]
fit = fit_rig(rig, None, cameras, masks=masks, options=FitOptions(seed=0, progress=False))
print(f"{fit.reason}; explained: {fit.fit.explained:.2f}")
errors = body.Errors.of(rig, fit.values["rotations"], truth)
print(errors)
for k in (0, 1):
    seen = {"true pose": rig.posed(truth), "start": rig.posed(), "fit": fit.posed()}
    pictures = {name: eg.render(eg.Scene(mesh, background=WHITE), cameras[k], 32) for name, mesh in seen.items()}
    show(mask=masks[k][..., 0], **pictures)

# %% [markdown]
# *What to see:* the start shares little with the masks, and the fit is the true pose. The least certain numbers are twists of
# round limbs about their own axes: where two joints share one, no silhouette says how. The directions in which limbs point are
# right to a part of a degree.
#
# ## A sequence
#
# `track_rig` follows a motion: each frame begins where the last one led.

# %%
frames, poses = [], [truth * (1.0 - 0.06 * k) for k in range(4)]
small = figure.cameras(96)
for pose in poses:
    frames.append({"masks": [eg.render_aovs(rig.posed(pose), one, ["alpha"], spp=32)["alpha"] for one in small]})
start = {"rotations": fit.values["rotations"]}
options = FitOptions(seed=0, progress=False)
for pose, found in zip(poses, track_rig(rig, frames, small, init=start, search=0, options=options)):
    print(body.Errors.of(rig, found.values["rotations"], pose))

# %% [markdown]
# ## Check

# %%
assert fit.converged
assert errors.direction.median() < 0.5 and errors.direction.quantile(0.9) < 2.0 and errors.rotation.median() < 2.0
assert abs(float(angle.grad) - slope) < 0.1 * abs(slope)
