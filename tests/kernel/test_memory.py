"""Too little memory: what does not fit is refused before it is allocated, with figures and what to lower."""

import psutil
import pytest
import torch
from scenes import cube, front_camera, icosphere

import edgegrad as eg
from edgegrad.kernel import memory, operators


@pytest.fixture
def free(monkeypatch):
    """Sets how many bytes are free; renders of any size ask for it."""

    def set_free(count):
        monkeypatch.setattr(memory, "CHECKED_FROM", 0)
        monkeypatch.setattr(memory, "available", lambda: count)

    return set_free


def requiring(mesh, *names):
    return mesh.replace(**{name: getattr(mesh, name).detach().clone().requires_grad_() for name in names})


def test_an_image_larger_than_memory_is_refused():
    """The image would take 172 GB. Nothing is allocated, so it is refused at once."""
    size, before = 65536, psutil.Process().memory_info().rss
    if psutil.virtual_memory().total > 100e9:
        pytest.skip("this machine may have the memory")
    message = r"render: .* at most the \d.* GB of memory that are free, got about 189 GB \(image 103 GB, coverage 34 GB"
    with pytest.raises(MemoryError, match=message + r".*; lower the camera's size \(65536 × 65536 pixels\), its batch"):
        eg.render(cube(), front_camera(size), seed=0)
    assert psutil.Process().memory_info().rss - before < 50e6
    with pytest.raises(MemoryError, match="image 103 GB"):
        eg.plan(requiring(cube(), "verts"), front_camera(size))


@pytest.mark.parametrize(
    ("change", "largest"),
    [
        (lambda mesh, camera: (mesh, camera.resized((1000, 1000))), r"\(image 24 MB, coverage 8.0 MB"),
        (lambda mesh, camera: (mesh.replace(colors=torch.rand(len(mesh.verts), 800)), camera), r"\(image "),
        (lambda mesh, camera: (icosphere(7), camera), r"\(ray structure 24 MB"),
    ],
    ids=["size", "channels", "faces"],
)
def test_an_image_that_does_not_fit(change, largest, free):
    mesh, camera = change(icosphere(1), front_camera(64))
    expected = eg.render(mesh, camera, spp=1, seed=0)
    free(5_000_000)
    with pytest.raises(MemoryError, match=r"render: .* 5\.0 MB .*" + largest + r".*; lower the camera's size"):
        eg.render(mesh, camera, spp=1, seed=0)
    free(100_000_000)
    assert torch.equal(eg.render(mesh, camera, spp=1, seed=0), expected)


@pytest.mark.parametrize("kind", ["verts", "colors", "texture", "background"])
def test_a_backward_pass_that_does_not_fit(kind, free):
    mesh, camera, background = icosphere(2), front_camera(32), None
    if kind == "colors":
        mesh = requiring(mesh.replace(colors=torch.rand(len(mesh.verts), 400)), "colors")
    elif kind == "verts":
        mesh = requiring(icosphere(6), "verts")
    elif kind == "texture":
        uvs = mesh.verts[:, :2] * 0.5 + 0.5
        mesh = mesh.replace(colors=None, texture=torch.rand(600, 600, 3), uvs=uvs, uv_faces=mesh.faces)
        mesh = requiring(mesh, "texture")
    else:
        background = torch.rand(700, 700, 3, dtype=torch.float64, requires_grad=True)
        camera = front_camera(700)
    image = eg.render(eg.Scene([mesh], background), camera, spp=1, seed=0)
    adjoint = torch.ones_like(image)
    free(2_000_000)
    with pytest.raises(MemoryError, match=r"backward pass: .*or let fewer tensors require a gradient"):
        image.backward(adjoint, retain_graph=True)
    given = background if background is not None else getattr(mesh, kind)
    assert given.grad is None
    free(200_000_000)
    image.backward(adjoint)
    assert given.grad is not None and bool(given.grad.abs().sum() > 0)


def test_kept_geometry_makes_room(monkeypatch):
    """Other meshes' ray structures are given up before a render is refused."""
    counts = iter([1_000_000, 100_000_000])
    monkeypatch.setattr(memory, "CHECKED_FROM", 0)
    monkeypatch.setattr(memory, "available", lambda: next(counts))
    forgotten = []
    monkeypatch.setattr(memory, "clear_geometry", lambda: forgotten.append(True))
    eg.render(icosphere(5), front_camera(32), spp=1, seed=0)
    assert forgotten == [True]


def test_small_renders_do_not_ask(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: pytest.fail("asked for free memory"))
    mesh = requiring(cube(), "verts", "colors")
    eg.render(mesh, front_camera(64), spp=4, seed=0).sum().backward()
    assert mesh.verts.grad is not None


@pytest.mark.parametrize(
    "cause",
    [MemoryError("std::bad_alloc"), RuntimeError("[…] DefaultCPUAllocator: can't allocate memory: you tried …")],
)
def test_a_failed_allocation_is_explained(cause, monkeypatch):
    def fail(*_, **__):
        raise cause

    monkeypatch.setattr(operators, "kernel_scene", fail)
    with pytest.raises(MemoryError, match=r"render: expected .*than the system grants, got about .*; lower") as error:
        eg.render(cube(), front_camera(16), seed=0)
    assert error.value.__cause__ is cause


def test_other_errors_are_not_taken_for_memory(monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("something else")

    monkeypatch.setattr(operators, "kernel_scene", fail)
    with pytest.raises(RuntimeError, match=r"^something else$"):
        eg.render(cube(), front_camera(16), seed=0)


def group(folder, limit, used, stat, names):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in zip(names, (limit, used, stat), strict=True):
        (folder / name).write_text(str(text))


def test_what_control_groups_leave(tmp_path):
    """Every group up to the root counts, caches of files do not, and a group without a limit tells nothing."""
    two = ("memory.max", "memory.current", "memory.stat")
    group(tmp_path / "a" / "b", 5000, 1000, "anon 700\ninactive_file 200\nactive_file 100\n", two)
    group(tmp_path / "a", "max", 9000, "inactive_file 0\n", two)
    group(tmp_path, 9000, 8500, "inactive_file 100\n", two)
    one = ("memory.limit_in_bytes", "memory.usage_in_bytes", "memory.stat")
    group(tmp_path / "memory" / "c", 3000, 3500, "total_inactive_file 50\ninactive_file 3000\n", one)
    proc = tmp_path / "cgroup"
    proc.write_text("0::/a/b\n")
    assert list(memory._left_in_groups(proc, tmp_path)) == [4300, 600]
    proc.write_text("9:cpu:/a/b\n4:hugetlb,memory:/c/gone\n")
    assert list(memory._left_in_groups(proc, tmp_path)) == [0]
    assert list(memory._left_in_groups(tmp_path / "none", tmp_path)) == []
    assert 0 < memory.available() <= psutil.virtual_memory().total
