"""Views are distributed among processes: gradients are the same, and so is the result after a worker was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
import torch.distributed as dist
from example_modules import FOLDER, example
from torch import Tensor
from torch.distributed.elastic.multiprocessing.errors import ChildFailedError
from torch.distributed.launcher.api import LaunchConfig, elastic_launch
from torch.nn.parallel import DistributedDataParallel

import edgegrad as eg

many_views = example("many_views")
TASK = many_views.Task(views=6, batch=5, size=24, steps=6, spp=2, subdivisions=2)  # shares of two sizes

pytestmark = [pytest.mark.unsanitized, pytest.mark.timeout(300)]
forks = pytest.mark.skipif(not hasattr(os, "fork"), reason="workers are forked, so that none imports torch anew")


@pytest.fixture(autouse=True)
def _on_this_machine(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let processes meet on the loopback interface."""
    monkeypatch.setenv("TORCH_DISABLE_SHARE_RDZV_TCP_STORE", "1")
    if sys.platform == "linux":
        monkeypatch.setenv("GLOO_SOCKET_IFNAME", "lo")
    with signals_kept():
        yield


@contextmanager
def signals_kept() -> Iterator[None]:
    """Restore the handlers of signals, which torchrun would leave replaced."""
    names = [name for name in ("SIGTERM", "SIGINT", "SIGHUP", "SIGQUIT") if hasattr(signal, name)]
    before = {name: signal.getsignal(getattr(signal, name)) for name in names}
    try:
        yield
    finally:
        for name, handler in before.items():
            signal.signal(getattr(signal, name), handler)


def launched(count: int, work: Callable[..., Any], *args: Any, restarts: int = 0) -> Any:
    """Return the result of the first of some processes, which start as torchrun starts them."""
    config = LaunchConfig(
        min_nodes=1, max_nodes=1, nproc_per_node=count, max_restarts=restarts, rdzv_backend="c10d",
        rdzv_endpoint="127.0.0.1:0", local_addr="127.0.0.1", run_id="test", start_method="fork", monitor_interval=0.1,
    )  # fmt: skip
    return elastic_launch(config, work)(*args)[0]


def gradient_of(step: int) -> Tensor:
    with many_views.joined():
        module = many_views.Loss(many_views.Pictures(TASK), TASK)
        loss = DistributedDataParallel(module) if dist.is_initialized() else module
        many_views.gradient(loss, step, TASK)
        return module.coordinates.grad.clone()


def result_of(checkpoint: str, killed: int = -1) -> Tensor:
    """Return the result of a fit whose worker kills itself in a step of its first life."""

    def die(step: int, loss: float) -> None:
        if step == killed and dist.get_rank() == 1 and os.environ["TORCHELASTIC_RESTART_COUNT"] == "0":
            os.kill(os.getpid(), signal.SIGKILL)

    with many_views.joined():
        return many_views.fit(TASK, Path(checkpoint), every=2, callback=die)[0].verts


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Tensor:
    return result_of(str(tmp_path_factory.mktemp("fit") / "one.pt"))


def apart(a: Tensor, b: Tensor) -> float:
    return float((a - b).norm() / b.norm())


@forks
@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_gradients_are_those_of_one_process(count: int) -> None:
    one = gradient_of(1)
    assert apart(launched(count, gradient_of, 1), one) < 1e-6
    assert apart(gradient_of(2), one) > 1e-2  # another step has other views and samples


@forks
@pytest.mark.parametrize("count", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_a_killed_worker_is_started_again(count: int, tmp_path: Path, undisturbed: Tensor) -> None:
    found = launched(count, result_of, str(tmp_path / "many.pt"), 4, restarts=1)
    assert apart(found, undisturbed) < 1e-6
    with pytest.raises(ChildFailedError):  # without restarts it ends there
        launched(count, result_of, str(tmp_path / "none.pt"), 4)
    assert torch.load(tmp_path / "none.pt")["state"]["step"] == 4


def test_a_fit_resumes_from_its_checkpoint(tmp_path: Path, undisturbed: Tensor) -> None:
    def stop(step: int, loss: float) -> None:
        if step == 4:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        many_views.fit(TASK, tmp_path / "fit.pt", every=2, callback=stop)
    steps = []
    mesh, _ = many_views.fit(TASK, tmp_path / "fit.pt", every=2, callback=lambda step, _: steps.append(step))
    assert steps == [4, 5]
    assert torch.equal(mesh.verts, undisturbed)


def test_a_checkpoint_of_another_task(tmp_path: Path) -> None:
    many_views.fit(TASK._replace(steps=2), tmp_path / "fit.pt", every=2)
    with pytest.raises(ValueError, match=r"checkpoint: expected .* made with another steps;"):
        many_views.fit(TASK, tmp_path / "fit.pt")


def test_restarts_need_a_store_for_each_start(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {"RUN_ID": "test", "MAX_RESTARTS": "1", "USE_AGENT_STORE": "True"}.items():
        monkeypatch.setenv(f"TORCHELASTIC_{name}", value)
    with pytest.raises(RuntimeError, match=r"max-restarts: needs .*TORCH_DISABLE_SHARE_RDZV_TCP_STORE=1"):
        many_views.joined().__enter__()


def test_each_round_sees_all_views_once() -> None:
    views = [v for step in range(6) for v in many_views.views_of(step, TASK)]
    assert all(sorted(views[k : k + 6]) == list(range(6)) for k in range(0, 30, 6))
    assert views[:6] != views[6:12]


@forks
@pytest.mark.slow
def test_torchrun(tmp_path: Path) -> None:
    """The command is that of the docs. A worker is killed from outside once there is a checkpoint."""
    task = TASK._replace(steps=400)
    options = [f"--{name}={value}" for name, value in task._asdict().items()]
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "--max-restarts=1"]
    command += ["--local-addr=127.0.0.1", str(FOLDER / "many_views.py"), *options, f"--out={tmp_path}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as run:
        try:
            wait_for((tmp_path / "fit.pt").exists, run)
            psutil.Process(run.pid).children()[-1].kill()
            printed, _ = run.communicate(timeout=200)
        finally:
            run.terminate()  # and its workers with it
    assert run.returncode == 0
    assert printed.count("step 0:") == 1 and printed.count("step 380:") == 1  # it went on, and did not begin anew
    assert "2 processes of 1 threads" in printed
    assert not (tmp_path / "fit.pt").exists()
    undisturbed = many_views.fit(task, tmp_path / "one.pt")[0].verts
    assert apart(eg.load_mesh(tmp_path / "mesh.ply").verts.double(), undisturbed) < 1e-6


def wait_for(happened: Callable[[], bool], run: subprocess.Popen[str], seconds: float = 100.0) -> None:
    end = time.monotonic() + seconds
    while not happened():
        assert run.poll() is None and time.monotonic() < end
        time.sleep(0.02)
