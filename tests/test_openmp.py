"""One OpenMP runtime in the process, torch's, whichever is imported first; in forked children, too."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parent

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mapped files as on Linux")

# Renders with three threads and torch's own operators, then prints each mapped OpenMP runtime, and the kernel's own word.
RENDER = """
import os, sys
from pathlib import Path
{imports}
from edgegrad.library import core
from scenes import front_camera, icosphere

torch.set_num_threads(3)

def render():
    mesh = icosphere(4)
    verts = mesh.verts.clone().requires_grad_()
    eg.render(mesh.replace(verts=verts), front_camera(48), spp=4).sum().backward()
    assert torch.ones(1 << 20).mul(2.0).sum() == 1 << 21
    return verts.grad

def show():
    lines = Path("/proc/self/maps").read_text().splitlines()
    files = {{line.split(maxsplit=5)[5] for line in lines if len(line.split(maxsplit=5)) == 6}}
    for file in sorted(file for file in files if any(name in Path(file).name for name in ("libgomp", "libomp", "libiomp"))):
        print(os.path.realpath(file))
    print(os.path.realpath(core.openmp_runtime()), flush=True)

expected = render()
show()
"""
# The child renders with threads of its own, and has them.
FORK = """
child = os.fork()
if child == 0:
    assert torch.equal(render(), expected)
    assert len(os.listdir("/proc/self/task")) >= 3
    show()
    os._exit(0)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
assert torch.equal(render(), expected)
"""
ORDERS = {"torch first": "import torch\nimport edgegrad as eg", "edgegrad first": "import edgegrad as eg\nimport torch"}


def lines_of(code: str, **variables: str) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": f"{TESTS}:{TESTS.parent}", **variables}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()


@pytest.mark.parametrize("order", ORDERS)
def test_one_runtime(order):
    """Also in a forked child. A second one would keep threads of its own beside torch's."""
    parent, own, *child = lines_of(RENDER.format(imports=ORDERS[order]) + FORK)
    assert parent == own and child == [parent, own]
    assert Path(own).name.startswith(("libgomp", "libomp", "libiomp"))


def test_fewer_threads_than_asked_for():
    """The runtime may give fewer, here one beside the calling thread; the items are shared by those that there are."""
    code = (
        RENDER.format(imports=ORDERS["torch first"])
        + "import hashlib; print(hashlib.sha256(expected.numpy()).hexdigest())"
    )
    assert lines_of(code)[-1] == lines_of(code, OMP_THREAD_LIMIT="2")[-1] == lines_of(code, OMP_DYNAMIC="true")[-1]


def test_the_doctor_names_the_runtime():
    found = subprocess.run(
        [sys.executable, "-m", "edgegrad_cli", "doctor"], capture_output=True, text=True, timeout=120
    )
    (line,) = (line for line in found.stdout.splitlines() if line.startswith("OpenMP "))
    assert Path(line.split(maxsplit=1)[1]).is_file()
