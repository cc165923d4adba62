"""render() under load: many steps, many threads, Ctrl-C."""

import hashlib
import os
import signal
import sys
import threading

import pytest
import torch
from load_scripts import posix, script
from scenes import cube, front_camera, icosphere, soup

import edgegrad as eg

pytestmark = pytest.mark.unsanitized


# -- many steps -------------------------------------------------------------------------------------------------------

STEPS = """
import psutil
steps = int(sys.argv[1])

def fit():
    "Vertices of a sphere that follow their gradient: each step has geometry of its own."
    verts = SPHERE.verts.clone().requires_grad_()
    camera = front_camera(24)
    for k in range(steps):
        image = eg.render(SPHERE.replace(verts=verts), camera, spp=2, seed=k)
        loss = (image - 0.3).square().mean()
        (gradient,) = torch.autograd.grad(loss, verts)
        with torch.no_grad():
            verts -= 0.01 * gradient
        if k == 50:
            resident.append(psutil.Process().memory_info().rss)
    resident.append(psutil.Process().memory_info().rss)
    return hashlib.sha256(image.detach().numpy().tobytes() + gradient.numpy().tobytes()).hexdigest(), float(loss.detach())

SPHERE, resident = icosphere(2), []
(first, loss), (again, _) = fit(), fit()
print(json.dumps({"same": first == again, "grown": max(resident) - resident[0], "loss": loss}), flush=True)
"""
# Python ends each thread that asks for its lock then, which aborts the process where C++ frames are in the way.
ENDING = """
def loop():
    while True:
        step()

for _ in range(3):
    threading.Thread(target=loop, daemon=True).start()
time.sleep(0.3)
"""


@pytest.mark.parametrize("steps", [70, pytest.param(10_000, marks=pytest.mark.slow)])
def test_memory_stays_and_results_repeat_over_many_steps(steps, tmp_path):
    """Twice so many steps, with the same bits at the end of each run, in 5 MB more than after the first 50."""
    found = script(STEPS + ENDING, steps, timeout=1200, folder=tmp_path, silent=True)
    assert found["same"] and 0 < found["loss"] < 1, found
    assert found["grown"] < 5e6, found


# -- threads of Python ------------------------------------------------------------------------------------------------


def bits(mesh, seed=0):
    """Return a hash of the image and of the gradients by vertices and colours."""
    verts, colors = (t.detach().clone().requires_grad_() for t in (mesh.verts, mesh.colors))
    image = eg.render(mesh.replace(verts=verts, colors=colors), front_camera(40), spp=4, seed=seed)
    image.square().mean().backward()
    parts = (image, verts.grad, colors.grad)
    return hashlib.sha256(b"".join(part.detach().numpy().tobytes() for part in parts)).hexdigest()


def moved(mesh, k):
    return mesh.replace(verts=mesh.verts * (1.0 + 0.01 * k) + 0.002 * k)


SPHERE = icosphere(3)
SCENES = {
    "different scenes": [icosphere(k) for k in (1, 2, 3, 4)] + [moved(cube(), k) for k in range(4)],
    "one mesh": [SPHERE] * 8,
    "edges that move": [moved(soup(icosphere(2)), k) for k in range(8)],
}


@pytest.mark.parametrize("case", SCENES)
def test_the_same_bits_from_8_threads_as_alone(case):
    meshes, repeats = SCENES[case], 4
    alone = [bits(mesh, seed=k) for k, mesh in enumerate(meshes)]
    assert len(set(alone)) == len(meshes)
    found, begin = [[] for _ in meshes], threading.Barrier(len(meshes))

    def work(k):
        begin.wait()
        for turn in range(repeats):  # each thread renders every scene that another one is at just then
            i = (k + turn) % len(meshes)
            found[k].append((i, bits(meshes[i], seed=i)))

    threads = [threading.Thread(target=work, args=(k,)) for k in range(len(meshes))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(120)
    assert all(len(results) == repeats for results in found)
    assert all(result == alone[i] for results in found for i, result in results)


def test_the_same_bits_for_callers_with_different_numbers_of_threads():
    meshes = [icosphere(4), soup(icosphere(3))]
    alone = [bits(mesh) for mesh in meshes]
    found, begin = {}, threading.Barrier(4)

    def work(k):
        torch.set_num_threads((1, 2, 5, 3)[k])  # of this thread of Python
        begin.wait()
        found[k] = [bits(meshes[(k + turn) % 2]) for turn in range(4)]

    callers = [threading.Thread(target=work, args=(k,)) for k in range(4)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(120)
    assert found == {k: [alone[(k + turn) % 2] for turn in range(4)] for k in range(4)}


@pytest.mark.slow  # the steps above end so, too
def test_processes_end_while_daemon_threads_render(tmp_path):
    for _ in range(10):
        assert script('print("{}")' + ENDING, folder=tmp_path, silent=True) == {}


WAITING = """
def seconds_of_workers():
    "Processor time of all threads but this one."
    return time.process_time() - time.thread_time()

torch.set_num_threads(3)
found = {"waited": []}
step(size=64)
time.sleep(0.1)  # other libraries' threads come to rest
begin = seconds_of_workers()
with torch.no_grad():
    for _ in range(8):
        eg.render(SPHERE, front_camera(64), spp=4)
        time.sleep(0.05)
        quiet = seconds_of_workers()
        time.sleep(0.02)
        found["waited"].append(seconds_of_workers() - quiet)
found["worked"] = seconds_of_workers() - begin
"""

NAMES = """
from pathlib import Path

torch.set_num_threads(os.cpu_count())
for k in range(3):
    eg.render(icosphere(5).transformed(scale=1.0 + k), front_camera(8), spp=1)
if sys.platform == "linux":
    tasks = sorted(int(task) for task in os.listdir("/proc/self/task"))
    found["names"] = [Path(f"/proc/self/task/{task}/comm").read_text().strip() for task in tasks]
"""

HANDLER = """
import signal

rendered = []

def render_too(*_):
    with torch.enable_grad():  # it may come in the middle of a backward pass
        rendered.append(step(size=16))
    if time.monotonic() < end:  # only now, or a busy machine would have one handler interrupt the other, without end
        signal.setitimer(signal.ITIMER_REAL, 0.02)

alone = step(size=16), [step(k, size=128) for k in range(3)]
signal.signal(signal.SIGALRM, render_too)
end = time.monotonic() + 0.5
signal.setitimer(signal.ITIMER_REAL, 0.02)
wrong = rounds = 0
while time.monotonic() < end:
    wrong += [step(k, size=128) for k in range(3)] != alone[1]
    rounds += 1
signal.signal(signal.SIGALRM, signal.SIG_IGN)
found |= {"rendered": len(rendered), "wrong": wrong + sum(r != alone[0] for r in rendered), "rounds": rounds}
"""


@pytest.fixture(scope="module")
def threads(tmp_path_factory):
    """Return what one process finds of its threads, for the tests below: it takes longer to import torch than to render."""
    code = WAITING + NAMES
    if hasattr(signal, "SIGALRM"):
        code += HANDLER + INTERRUPTED
        code += 'found["interrupted"] = {kind: interrupted(kind) for kind in ("edge samples", "last tile")}\n'
    return script(code + "print(json.dumps(found))", folder=tmp_path_factory.mktemp("threads"))


def test_workers_that_wait_sleep(threads):
    """OpenMP's threads spin for some milliseconds by default; longer would take the processors from other processes."""
    assert threads["worked"] > 0, "no worker did anything"
    assert max(threads["waited"]) < 0.005, "workers took seconds of processor time while nothing was to do"


@pytest.mark.skipif(not sys.platform.startswith("linux") or os.cpu_count() == 1, reason="names of threads as on Linux")
def test_threads_of_a_build_are_known_by_name(threads):
    """fork() waits until those of this name sleep. The thread that builds keeps its own."""
    names = threads["names"]
    assert names[0] != "embree" and "embree" in names[1:], names


@posix
def test_a_signal_handler_that_renders(threads):
    """The kernel lets handlers run in the middle of a pass; one that renders must find no lock held by what it interrupts."""
    assert threads["rendered"] > 5
    assert threads["rounds"] > 0
    assert threads["wrong"] == 0


# -- Ctrl-C -----------------------------------------------------------------------------------------------------------

# Uninterrupted, each takes some 5 s on two cores.
INTERRUPTED = """
import signal

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may have started the tests with SIGINT ignored

def interrupted(kind):
    "What becomes of a long render into which Ctrl-C comes after 0.3 s."
    before, sent = step(), []
    mesh, camera = SPHERE.replace(verts=SPHERE.verts.clone().requires_grad_()), front_camera(512 if kind == "image" else 64)
    many = {"surface samples": eg.Sampling(surface=1 << 26), "edge samples": eg.Sampling(edges=1 << 26)}.get(kind)
    image, spp = None, 1 << 10
    if many:
        image = eg.render(mesh, camera, spp=1, sampling=many).sum()
    if kind == "last tile":  # of two; the calling thread has the one with 2 pixels, another thread that with 16
        torch.set_num_threads(2)
        mesh = SPHERE.replace(verts=(18.0 * SPHERE.verts + torch.tensor([16.0, 0.0, 0.0])).requires_grad_())
        camera = eg.Camera.orthographic((0.0, 0.0, -40.0), (0.0, 0.0, 0.0), height=1.0, size=(1, 32))
        spp = 1 << 20

    def press():
        sent.append(time.time())
        os.kill(os.getpid(), signal.SIGINT)

    after, timer = None, threading.Timer(0.3, press)
    timer.start()
    try:
        if image is None:
            eg.render(mesh, camera, spp=spp)
        else:
            image.backward()
    except KeyboardInterrupt:
        after = time.time() - sent[0]
    timer.cancel()
    return {"after": after, "same": before == step(), "gradient": mesh.verts.grad is not None}
"""


def check_interrupted(found):
    """KeyboardInterrupt is there 0.3 s after the signal; 1 s here, for other work may have the machine's cores just then."""
    assert found["after"] is not None, "the render was over before it was interrupted"
    assert found["after"] < 1.0
    assert found["same"] and not found["gradient"]


@posix
@pytest.mark.parametrize("kind", ["edge samples", "last tile"])
def test_ctrl_c_ends_a_long_render(kind, threads):
    """The calling thread may have nothing left to do."""
    check_interrupted(threads["interrupted"][kind])


@posix
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["image", "surface samples"])
def test_ctrl_c_ends_other_long_renders(kind, tmp_path):
    check_interrupted(script(INTERRUPTED + "print(json.dumps(interrupted(sys.argv[1])))", kind, folder=tmp_path))
