"""Looks at many numbers at once: the kernel's answers against torch's, and where there is no array to ask it about."""

from __future__ import annotations

import pytest
import torch
from scenes import cube

import edgegrad as eg
from edgegrad.check import all_below, check_finite
from edgegrad.library import core

pytestmark = pytest.mark.quick

# Around the sizes of vectors, of blocks, and of what is worth several threads.
SIZES = [1, 15, 16, 33, 4095, 4097, (1 << 18) + 3]


def places(n: int) -> list[int]:
    return sorted({0, n // 3, n - 1, *(i for i in (15, 16, 4095, 4096) if i < n)})


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", SIZES)
def test_one_number_that_is_not_finite(n: int, dtype: torch.dtype) -> None:
    good = torch.randn(n, generator=torch.Generator().manual_seed(n), dtype=dtype)
    assert core.all_finite(good.numpy())
    check_finite("good", good)
    bad_numbers = [float("nan"), float("inf"), -float("inf")] + [1e39, -1e39] * (dtype == torch.float64)
    for place in places(n):
        for number in bad_numbers:
            bad = good.clone()
            bad[place] = number
            assert not core.all_finite(bad.numpy())
            with pytest.raises(ValueError, match=rf"bad: expected .* at \[{place}\]"):
                check_finite("bad", bad)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_extreme_numbers_are_finite(dtype: torch.dtype) -> None:
    info = torch.finfo(torch.float32)
    extreme = torch.tensor([0.0, -0.0, info.max, -info.max, info.tiny, 1e-45], dtype=dtype)
    assert core.all_finite(extreme.repeat(10).numpy())
    check_finite("extreme", extreme)


def test_a_double_just_beyond_floats_is_too_large() -> None:
    beyond = torch.tensor([torch.finfo(torch.float32).max], dtype=torch.float64) * (1 + 1e-15)
    assert torch.isfinite(beyond.float()).all()  # rounded to float it is one
    assert not core.all_finite(beyond.numpy())
    with pytest.raises(ValueError, match=r"beyond: expected numbers up to 3\.4"):
        check_finite("beyond", beyond)


@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
@pytest.mark.parametrize("n", SIZES)
def test_one_index_out_of_range(n: int, dtype: torch.dtype) -> None:
    count = 1000
    good = torch.randint(count, (n,), generator=torch.Generator().manual_seed(n), dtype=dtype)
    good[-1] = count - 1
    info = torch.iinfo(dtype)
    assert core.all_below(good.numpy(), count) and all_below(good, count)
    assert all_below(good, info.max) and not all_below(good, count - 1)
    for place in places(n):
        for number in (-1, count, info.min, info.max):
            bad = good.clone()
            bad[place] = number
            assert not core.all_below(bad.numpy(), count) and not all_below(bad, count)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32, torch.int64])
def test_indices_of_every_integer_type(dtype: torch.dtype) -> None:
    index = torch.arange(100).to(dtype)
    assert all_below(index, 100) and not all_below(index, 99)
    assert all_below(index[::3], 100) and not all_below(index[::3], 99)  # no array to ask about: 99 is among them


def test_strided_numbers_are_looked_at() -> None:
    numbers = torch.zeros(8, 6)
    numbers[5, 1] = float("nan")
    check_finite("even", numbers[:, ::2])
    for strided, at in ((numbers[:, 1::2], "5, 0"), (numbers.T, "1, 5")):
        with pytest.raises(ValueError, match=rf"odd: expected finite numbers, got nan at \[{at}\]"):
            check_finite("odd", strided)


@pytest.mark.parametrize("name", ["verts", "faces", "colors"])
def test_tensors_without_storage_are_refused(name: str) -> None:
    """Torch reads them all the same."""
    tensors = {"verts": torch.eye(3), "faces": torch.tensor([[0, 1, 2]]), "colors": torch.eye(3)}
    tensors[name].untyped_storage().resize_(0)
    with pytest.raises(ValueError, match=f"{name}: expected numbers, got a tensor whose storage was resized to zero"):
        eg.Mesh(**tensors)


def test_numbers_that_a_transform_hides_are_not_accepted() -> None:
    """Torch makes an array of whatever memory holds."""

    def colored(colors: torch.Tensor) -> torch.Tensor:
        mesh = eg.Mesh(torch.eye(3), torch.tensor([[0, 1, 2]]), colors=colors)
        assert mesh.colors is not None
        return mesh.colors * 1

    with pytest.raises((RuntimeError, ValueError)):
        torch.func.functionalize(colored)(torch.full((3, 3), float("nan")))


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int16, torch.int32])
def test_indices_of_few_bits_in_a_scene_of_many_vertices(dtype: torch.dtype) -> None:
    """Indices into all meshes are greater than those into one."""
    many = torch.zeros(300 if dtype == torch.uint8 else 40000, 3)
    first = eg.Mesh(torch.cat([cube().verts.float(), many]), cube().faces.to(dtype))
    second = eg.Mesh(cube().verts.float() + 2.5, cube().faces.to(dtype))
    camera = eg.Camera.look_at((4, 5, 9), (1, 1, 1), size=(16, 16))
    wide = [mesh.replace(faces=mesh.faces.long()) for mesh in (first, second)]
    assert torch.equal(eg.render(eg.Scene([first, second]), camera, seed=0), eg.render(eg.Scene(wide), camera, seed=0))


def test_numbers_within_a_transform_are_looked_at() -> None:
    mesh = cube()

    def total(verts: torch.Tensor) -> torch.Tensor:
        return eg.render(mesh.replace(verts=verts), eg.Camera.look_at((3, 2, 4), (0, 0, 0), size=(8, 8)), seed=0).sum()

    assert torch.isfinite(torch.func.grad(total)(mesh.verts)).all()
    bad = mesh.verts.clone()
    bad[3, 1] = float("inf")
    with pytest.raises(ValueError, match=r"verts: expected finite numbers, got inf at \[3, 1\]"):
        torch.func.grad(total)(bad)
