"""Find a shape from many views, which torch.distributed shares among processes and machines.

    export TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1  # see joined()
    torchrun --standalone --nproc-per-node 2 --max-restarts 3 examples/many_views.py [--views 64] [--batch 16]

A sphere becomes a knobbly stone. In each step DistributedDataParallel gives every process some views to render and adds up their
gradients. Each view of each step has a seed of its own, so the result does not depend on the number of processes, but for the
order in which numbers are summed. The state is saved every few steps: when a worker dies, torchrun starts all of them again
and they go on from there, perhaps fewer. docs/many-machines.md says how to run it on many machines.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import objects
import shape
import torch
import torch.distributed as dist
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

import edgegrad as eg
from edgegrad.fit import Checkpoint
from edgegrad.fit.checkpoints import CheckpointFile
from edgegrad.fit.laplacian import LaplacianSolver
from edgegrad.optim.adam import Adam


class Task(NamedTuple):
    """What is fitted, and how."""

    views: int = 64  # in all
    batch: int = 16  # rendered in each step
    size: int = 128  # pixels
    steps: int = 120
    spp: int = 4
    rate: float = 0.02  # the first step's length
    subdivisions: int = 4  # of the sphere: 5,120 faces


class Speed(NamedTuple):
    """How fast views were rendered, with their gradients."""

    together: float  # views a second, by all processes
    work: float  # views a second of processor time, by the first process: what it does where nothing else runs


class Pictures:
    """Cameras and their pictures, of which a process asks for those of its own views. Here they are rendered; yours are files."""

    def __init__(self, task: Task) -> None:
        self.mesh = shape.lit(shape.stone(5))
        self.cameras = objects.around(self.mesh, task.views, task.size, distance=1.35)
        self.picture = lru_cache(maxsize=1024)(self._picture)

    def _picture(self, view: int) -> Tensor:
        return eg.render(self.mesh, self.cameras[view], spp=64, seed=2**32 + view)


class Loss(torch.nn.Module):
    """The mean squared difference of renders to pictures. Its parameter stands for the vertices (edgegrad.fit.laplacian)."""

    def __init__(self, pictures: Pictures, task: Task) -> None:
        super().__init__()
        ball = eg.shapes.sphere(subdivisions=task.subdivisions, dtype=torch.float64)
        verts, self.faces = ball.verts, ball.faces
        self.pictures, self.spp = pictures, task.spp
        self.smooth = LaplacianSolver(self.faces, len(verts), smoothness=19.0)
        self.coordinates = torch.nn.Parameter(self.smooth.to_differential(verts))

    def mesh(self) -> eg.Mesh:
        return eg.Mesh(self.smooth(self.coordinates), self.faces)

    def forward(self, views: list[int], step: int, count: float) -> Tensor:
        """Return the sum over some views, divided by `count`."""
        mesh, cameras = shape.lit(self.mesh()), self.pictures.cameras
        total = torch.zeros((), dtype=torch.float64)
        for view in views:
            image = eg.render(mesh, cameras[view], self.spp, seed=step * len(cameras) + view)
            total = total + (image - self.pictures.picture(view)).square().mean().double()
        return total / count


def views_of(step: int, task: Task) -> list[int]:
    """Return the views of a step, which take turns in an order drawn anew for each round, the same in every process."""
    found = []
    for k in range(step * task.batch, (step + 1) * task.batch):
        generator = torch.Generator().manual_seed(k // task.views)
        found.append(int(torch.randperm(task.views, generator=generator)[k % task.views]))
    return found


def gradient(loss: torch.nn.Module, step: int, task: Task) -> float:
    """Leave the gradient of a step's mean loss in the parameters of every process; return that loss."""
    rank, processes = _place()
    if task.batch < processes:
        raise ValueError(f"batch: expected a view for each of {processes} processes, got {task.batch}; raise --batch")
    own = views_of(step, task)[rank::processes]
    # The mean over processes, which DistributedDataParallel takes, of their sums times `processes` is the sum.
    share = loss(own, step, task.batch / processes)
    loss.zero_grad()
    share.backward()
    mean = share.detach() / processes
    if dist.is_initialized():
        dist.all_reduce(mean)
    return float(mean)


def fit(
    task: Task, checkpoint: Path, every: int = 20, callback: Callable[[int, float], Any] | None = None
) -> tuple[eg.Mesh, Speed]:
    """Return the mesh, and how fast views were rendered. Resume from `checkpoint`, if there is one, which must be of
    the same task."""
    module = Loss(Pictures(task), task)
    loss = DistributedDataParallel(module) if dist.is_initialized() else module
    values = dict(module.named_parameters())
    optimizer = Adam(values, dict.fromkeys(values, task.rate), uniform=values)
    first, (rank, processes) = 0, _place()
    kept = None if checkpoint is None else Checkpoint(checkpoint, every, resume=checkpoint.exists())
    file = CheckpointFile(kept, task._asdict())
    saved = _shared(file.read)
    if saved is not None:
        first = saved["step"]
        module.load_state_dict(saved["module"])
        optimizer.load(saved["optimizer"])
    for view in sorted({v for step in range(first, task.steps) for v in views_of(step, task)[rank::processes]}):
        module.pictures.picture(view)  # not in the time of the fit
    if dist.is_initialized():
        dist.barrier()
    wall, work = time.perf_counter(), time.process_time()
    for step in range(first, task.steps):
        optimizer.rates = dict.fromkeys(values, task.rate * 0.5 * (1.0 + math.cos(math.pi * step / task.steps)))
        number = gradient(loss, step, task)
        optimizer.step({name: value.grad for name, value in values.items()})
        if rank == 0 and (step + 1) % every == 0:
            state = {"step": step + 1, "module": module.state_dict(), "optimizer": optimizer.state()}
            file.write(state)
        if callback is not None:
            callback(step, number)
    wall, work = time.perf_counter() - wall, time.process_time() - work
    views = (task.steps - first) * task.batch
    with torch.no_grad():
        return module.mesh(), Speed(views / max(wall, 1e-9), views / processes / max(work, 1e-9))


def _place() -> tuple[int, int]:
    """Return which process this is, and of how many."""
    return (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)


def _shared(read: Callable[[], Any]) -> Any:
    """Return what the first process reads to all, or raise in all why it cannot: so they agree, wherever the file
    is."""
    box: list[Any] = [None]
    if _place()[0] == 0:
        try:
            box = [read()]
        except ValueError as error:
            box = [error]
    if dist.is_initialized():
        dist.broadcast_object_list(box, src=0)
    if isinstance(box[0], ValueError):
        raise box[0]
    return box[0]


def main() -> None:
    parser = argparse.ArgumentParser()
    for name, value in Task()._asdict().items():
        parser.add_argument(f"--{name}", type=type(value), default=value)
    parser.add_argument("--out", type=Path, default=Path("out/many_views"))
    args = vars(parser.parse_args())
    out = args.pop("out")
    out.mkdir(parents=True, exist_ok=True)
    task = Task(**args)
    for name, value in args.items():
        if value <= 0:
            parser.error(f"--{name}: expected a number above 0, got {value}")

    def show(step: int, loss: float) -> None:
        if _place()[0] == 0 and step % 20 == 0:
            print(f"step {step}: loss {loss:.3e}", flush=True)

    with joined():
        mesh, speed = fit(task, out / "fit.pt", callback=show)
        rank, processes = _place()
    if rank == 0:
        eg.save_mesh(out / "mesh.ply", mesh)
        (out / "fit.pt").unlink(missing_ok=True)  # a later run begins anew
        print(
            f"Chamfer distance {shape.chamfer(mesh, shape.stone(5)):.2f} % of the diagonal\n"
            f"{processes} processes of {torch.get_num_threads()} threads: {speed.together:.1f} views a second, "
            f"{speed.together / processes:.1f} each; {speed.work:.1f} a second of processor time"
        )


@contextmanager
def joined() -> Iterator[None]:
    """Join the processes that torchrun started, which gives them addresses and ranks; do without it alone."""
    if not dist.is_torchelastic_launched():
        yield
        return
    # In newer versions of PyTorch processes meet in a store that outlives them: started again, they look for the dead at the
    # addresses left there (github.com/pytorch/pytorch/issues/135712). With the variable each start has a store of its own.
    restarts, kept = (os.environ.get(f"TORCHELASTIC_{name}") for name in ("MAX_RESTARTS", "USE_AGENT_STORE"))
    if restarts != "0" and kept == "True":
        raise RuntimeError("max-restarts: needs --rdzv-backend=c10d and TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1")
    dist.init_process_group("gloo")  # on the CPU
    yield
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
