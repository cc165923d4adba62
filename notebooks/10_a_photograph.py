# %% [markdown]
# # 10. A cup from one photograph
#
# A real photograph: no mask, no calibration, light that nobody knows, a glossy cup. What is known is the kind of thing: a
# cup on a saucer, both solids of revolution about one axis. `fit_scene(loss="region")` finds their shape and pose from the
# colours alone: those inside the silhouette against those around it, counted near the contour.
#
# The photograph is `coffee` of [scikit-image](https://scikit-image.org), by Rachel Michetti, courtesy of Pikolo Espresso
# Bar; CC0, no copyright restrictions.

# %%
import math

import matplotlib.pyplot as plt
import skimage.data
import torch
import torch.nn.functional as F

import edgegrad as eg
from edgegrad.fit import FitOptions, Parameter, PoseParameter, fit_scene
from edgegrad.image import linear_to_srgb, srgb_to_linear

photo = srgb_to_linear(torch.tensor(skimage.data.coffee() / 255.0).float())
H, W = photo.shape[:2]


def show(**images):
    fig, axes = plt.subplots(1, len(images), figsize=(3.6 * len(images), 2.7), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)))
        axis.set_title(title.replace("_", " "), fontsize=10)
        axis.axis("off")
    plt.tight_layout()


def outlined(alpha, image, color=(1.0, 0.8, 0.0)):
    rim = F.max_pool2d(alpha.movedim(-1, 0), 3, 1, 1).movedim(0, -1) - alpha > 0.3
    return torch.where(rim, torch.tensor(color), image)


# %% [markdown]
# ## What is unknown
#
# Profiles are rotated about the z axis. The saucer's radius is the unit of length, since a photograph does not show sizes.
# Four numbers are free: how high the saucer's rim lies; the radius of the cup's rim, its height and its foot.

# %%
AROUND = 96
angle = torch.arange(AROUND) * (2 * math.pi / AROUND)
circle = torch.stack([angle.cos(), angle.sin()], -1)


def turned(profile):
    """A mesh from radii and heights, numbers or tensors, from axis to axis."""
    r, z = (torch.stack([torch.as_tensor(row[i], dtype=torch.float32) for row in profile]) for i in (0, 1))
    verts = torch.cat([r[:, None, None] * circle, z[:, None, None].expand(-1, AROUND, 1)], -1).reshape(-1, 3)
    row, k = torch.meshgrid(torch.arange(len(r) - 1) * AROUND, torch.arange(AROUND), indexing="ij")
    a, b = row + k, row + (k + 1) % AROUND
    faces = torch.stack([torch.stack([a, b, b + AROUND], -1), torch.stack([a, b + AROUND, a + AROUND], -1)], 2)
    return eg.Mesh(verts, faces.reshape(-1, 3))


def saucer_and_cup(values):
    rise = values["saucer"]
    rim, height, foot = values["cup"]
    saucer = [(0.001, 0), (0.55, 0), (1, rise), (0.97, rise + 0.02), (0.5, 0.03), (0.001, 0.03)]
    belly, coffee = 0.56 * (foot + rim), 0.6 * height
    cup = [(0.001, 0.03), (foot, 0.03), (belly, 0.45 * height), (rim, height)]
    cup += [(0.88 * rim, height), (0.85 * rim, coffee), (0.001, coffee)]
    return [turned(saucer), turned(cup)]


def scene(values):
    pose = values["pose"]
    return eg.Scene([mesh.transformed(pose.R, pose.t) for mesh in saucer_and_cup(values)])


# %% [markdown]
# ## Where it starts
#
# By eye: seen from about 45° above, the saucer about 200 pixels in radius, in the middle of the lower half. The file does
# not say with which lens the photograph was taken; 1.2 image widths of focal length, that of a normal lens, is assumed.

# %%
focal = 1.2 * W
K = torch.tensor([[focal, 0.0, W / 2], [0.0, focal, H / 2], [0.0, 0.0, 1.0]])
camera = eg.Camera.from_opencv(torch.eye(3), torch.zeros(3), K, (H, W))  # x right, y down, z forward

tilt = math.radians(45)
up = torch.tensor([0.0, -math.cos(tilt), -math.sin(tilt)])  # of the cup, as the camera has it
right = torch.tensor([1.0, 0.0, 0.0])
R = torch.stack([right, torch.linalg.cross(up, right), up], 1)
distance = focal / 200
t = distance * torch.tensor([(280 - W / 2) / focal, (235 - H / 2) / focal, 1.0])

start = {"saucer": torch.tensor(0.15), "cup": torch.tensor([0.55, 0.95, 0.35])}

# %% [markdown]
# ## The fit
#
# Adam on the loss $-\log(\alpha P + (1-\alpha)(1-P))$: $\alpha$ is what the render covers of a pixel, $P$ what its colour
# says. The edges of $\alpha$ have exact gradients, so ten numbers are enough to bring outline and photograph together.


# %%
def fitted(camera, R, t, shape, **options):
    pose = PoseParameter((R, t), of=eg.Scene(saucer_and_cup(shape)), rotation=0.01, shift=0.005)
    free = {name: Parameter(0.01, value, low=0.02, high=1.2) for name, value in shape.items()}
    given = {"pose": pose, **free}
    return fit_scene(
        scene,
        photo,
        camera,
        given,
        options=FitOptions(seed=0, loss="region", spp=4, steps=150, loss_tolerance=1e-3, progress=False, **options),
    )


early = {}


def keep(progress):
    if progress.step == 8:
        early["scene"] = progress.scene


fit = fitted(camera, R, t, start, callback=keep)
print(f"{fit.reason} after {fit.steps} steps; explained: {fit.explained:.2f} (0.6 is enough)")
outlines = {"start": fit.start, "after_9_steps": early["scene"], "fit": fit.scene}
show(**{name: outlined(eg.render_aovs(one, camera, ["alpha"])["alpha"], photo) for name, one in outlines.items()})
close = outlined(fit.render(), photo)
show(left=close[30:180, 80:280], top=close[:150, 170:370], right=close[90:240, 300:500])

# %% [markdown]
# *What to see:* the yellow line lies on the rims of saucer and cup, to a pixel or two. It passes the spoon, which is no part
# of the model, and the shadow on the wood: few pixels do not move a whole curve.
#
# ## From another side
#
# A shader paints the surface with the photograph: each point is looked up where the camera saw it. What it did not see
# stays grey.

# %%
solid = fit.scene
eye = torch.zeros(3)  # of the camera


def from_photo(hits):
    seen = camera.project(hits.position) / torch.tensor([W, H]) * 2 - 1
    color = F.grid_sample(photo.movedim(-1, 0)[None], seen[None, None], align_corners=False)[0, :, 0].T
    facing = ((eye - hits.position) * hits.normal).sum(-1) > 0
    inside = (seen.abs() <= 1).all(-1)
    return torch.where((hits.visible(eye) & facing & inside)[:, None], color, torch.tensor(0.25))


pose = fit.poses["pose"]
up, middle = pose.R[:, 2], pose.t + 0.3 * pose.R[:, 2]
views = {}
for name, degrees, height in (("from_the_camera", 0, None), ("lower", 25, 1.3), ("from_the_other_side", 150, 2.0)):
    if height is None:
        views[name] = camera
        continue
    back = eye.double() - middle
    back = torch.nn.functional.normalize(back - up * (back @ up), dim=0)
    aside = math.cos(math.radians(degrees)) * back + math.sin(math.radians(degrees)) * torch.linalg.cross(up, back)
    views[name] = eg.Camera.look_at(middle + 3.2 * aside + height * up, middle, up, fov_y=40, size=(H, W))
show(
    **{
        name: eg.render(solid.replace(background=torch.ones(3)), view, 16, shader=from_photo)
        for name, view in views.items()
    }
)

# %% [markdown]
# *What to see:* handle and spoon lie painted on the saucer, since the model lacks them, and behind the cup nothing is known.
#
# ## What one photograph does not show
#
# - **Size**: all lengths are in radii of the saucer.
# - **The rotation about the axis** of a solid of revolution: that of the pose is where it started.
# - **What the outline does not touch**: the cup's foot, the level of the coffee, the saucer's underside.
# - **The lens**: with another focal length all else changes a little, and the outline hardly. This can be measured: the same
#   fit with a lens that is 1.3 times as long, from as much farther away.

# %%
lens = K * torch.tensor([[1.3, 1.0, 1.0], [1.0, 1.3, 1.0], [1.0, 1.0, 1.0]])
shape = {name: fit.values[name] for name in start}
other = fitted(camera.replace(K=lens), pose.R, pose.t * torch.tensor([1.0, 1.0, 1.3]), shape)
for length, one in ((focal, fit), (1.3 * focal, other)):
    pose, (rim, height, foot) = one.poses["pose"], one.values["cup"]
    elevation = math.degrees(math.asin(-float(F.normalize(pose.t, dim=0) @ pose.R[:, 2])))
    print(f"focal length {length:.0f} px: distance {pose.t.norm():.2f}, {elevation:.0f}° above the table, ", end="")
    print(f"the cup's rim {rim:.2f}, its height {height:.2f}; explained {one.explained:.2f}")

# %% [markdown]
# *What to see:* both outlines fit. Calibrate the camera, or take a second photograph.
#
# ## Check

# %%
assert fit.converged
rim, height = (float(number) for number in fit.values["cup"][:2])
assert abs(rim - 0.48) < 0.03 and abs(height - 0.93) < 0.06
assert abs(other.explained - fit.explained) < 0.1  # so the outline does not separate the two
