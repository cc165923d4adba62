"""One OpenMP runtime in the process, torch's, whichever is imported first; in forked children, too.

Processes take longer to import torch than to render, so each answers several questions.
"""

import functools
import os
import subprocess
import sys
from pathlib import Path

import pytest

from edgegrad import cli

TESTS = Path(__file__).parents[1]

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="mapped files as on Linux")

# The script renders with three threads and torch's own operators. It prints the gradient's bits, whether the environment
# is as it was, each mapped OpenMP runtime, and the kernel's own word.
RENDER = """
import os, sys
before = dict(os.environ)
import hashlib
from pathlib import Path

def threads():
    "The number of threads but Embree's."
    files = Path("/proc/self/task").glob("*/comm")
    return sum(file.read_text().strip() != "embree" for file in files)

{imports}
from edgegrad.library import core
from scenes import front_camera, icosphere

torch.set_num_threads(3)

def render():
    mesh = icosphere(4)
    verts = mesh.verts.clone().requires_grad_()
    eg.render(mesh.replace(verts=verts), front_camera(48), spp=4, seed=0).sum().backward()
    assert torch.ones(1 << 20).mul(2.0).sum() == 1 << 21
    return verts.grad

def show():
    lines = Path("/proc/self/maps").read_text().splitlines()
    files = {{line.split(maxsplit=5)[5] for line in lines if len(line.split(maxsplit=5)) == 6}}
    for file in sorted(file for file in files if any(name in Path(file).name for name in ("libgomp", "libomp", "libiomp"))):
        print(os.path.realpath(file))
    print(os.path.realpath(core.openmp_runtime()), flush=True)

def bits():
    return hashlib.sha256(render().numpy()).hexdigest()

expected = render()
print(bits(), dict(os.environ) == before)
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
# The same as OMP_DYNAMIC=true, from here on.
DYNAMIC = """
import ctypes
runtime = ctypes.CDLL(core.openmp_runtime())
assert runtime.omp_get_dynamic() == 0
runtime.omp_set_dynamic(1)
assert runtime.omp_get_dynamic() == 1
print(bits())
"""
ORDERS = {
    "torch first": "import torch\nhere = threads()\nimport edgegrad as eg\nassert threads() == here",
    "edgegrad first": "import edgegrad as eg\nimport torch",
}


def lines_of(code: str, **variables: str) -> list[str]:
    environment = {**os.environ, "PYTHONPATH": f"{TESTS}/support:{TESTS.parent}", **variables}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, run.stderr
    return run.stdout.split()


@functools.cache
def whole() -> list[str]:
    """Return what a process prints that imports torch first, and forks."""
    return lines_of(RENDER.format(imports=ORDERS["torch first"]) + FORK + DYNAMIC)


@functools.cache
def limited() -> list[str]:
    """Return what a process prints that imports edgegrad first, and has one thread next to the calling one."""
    return lines_of(RENDER.format(imports=ORDERS["edgegrad first"]), OMP_THREAD_LIMIT="2")


def test_one_runtime():
    """A forked child has the same one. A second runtime would keep threads of its own next to torch's."""
    _, _, parent, own, *child, _ = whole()
    assert parent == own and child == [parent, own]
    assert Path(own).name.startswith(("libgomp", "libomp", "libiomp"))
    assert limited()[2:] == [parent, own]


def test_import_starts_no_threads_of_openmp():
    whole()  # it counts them


def test_the_environment_stays_as_it_is():
    """How OpenMP's threads wait is the user's matter: the kernel sets no variable."""
    assert whole()[1] == limited()[1] == "True"


def test_fewer_threads_than_asked_for():
    """The runtime may give fewer, here one next to the calling thread; the items are shared by those that there are."""
    bits, *_, dynamic = whole()
    assert bits == dynamic == limited()[0]


def test_the_doctor_names_the_runtime(capsys):
    assert cli.main(["doctor"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("OpenMP "))
    assert Path(line.split(maxsplit=1)[1]).is_file()
