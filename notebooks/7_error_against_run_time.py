# %% [markdown]
# # 7. Error against run time
#
# A gradient from samples has an error. More samples, less error, more time. How much of one for how much of the other?
# This notebook measures it by hand on a triangle, whose exact gradient is known. Then it runs a small version of
# `python -m benchmarks.error_time`, next to finite differences, and Mitsuba 3 where it is installed.

# %%
import contextlib
import io
import sys
import tempfile
import time
from pathlib import Path

import matplotlib.pyplot as plt
import torch

import edgegrad as eg

sys.path += ["..", "../tests"]
from oracles.exact import exact_image

from benchmarks.error_time.run import error_time

# %% [markdown]
# ## The exact gradient
#
# The image of a few flat triangles has a formula: what is visible of a face in a pixel is a polygon, and radiance is
# integrated over it. All is in float64, and automatic differentiation of the formula is the exact gradient, boundary
# term included.

# %%
verts = torch.tensor([[-0.8, -0.6, 0.2], [0.9, -0.4, -0.3], [0.1, 0.8, 0.1]], dtype=torch.float64)
before = torch.tensor([[-0.3, -0.9, 0.9], [0.9, 0.2, 0.8], [-0.4, 0.5, 1.0]], dtype=torch.float64)  # hides a part
colors = torch.tensor([[0.9, 0.3, 0.1], [0.9, 0.8, 0.2], [0.3, 0.5, 0.9]], dtype=torch.float64)
face = torch.tensor([[0, 1, 2]])
other = eg.Mesh(before, face, colors=colors.flip(0))
camera = eg.Camera.look_at((0.3, 0.2, 4.0), (0, 0, 0), (0, 1, 0), 36.0, (64, 64)).to(torch.float64)
y, x = torch.meshgrid(torch.arange(64.0), torch.arange(64.0), indexing="ij")
weights = (torch.sin(x / 12 + y / 9) + 0.3)[..., None].double()


def scene(verts):
    return eg.Scene([eg.Mesh(verts, face, colors=colors), other], background=torch.tensor([0.06, 0.07, 0.1]).double())


leaf = verts.clone().requires_grad_()
(exact,) = torch.autograd.grad((exact_image(scene(leaf), camera) * weights).sum(), leaf)


def estimate(surface, edge, seed, **options):
    leaf = verts.clone().requires_grad_()
    image = eg.render(scene(leaf), camera, seed=seed, sampling=eg.Sampling(surface=surface, edges=edge), **options)
    return torch.autograd.grad((image * weights).sum(), leaf)[0]


def error(surface, edge, seeds=16):
    """Relative, root mean square over the seeds; and the seconds of one."""
    began = time.perf_counter()
    found = torch.stack([estimate(surface, edge, seed) for seed in range(seeds)])
    seconds = (time.perf_counter() - began) / seeds
    return ((found - exact).square().sum((1, 2)).mean().sqrt() / exact.norm()).item(), seconds


# %% [markdown]
# ## More samples
#
# Surface samples and edge samples are counted separately. Here each is varied with the other one large.

# %%
counts = [64, 256, 1024, 4096, 16384]
many = 1_000_000
of_surface = [error(n, many // 4, seeds=6)[0] for n in counts]
of_edges = [error(many, n, seeds=6)[0] for n in counts]
plt.figure(figsize=(5, 3.2))
plt.loglog(counts, of_edges, "o-", color="tab:red", label="edge samples")
plt.loglog(counts, of_surface, "o-", color="tab:blue", label="surface samples")
plt.loglog(counts, [of_surface[0] * (counts[0] / n) ** 0.5 for n in counts], ":", color="0.5", label="$N^{-1/2}$")
plt.loglog(counts, [of_edges[0] * counts[0] / n for n in counts], "--", color="0.5", label="$N^{-1}$")
plt.xlabel("samples")
plt.ylabel("relative error")
plt.legend(frameon=False, fontsize=8)
plt.tight_layout()

# %% [markdown]
# *What to see:* random samples would follow the dotted line: four times as many for half the error. The samples here
# are spread evenly (stratified) along edges and over surfaces, and do better: on the edges, which are curves, about
# four times as many for a quarter.
#
# ## Is it unbiased?
#
# The mean over many seeds must come as near to the exact gradient as its standard error allows. Without the boundary
# term it does not.

# %%
runs = torch.stack([estimate(500, 500, seed) for seed in range(200)])
mean, deviation = runs.mean(0), runs.std(0) / 200**0.5
z = (mean - exact) / deviation
inside = torch.stack([estimate(2000, 1, seed, visibility=False) for seed in range(20)]).mean(0)
print("exact     ", exact.reshape(-1).numpy().round(2))
print("mean      ", mean.reshape(-1).numpy().round(2))
print("in standard errors off:", z.reshape(-1).numpy().round(1))
print(f"without the boundary term: {(inside - exact).norm() / exact.norm():.0%} off, however many samples")

# %% [markdown]
# ## The report, in small
#
# It has three scenes, several methods, and a few numbers of samples each. The time is that of a whole step: update, image,
# backward pass. The error is that of the derivatives by a translation of the whole scene. Finite differences take
# twelve images for translation and rotation; the other methods give the gradient of every vertex besides.

# %%
with (
    tempfile.TemporaryDirectory() as folder,
    contextlib.redirect_stdout(io.StringIO()),
    contextlib.redirect_stderr(io.StringIO()),
):
    document, _ = error_time(Path(folder), ["triangle", "slivers", "sphere"], size=64, seeds=3, quick=True)

names = {
    "edgegrad": ("edgegrad", "tab:red"),
    "finite-differences": ("finite differences", "0.4"),
    "direct_projective": ("Mitsuba direct_projective", "tab:blue"),
    "prb_projective": ("Mitsuba prb_projective", "tab:cyan"),
}
fig, axes = plt.subplots(1, 3, figsize=(8, 3), sharex=True, sharey=True)
for axis, of in zip(axes, ("triangle", "slivers", "sphere")):
    for name, (label, color) in names.items():
        points = [p for p in document["points"] if (p["scene"], p["method"]) == (of, name)]
        points.sort(key=lambda p: p["budget"])
        if points:
            errors = [p["metrics"]["translation"]["error"] for p in points]
            axis.loglog([1e3 * p["seconds"] for p in points], errors, "o-", color=color, label=label)
    axis.set_title(of, fontsize=10)
    axis.set_xlabel("milliseconds")
axes[0].set_ylabel("error of translation")
axes[0].legend(frameon=False, fontsize=7)
plt.tight_layout()

# %% [markdown]
# *What to see:* lower and more to the left is better. (Where these outputs were made there was no Mitsuba, and other
# work on the machine.) Each method's points go down to the right as it takes more samples. These images are small and
# runs few; `python -m benchmarks.error_time` does it at 256² for eight scenes, with error bars and a check of its
# references, and `docs/error-time.md` has a run.
#
# In practice: leave the numbers of samples and the seeds alone: each step of an optimiser draws new samples. Errors of
# unbiased gradients average out over the steps.
#
# ## Check

# %%
assert z.abs().max() < 5, "unbiased"
assert (inside - exact).norm() > 0.3 * exact.norm(), "and not without the boundary term"
assert of_edges[-1] < 0.02 * of_edges[0], "256 times as many edge samples: far better than a sixteenth of the error"
