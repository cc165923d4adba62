"""Meshes, scenes and cameras copied, pickled, saved and cut from their graph: what comes back renders the same bits."""

from __future__ import annotations

import copy
import io
import pickle
from collections.abc import Callable

import pytest
import torch
from scenes import cube, front_camera
from torch import Tensor

import edgegrad as eg

CAMERA = front_camera(8)
TEXTURED = eg.Mesh(
    cube().verts + 0.3,
    cube().faces,
    texture=torch.rand(4, 5, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
    uvs=cube().verts[:, :2].contiguous(),
    uv_faces=cube().faces,
)
SCENE = eg.Scene([cube(), TEXTURED], torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))
OBJECTS = {"mesh": TEXTURED, "scene": SCENE, "camera": CAMERA}


def pickled(thing: object) -> object:
    return pickle.loads(pickle.dumps(thing))


def saved(thing: object) -> object:
    """Return what torch.load reads from a file of torch.save, as a whole object."""
    stream = io.BytesIO()
    torch.save(thing, stream)
    stream.seek(0)
    return torch.load(stream, weights_only=False)


def image(thing: object) -> Tensor:
    return eg.render(SCENE, thing, 4, seed=0) if isinstance(thing, eg.Camera) else eg.render(thing, CAMERA, 4, seed=0)


def tensors(thing: object) -> dict[str, Tensor]:
    """All tensors of a mesh, a scene or a camera, by name."""
    if isinstance(thing, eg.Scene):
        found = {f"{i}.{name}": t for i, mesh in enumerate(thing.meshes) for name, t in tensors(mesh).items()}
        return found if thing.background is None else {**found, "background": thing.background}
    return {name: value for name, value in vars(thing).items() if isinstance(value, Tensor)}


def with_gradients(thing: object) -> object:
    """Return the same with leaves that require gradients in place of its floating-point tensors."""
    if isinstance(thing, eg.Scene):
        background = thing.background.clone().requires_grad_()
        return eg.Scene([with_gradients(mesh) for mesh in thing.meshes], background)
    leaves = {n: t.clone().requires_grad_() for n, t in tensors(thing).items() if t.is_floating_point()}
    return thing.replace(**leaves)


@pytest.mark.parametrize("name", OBJECTS)
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickled, saved])
def test_round_trip(name: str, copied: Callable[[object], object]):
    before = with_gradients(OBJECTS[name])
    after = copied(before)
    assert type(after) is type(before) and repr(after) == repr(before)
    old, new = tensors(before), tensors(after)
    assert old.keys() == new.keys() and len(old) >= 2
    for key in old:
        assert torch.equal(old[key], new[key]) and old[key].dtype == new[key].dtype
        assert old[key].requires_grad == new[key].requires_grad
        assert (old[key].data_ptr() == new[key].data_ptr()) == (copied is copy.copy)
    assert torch.equal(image(after), image(before))
    image(after).sum().backward()
    assert any(t.grad is not None and bool(t.grad.any()) for t in new.values())
    assert copied is copy.copy or all(t.grad is None for t in old.values())


@pytest.mark.parametrize("name", OBJECTS)
def test_detach_cuts_the_graph(name: str):
    """Deepcopy needs this, for torch copies no tensor that was computed."""
    leaves = with_gradients(OBJECTS[name])
    computed = leaves.to(torch.float32)
    with pytest.raises(RuntimeError, match="deepcopy"):
        copy.deepcopy(computed)
    free = computed.detach()
    assert repr(free) == repr(computed) and not image(free).requires_grad and image(computed).requires_grad
    assert torch.equal(image(free), image(computed))
    assert not any(t.requires_grad for t in tensors(free).values())
    for key, value in tensors(computed).items():
        assert tensors(free)[key].data_ptr() == value.data_ptr()  # nothing is copied
    assert torch.equal(image(copy.deepcopy(free)), image(computed))
    if isinstance(free, eg.Camera):
        assert free.size == computed.size and free.projection == computed.projection


def test_detach_without_background_and_in_a_batch():
    assert eg.Scene(cube()).detach().background is None
    batch = eg.Camera.stack([CAMERA, CAMERA.crop(1, 2, 8, 8)])
    assert batch.detach().batch == 2
    flat = CAMERA.replace(projection="orthographic")
    assert flat.detach().projection == "orthographic"


def test_a_batch_of_cameras_round_trips():
    batch = eg.Camera.stack([CAMERA, CAMERA.crop(1, 2, 8, 8)])
    for copied in (copy.copy, copy.deepcopy, pickled, saved):
        assert torch.equal(image(copied(batch)), image(batch))


def test_malformed_values_in_a_pickle_do_not_pass():
    """A pickle is not checked when it is read, so the render must notice."""
    mesh = pickled(TEXTURED)
    mesh.verts[2, 1] = torch.nan
    with pytest.raises(ValueError, match=r"verts: expected finite numbers, got nan at \[2, 1\]"):
        image(pickled(mesh))
