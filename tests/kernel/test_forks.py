"""render() in forked and spawned processes."""

import sys

import pytest
from load_scripts import posix, script

pytestmark = pytest.mark.unsanitized


# Each child has a time limit of its own, far above what it needs: what it guards against is waiting for ever.
PROCESSES = """
import importlib, multiprocessing
import edgegrad.library

NUMBERS = torch.linspace(0, 1, 1 << 20)

def child(threads):
    if threads:
        torch.set_num_threads(threads)
    assert NUMBERS.mul(2.0).sum() > 0  # torch takes threads of its own for so many
    return [step(k) for k in (0, 1, 0)]

def children(method, threads=0, count=2):
    with multiprocessing.get_context(method).Pool(count) as pool:
        return pool.map_async(child, [threads] * count).get(timeout=60)

class Rendered(torch.utils.data.Dataset):
    def __len__(self):
        return 6
    def __getitem__(self, k):
        return step(k % 2)

def loaded():
    loader = torch.utils.data.DataLoader(Rendered(), num_workers=2, timeout=60, multiprocessing_context="fork")
    return [text for batch in loader for text in batch]
"""

FORK_WHILE_BUILDING = """
def build(k):
    with torch.no_grad():
        eg.render(SPHERE.replace(verts=SPHERE.verts * (1.0 + 0.001 * k)), front_camera(8), spp=1)

def builds():
    k = 0
    while True:
        k += 1
        build(k)

def forked_while_building(count):
    "The number of children that hang."
    for _ in range(2):
        threading.Thread(target=builds, daemon=True).start()
    hung = 0
    for _ in range(count):
        pid = os.fork()
        if pid == 0:
            build(-1)
            os._exit(0)
        end = time.monotonic() + 10
        while os.waitpid(pid, os.WNOHANG)[0] == 0:
            if time.monotonic() > end:
                hung += 1
                os.kill(pid, 9)
                os.waitpid(pid, 0)
                break
            time.sleep(0.001)
    return hung
"""

FORK = (
    PROCESSES
    + FORK_WHILE_BUILDING
    + """
if __name__ == "__main__":
    torch.set_num_threads(4)
    importlib.reload(edgegrad.library)  # as where a notebook imports changed code anew: what fork() calls is there twice
    before = children("fork")
    child(0)
    expected = [step(k) for k in (0, 1, 0)]
    found = {"before": before, "after": children("fork"), "two threads": children("fork", 2), "loader": loaded()}

    # While other threads render: what they hold just then must not be missing in the child.
    go_on, rounds = True, [0, 0]
    def render(j):
        k = 2
        while go_on:
            step(k, size=16)
            k += 1
            rounds[j] += 1
    threads = [threading.Thread(target=render, args=(j,)) for j in range(2)]
    for thread in threads:
        thread.start()
    meanwhile = [children("fork") for _ in range(int(sys.argv[1]))]
    go_on = False
    for thread in threads:
        thread.join()
    found |= {"meanwhile": meanwhile, "parent": [step(k) for k in (0, 1, 0)], "expected": expected, "rounds": rounds}
    print(json.dumps({**found, "hung": forked_while_building(int(sys.argv[2]))}), flush=True)
    os._exit(0)
"""
)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="fork() as on Linux")
@pytest.mark.parametrize("forks, more", [(1, 10), pytest.param(40, 500, marks=pytest.mark.slow)])
def test_forked_children_render(forks, more, tmp_path):
    """Children render before and after the parent did with several threads, with threads of their own, and as workers of a
    DataLoader.

    Then they render while other threads build: Embree's threads leave a build after it is over, and held locks of their own in
    2 % of the children.
    """
    found = script(FORK, forks, more, timeout=400, folder=tmp_path)
    expected = found["expected"]
    assert len(set(expected)) == 2 and expected[0] == expected[2]
    for name in ("before", "after", "two threads"):
        assert found[name] == [expected] * 2, name
    assert found["loader"] == [expected[k % 2] for k in range(6)]
    assert found["meanwhile"] == [[expected] * 2] * forks and all(found["rounds"])
    assert found["parent"] == expected
    assert found["hung"] == 0


SPAWN = (
    PROCESSES
    + """
if __name__ == "__main__":
    torch.set_num_threads(4)
    expected = [step(k) for k in (0, 1, 0)]
    print(json.dumps({"expected": expected, "found": children(sys.argv[1], count=1)}))
"""
)


@pytest.mark.slow  # they inherit nothing: each is as any other process
@pytest.mark.parametrize("method", ["spawn", pytest.param("forkserver", marks=posix)])
def test_spawned_children_render(method, tmp_path):
    found = script(SPAWN, method, folder=tmp_path)
    assert found["found"] == [found["expected"]]
