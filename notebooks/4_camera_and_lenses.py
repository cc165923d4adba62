# %% [markdown]
# # 4. Cameras and lenses
#
# This notebook shows the kinds of camera, how an image changes with the lens, and how focal length, pose and distortion
# are found from one picture.

# %%
import math

import matplotlib.pyplot as plt
import torch
import trimesh

import edgegrad as eg
from edgegrad.fit import FitOptions, fit_camera
from edgegrad.image import linear_to_srgb


def show(images, width=2.3, **options):
    fig, axes = plt.subplots(1, len(images), figsize=(width * len(images), 2.6), squeeze=False)
    for axis, (title, image) in zip(axes[0], images.items()):
        axis.imshow(linear_to_srgb(image.detach().clamp(0, 1)) if image.dim() == 3 else image, **options)
        axis.set_title(title, fontsize=10)
        axis.axis("off")
    plt.tight_layout()


# %% [markdown]
# ## A small town
#
# Boxes of several heights on a chequered ground, z up. A colour for each face, no lights.

# %%
meshes = []
generator = torch.Generator().manual_seed(3)
for i in range(-3, 4):
    for j in range(-3, 4):
        height = 0.2 + 0.9 * torch.rand((), generator=generator).item()
        if (i, j) == (0, 0):
            continue  # here the panorama will stand
        box = trimesh.creation.box((0.55, 0.55, height), trimesh.transformations.translation_matrix((i, j, height / 2)))
        shade = torch.tensor([[1.0], [0.75], [0.55]])[torch.tensor(abs(box.face_normals)).argmax(1)]
        colors = shade * (0.2 + 0.7 * torch.rand(3, generator=generator))
        meshes.append(eg.Mesh(torch.tensor(box.vertices).float(), torch.tensor(box.faces), face_colors=colors))
ground = torch.tensor([[x, y, 0.0] for y in range(-4, 5) for x in range(-4, 5)])
cell = torch.tensor([[0, 1, 10], [0, 10, 9]])
faces = torch.cat([cell + 9 * y + x for y in range(8) for x in range(8)])
tiles = torch.tensor([[(x + y) % 2] * 2 for y in range(8) for x in range(8)]).reshape(-1, 1)
meshes.append(eg.Mesh(ground, faces, face_colors=0.35 + 0.25 * tiles.expand(-1, 3)))
town = eg.Scene(meshes, background=torch.tensor([0.55, 0.7, 0.9]))

# %% [markdown]
# ## Five ways to look at it
#
# A point $q = Rp + t$ in the camera's axes (x right, y down, z forward) goes to the pixel
#
# | | $(x, y) = K\,(m, 1)$ with |
# |---|---|
# | perspective | $m = (q_x/q_z,\; q_y/q_z)$ |
# | with distortion | the same, distorted: $m\,(1 + k_1 r^2 + k_2 r^4 + \dots)$, $r = |m|$ (Brown–Conrady, as OpenCV) |
# | fisheye | $|m|$ is the angle to the axis, up to all around |
# | panorama | longitude and latitude |
# | orthographic | $m = (q_x, q_y)$ |

# %%
size = (96, 96)
eye = (3.2, -5.5, 4.2)
perspective = eg.Camera.look_at(eye, (0, 0, 0.2), (0, 0, 1), 55.0, size)
W, K = perspective.world_to_camera, perspective.K
inside = eg.Camera.look_at((0, 0, 0.6), (1, 2, 0.6), (0, 0, 1), 60.0, size)
overhead = eg.Camera.look_at((0, 0, 2.2), (0, 0.01, 0), (0, 1, 0), 60.0, size)
wide = torch.tensor([[30.0, 0, 48], [0, 30.0, 48], [0, 0, 1]])
views = {
    "perspective": perspective,
    "barrel distortion": perspective.replace(distortion=torch.tensor([-0.28, 0.06, 0.0, 0.0])),
    "fisheye, from above": eg.Camera(overhead.world_to_camera, wide, size, "fisheye"),
    "orthographic": eg.Camera.orthographic(eye, (0, 0, 0.2), (0, 0, 1), 6.5, size),
}
with torch.no_grad():
    show({name: eg.render(town, camera, spp=64) for name, camera in views.items()})
    show({"panorama": eg.render(town, eg.Camera.panorama(inside.world_to_camera, (96, 192)), spp=64)}, 5.2)

# %% [markdown]
# *What to see:* straight edges stay straight in the perspective, bulge through the distorting lens, and become curves
# in fisheye and panorama. In the orthographic picture parallel edges stay parallel. Where the lens makes edges curves in
# the image, edgegrad samples those curves, not their chords.
#
# ## How an image changes with the lens
#
# `eg.jvp` gives every pixel's derivative by the focal length and by the first coefficient of distortion, in one pass;
# next to them are the same by finite differences.

# %%
lens = views["barrel distortion"]
zoom = torch.diag(torch.tensor([1.0, 1.0, 0.0]))  # of fx and fy, a pixel each
k1 = torch.tensor([1.0, 0.0, 0.0, 0.0])
tangents = {
    lens.K: torch.stack([zoom, torch.zeros(3, 3)]),
    lens.distortion: torch.stack([torch.zeros(4), k1]),
}
_, (by_focal, by_k1) = eg.jvp(town, lens, tangents, spp=64)


def difference(h, **fields):
    high, low = (
        eg.render(town, lens.replace(**{name: getattr(lens, name) + s * h * d for name, d in fields.items()}), 256)
        for s in (1, -1)
    )
    return (high - low) / (2 * h)


focal_fd, k1_fd = difference(0.5, K=zoom), difference(0.01, distortion=k1)
signed = {"by the focal length": 2 * by_focal, "by finite differences": 2 * focal_fd}
signed |= {"by distortion k1": by_k1 / 8, "by finite differences ": k1_fd / 8}
show({name: values.sum(-1) for name, values in signed.items()}, cmap="RdBu_r", vmin=-1, vmax=1)


def blocks(image):
    """Sums over 16 × 16 pixels, in which noise averages out."""
    return image.reshape(6, 16, 6, 16, 3).sum((1, 3))


def ratio(a, b):
    """The factor c by which c b comes closest to a."""
    return ((blocks(a) * blocks(b)).sum() / blocks(b).square().sum()).item()


ratios = ratio(by_focal, focal_fd), ratio(by_k1, k1_fd)
print(f"gradient over finite difference: focal length {ratios[0]:.3f}, k1 {ratios[1]:.3f}")

# %% [markdown]
# *What to see:* both change the image most far from the middle; distortion, by $r^3$, almost only there. Edges stand
# out against faces, whose one colour does not change.
#
# ## Focal length, pose and distortion from one picture
#
# Given the town, where was this picture taken, and through which lens? The start has a focal length 10 % off, stands
# elsewhere, and knows no distortion.

# %%
taken = eg.Camera.look_at((3.0, -5.2, 4.0), (0.1, 0.1, 0.2), (0.05, 0, 1), 50.0, size).replace(
    distortion=torch.tensor([-0.15, 0.02, 0.0, 0.0])
)
with torch.no_grad():
    picture = eg.render(town, taken, spp=256, seed=7)
first = eg.Camera.look_at((3.4, -5.4, 3.8), (0.0, 0.0, 0.2), (0, 0, 1), 55.0, size)
fit = fit_camera(town, picture, first, distortion=4, options=FitOptions(seed=0, progress=False))
print(fit.reason)


def report(name, camera):
    f, k1 = camera.K[0, 0].item(), 0.0 if camera.distortion is None else camera.distortion[0].item()
    off = math.dist(camera.eye.tolist(), taken.eye.tolist())
    print(f"{name:6} focal length {f:7.2f} px, k1 {k1:+.3f}, the eye {off:.3f} units off")
    return f


focal_true, _, focal = report("true", taken), report("start", first), report("found", fit.camera)
fit.plot()

# %% [markdown]
# *What to see:* left to right the picture, the start, the fit, and the difference, brightened: noise at edges is left.
# The coefficients share the work: a little less $k_1$ and more $k_2$ distort this picture alike. Perspective separates
# focal length from distance here, since the town is deep; of a flat or distant object one picture cannot.
#
# Cameras of other libraries come in by `Camera.from_opencv`, `from_colmap`, `from_opengl`, `from_pytorch3d`,
# `from_projection`, and whole reconstructions by `eg.load_cameras`.
#
# ## Check

# %%
assert all(abs(ratio - 1) < 0.03 for ratio in ratios), "the gradient by the lens is that of the image"
assert abs(focal / focal_true - 1) < 0.01 and math.dist(fit.camera.eye.tolist(), taken.eye.tolist()) < 0.03
