# %% [markdown]
# # 9. Several machines
#
# A loss over many views is a sum, and so is its gradient: $\nabla\ell = \frac1n \sum_k \nabla\ell_k$. Each process
# renders some of the views, and the gradients are averaged. PyTorch does that: `torch.distributed`, and
# DistributedDataParallel (DDP) around a module that renders. edgegrad has no engine of its own for it.
#
# Here two processes on this machine stand for two machines. The script is the same for both: only the `torchrun`
# command differs.

# %%
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch

from edgegrad.image import linear_to_srgb

# %% [markdown]
# ## The script
#
# A sphere is stretched and sheared by a matrix $A$, to be found from eight views. Three things are worth a look:
#
# - the module holds the parameters, and its `forward` renders this process's views;
# - each view has a seed of its own at each step, whoever renders it: so the samples, and the gradient, are the same
#   with any number of processes;
# - all views count alike, so each process must have as many. DDP averages the gradients while `backward` still runs.

# %%
script = """
import sys, time
import torch, torch.distributed as dist, trimesh
from torch.nn.parallel import DistributedDataParallel
import edgegrad as eg

VIEWS, SIZE = 8, 64
ball = trimesh.creation.icosphere(subdivisions=4)
verts, faces = torch.tensor(ball.vertices), torch.tensor(ball.faces)
colors = 0.5 + 0.4 * torch.sin(3 * verts + torch.tensor([0.0, 1.0, 2.0]))
A_TRUE = torch.tensor([[1.2, 0.2, 0.0], [0.0, 0.7, 0.1], [-0.1, 0.0, 0.9]], dtype=torch.float64)


def cameras():
    around = torch.arange(VIEWS) * 2.4
    eyes = [(4 * a.cos(), 1.5 * (2 * a).sin(), 4 * a.sin()) for a in around]
    return [eg.Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 40.0, (SIZE, SIZE)).to(torch.float64) for eye in eyes]


def render(A, camera, spp, seed):
    return eg.render(eg.Mesh(verts @ A.T, faces, colors=colors), camera, spp, seed)


class Fit(torch.nn.Module):
    def __init__(self, views):
        super().__init__()
        self.A = torch.nn.Parameter(torch.eye(3, dtype=torch.float64))
        self.views, self.cameras = views, cameras()
        with torch.no_grad():
            self.targets = {k: render(A_TRUE, self.cameras[k], 64, 10_000 + k) for k in views}

    def forward(self, step):
        losses = [
            (render(self.A, self.cameras[k], 16, VIEWS * step + k) - self.targets[k]).square().mean() for k in self.views
        ]
        return torch.stack(losses).mean()


def main(out, steps):
    dist.init_process_group("gloo")
    rank, count = dist.get_rank(), dist.get_world_size()
    model = DistributedDataParallel(Fit(range(rank, VIEWS, count)))
    optimizer = torch.optim.Adam(model.parameters(), lr=0.03)
    curve, first = [], None
    for step in range(steps):
        if step == 1:  # the first step also starts threads and loads code
            dist.barrier()
            began = time.perf_counter()
        optimizer.zero_grad()
        loss = model(step)
        loss.backward()
        first = model.module.A.grad.clone() if first is None else first
        optimizer.step()
        total = loss.detach()
        dist.all_reduce(total)  # a sum
        curve.append(total.item() / count)
    dist.barrier()
    seconds = time.perf_counter() - began
    if rank == 0:
        rate = VIEWS * (steps - 1) / seconds
        torch.save({"gradient": first, "curve": curve, "A": model.module.A.detach(), "rate": rate}, out)
    dist.destroy_process_group()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
"""

# %% [markdown]
# ## One process, two processes
#
# `torchrun --nproc-per-node=2 fit.py` starts two. On many machines it would be, on each of them,
#
# ```
# torchrun --nnodes=4 --nproc-per-node=1 --rdzv-backend=c10d --rdzv-endpoint=FIRST_MACHINE:29500 fit.py
# ```
#
# One process for each machine uses all its cores. Here, for a fair comparison, each process has one thread.

# %%
temporary = tempfile.TemporaryDirectory()
folder = Path(temporary.name)
(folder / "fit.py").write_text(script)


def run(processes, steps=60):
    out = folder / f"{processes}.pt"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", f"--nproc-per-node={processes}"]
    done = subprocess.run(
        [*command, folder / "fit.py", out, str(steps)],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return torch.load(out)


one, two = run(1), run(2)
apart = ((one["gradient"] - two["gradient"]).norm() / one["gradient"].norm()).item()
print(f"gradients of the first step, 1 and 2 processes: {apart:.1e} apart")
print(f"views a second, all processes together: {one['rate']:.0f} and {two['rate']:.0f}")
print("the matrix that two processes found, less the true one:")
sys.path.insert(0, str(folder))
import fit  # the script, as a module: its scene serves here too

print((two["A"] - fit.A_TRUE).numpy().round(4))

# %%
fig, axes = plt.subplots(1, 4, figsize=(9, 2.5), width_ratios=[1, 1, 1, 1.5])
camera = fit.cameras()[2]
for axis, A, title in zip(
    axes, (fit.A_TRUE, torch.eye(3).double(), two["A"]), ("one of eight views", "start", "found")
):
    axis.imshow(linear_to_srgb(fit.render(A, camera, 64, 1).clamp(0, 1)))
    axis.set_title(title, fontsize=10)
    axis.axis("off")
axes[3].semilogy(one["curve"], linewidth=4, color="0.75", label="1 process")
axes[3].semilogy(two["curve"], color="tab:red", label="2 processes")
axes[3].set_title("loss", fontsize=10)
axes[3].set_xlabel("step")
axes[3].legend(frameon=False, fontsize=8)
plt.tight_layout()

# %% [markdown]
# *What to see:* two processes on two cores render nearly twice as many views a second. The two curves lie on one
# another: the fit with two processes is the same fit, not another one of a similar kind.
#
# ## The gradient, without any of this
#
# The check that matters: the averaged gradient is that of the loss over all views, and that is the slope by finite
# differences.

# %%
whole = fit.Fit(range(fit.VIEWS))
whole(0).backward()
alone = whole.A.grad
slopes = torch.zeros(3, 3, dtype=torch.float64)
h = 0.003
with torch.no_grad():
    pairs = list(zip(whole.cameras, whole.targets.values()))

    def loss(A):
        return sum((fit.render(A, c, 256, k) - t).square().mean() for k, (c, t) in enumerate(pairs)) / len(pairs)

    for i in range(3):
        for j in range(3):
            step = torch.zeros(3, 3, dtype=torch.float64)
            step[i, j] = h
            slopes[i, j] = (loss(torch.eye(3) + step) - loss(torch.eye(3) - step)) / (2 * h)
print("two processes      ", two["gradient"].reshape(-1).numpy().round(4))
print("finite differences ", slopes.reshape(-1).numpy().round(4))

# %% [markdown]
# ## What is missing here
#
# A run on many machines loses one now and then. `examples/many_views.py` writes checkpoints and goes on after a worker
# was killed (torchrun's elastic runs), and its documentation says how to start it under Slurm and Kubernetes.
#
# ## Check

# %%
assert apart < 1e-6, "as many processes as you like, one gradient"
assert (alone - two["gradient"]).norm() < 1e-6 * alone.norm(), "that of all views"
assert (slopes - two["gradient"]).norm() < 0.03 * slopes.norm(), "and the right one"
assert (two["A"] - fit.A_TRUE).norm() < 0.02
