"""plan(): each term runs only where it is needed. The kernel tells what runs when render() calls it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from planned_scenes import CAMERA, F64, KINDS, creased, inside, nowhere, one_colour, requiring, textured
from scenes import cube, front_camera, icosphere, occluded_triangle, one_triangle

import edgegrad as eg
from edgegrad.kernel import operators
from edgegrad.kernel.flat import flatten
from edgegrad.kernel.request import label, make_request, required
from edgegrad.library import core

PARTS = ("view", "surface measure", "surface rays", "surface scatter", "curves", "edge rays", "edge scatter")
COUNTS = ("surface_samples", "edge_samples", "silhouettes", "creases")


SCENES = {
    "triangle": one_triangle,
    "triangles": occluded_triangle,
    "plain": lambda: cube().replace(colors=None),
    "one colour": one_colour,
    "creases": creased,
    "texture": textured,
    "inside": inside,
    "nowhere": nowhere,
}
WANTED = [(kind,) for kind in KINDS] + [(), KINDS, ("verts", "colors"), ("background", "K")]


@pytest.fixture
def kernel(monkeypatch):
    """Record what the kernel is given and says when render() and the backward pass call it."""
    seen = SimpleNamespace(scenes=[], forward=[], backward=[], grads=None, adjoint=None, everything=False)
    forward, backward, scene = operators.forward_kernel, operators.backward_kernel, operators.kernel_scene

    def watched_forward(request):
        result = forward(request)
        seen.forward += result[-1]
        return result

    def watched_backward(adjoint, hits, request, wanted, **options):
        if seen.everything:
            hits = hits._replace(depth=torch.full_like(hits.depth, torch.inf), seen=torch.ones_like(hits.seen))
        seen.adjoint = adjoint
        seen.grads, profiles = backward(adjoint, hits, request, wanted, **options)
        seen.backward += profiles
        return seen.grads, profiles

    def watched_scene(flat):
        seen.scenes.append(flat)
        return scene(flat)

    monkeypatch.setattr(operators, "forward_kernel", watched_forward)
    monkeypatch.setattr(operators, "backward_kernel", watched_backward)
    monkeypatch.setattr(operators, "kernel_scene", watched_scene)
    return seen


def step(kernel, scene, camera=CAMERA, kinds=(), adjoint=None, **options) -> dict[str, float]:
    """Return what the kernel did in the backward pass of render(), summed over the cameras; zeros if there was none."""
    scene, camera = requiring(scene, camera, kinds)
    kernel.scenes.clear(), kernel.forward.clear(), kernel.backward.clear()
    image = eg.render(scene, camera, **{"seed": 0, "spp": 4, **options})
    if image.requires_grad:
        image.backward(torch.ones_like(image) if adjoint is None else adjoint)
    done = {name: 0.0 for name in (*COUNTS, *PARTS)}
    for profile in kernel.backward:
        done = {name: done[name] + profile[name] for name in done}
    return done


INTERIOR = ("surface_samples", "surface measure", "surface rays", "surface scatter")
BOUNDARY = ("edge_samples", "silhouettes", "creases", "curves", "edge rays", "edge scatter")


def ran(done: dict[str, float], names: tuple[str, ...]) -> set[str]:
    return {name for name in names if done[name] != 0}


# -- the plan says what happens ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_plan_is_what_the_kernel_does(name, kernel):
    """On and off, and counts, for all that may require a gradient."""
    kernel.everything = True
    for kinds in WANTED:
        for options in ({}, {"visibility": False}):
            scene, camera = requiring(SCENES[name](), CAMERA, kinds)
            planned = eg.plan(scene, camera, 4, **options)
            done = step(kernel, SCENES[name](), kinds=kinds, **options)
            case = (name, kinds, options, planned)
            # An adjoint that is the same everywhere lets small faces do with fewer, but never with less than a sixteenth.
            most, taken = planned["interior"].samples, done["surface_samples"]
            assert most / 16 <= taken <= most, case
            # Creases have controls too, and take a sixty-fourth at least.
            most, taken = planned["boundary"].samples, done["edge_samples"]
            assert most / 64 <= taken <= most and (planned["creases"].on or taken == most), case
            for term, part in (
                ("view", "view"), ("interior", "surface rays"), ("topology", "curves"), ("boundary", "edge rays"),
                ("silhouettes", "silhouettes"), ("creases", "creases"),
            ):  # fmt: skip
                assert planned[term].on == (done[part] > 0), (term, *case)
            wanted = [planned[f"{kind} gradient"].on for kind in KINDS]
            assert wanted == [bool(kernel.backward) and k in map(label, kernel.grads) for k in KINDS], case
            assert planned["kept for backward"].on == bool(kernel.backward), case
            for term in planned.values():
                assert term.on or (term.samples == 0 and term.bytes == 0 and term.why), case


def test_samples_are_an_upper_bound(kernel):
    """Fewer are taken where the adjoint is zero, or the image saw nothing."""
    scene, camera = requiring(icosphere(3), CAMERA, ("verts",))
    planned = eg.plan(scene, camera, 1)
    adjoint = torch.zeros(24, 24, 3, dtype=F64)
    adjoint[:, :8] = 1.0
    everything, some = (step(kernel, scene, kinds=("verts",), spp=1, adjoint=a) for a in (None, adjoint))
    assert 0 < some["surface_samples"] < everything["surface_samples"] < planned["interior"].samples
    assert 0 < some["edge_samples"] < everything["edge_samples"] == planned["boundary"].samples


def test_options_reach_the_plan():
    scene, camera = requiring(one_triangle(), CAMERA, ("verts",))
    planned = eg.plan(scene, camera, 7, sampling=eg.Sampling(surface=123, edges=45), filter="gaussian", seed=3)
    assert planned["image"].samples == 24 * 24 * 7
    assert planned["interior"].samples == 123 and planned["boundary"].samples == 45
    assert planned.samples == 24 * 24 * 7 + 123 + 45


def test_batches_add_up(kernel):
    kernel.everything = True
    one = CAMERA.world_to_camera
    batch = CAMERA.replace(world_to_camera=torch.stack([one, one, one]))
    scene, camera = requiring(creased(), batch, ("verts", "world_to_camera"))
    planned, single = eg.plan(scene, camera, 4), eg.plan(*requiring(creased(), CAMERA, ("verts", "K")), 4)
    done = step(kernel, creased(), batch, ("verts", "world_to_camera"))
    for term in ("image", "interior", "boundary"):
        assert planned[term].samples == 3 * single[term].samples
    most, taken = planned["boundary"].samples, done["edge_samples"]
    assert most / 64 <= taken <= most and len(kernel.backward) == 3
    assert "3 cameras" in planned["image"].why


def test_no_grad(kernel):
    scene, camera = requiring(textured(), CAMERA, KINDS)
    with torch.no_grad():
        planned = eg.plan(scene, camera)
        assert not eg.render(scene, camera, spp=4, seed=0).requires_grad
    assert [name for name, term in planned.items() if term.on] == ["scene", "ray structure", "image", "textures"]
    assert not kernel.backward


# -- what a scene lacks, it does not pay for: a test for each row -----------------------------------------------------


def test_scene_is_copied_only_if_it_must_be(kernel):
    mesh = cube().replace(faces=cube().faces.int())
    step(kernel, mesh)
    assert kernel.scenes[0].verts.data_ptr() == mesh.verts.data_ptr()
    assert kernel.scenes[0].faces.data_ptr() == mesh.faces.data_ptr() == kernel.scenes[0].corners.data_ptr()
    assert eg.plan(mesh, CAMERA)["scene"].bytes == 24  # the black background, three doubles
    assert not eg.plan(eg.Scene(mesh, torch.zeros(3, dtype=F64)), CAMERA)["scene"].on
    step(kernel, mesh.to(torch.float32))
    copied = kernel.scenes[0].verts.nbytes
    assert kernel.scenes[0].verts.dtype == F64
    assert eg.plan(mesh.to(torch.float32), CAMERA)["scene"].bytes == copied + 12


def test_colours_of_vertices_have_no_creases_in_a_scene_of_several_meshes(kernel):
    """One array for faces and corners tells the kernel so; else it looked at every edge for a jump."""
    assert step(kernel, eg.Scene([cube(), cube(0.3)]), kinds=("verts",))["creases"] == 0
    flat = kernel.scenes[0]
    assert flat.corners.data_ptr() == flat.faces.data_ptr() and flat.faces.max() == 15
    step(kernel, eg.Scene([cube(), creased()]), kinds=("verts",))
    assert kernel.scenes[1].corners.data_ptr() != kernel.scenes[1].faces.data_ptr()


def built(mesh, camera=CAMERA, kinds=(), **options) -> tuple[bool, bool]:
    """Whether the kernel built the ray structure in the forward pass, and found the edges in the backward pass."""
    scene, camera = requiring(mesh, camera, kinds)
    request = make_request(scene, camera, 1, **options)
    image, hits, (forward,) = operators.forward_kernel(request)
    if not kinds:
        return bool(forward["built rays"]), False
    backward = operators.backward_kernel(torch.ones_like(image), hits, request, required(request))[1][0]
    assert not backward["built rays"]
    return bool(forward["built rays"]), bool(backward["built edges"])


def test_ray_structure_is_rebuilt_only_when_vertices_moved():
    mesh = icosphere(3)
    core.clear_geometry()
    assert built(mesh) == (True, False)
    for same in (mesh, mesh.replace(colors=mesh.verts), mesh.replace(verts=mesh.verts.clone())):
        assert built(same) == built(same, front_camera(16)) == (False, False)
    assert built(mesh.transformed(scale=1.01)) == (True, False)


def test_topology_is_built_once_for_a_set_of_faces():
    mesh = icosphere(3)
    core.clear_geometry()
    for kinds, options in ((("colors",), {}), (("background",), {}), (("verts",), {"visibility": False})):
        assert not built(mesh, kinds=kinds, **options)[1]
    assert built(mesh, kinds=("verts",)) == (False, True)
    assert built(mesh, kinds=("verts",)) == (False, False)
    # Moved vertices may have to be welded anew, which a closed mesh does not pay for.
    moved = mesh.transformed(scale=1.01)
    assert built(moved, kinds=("world_to_camera",)) == (True, True)
    assert built(moved, kinds=("world_to_camera",)) == (False, False)


def test_no_texture_code_without_a_texture(kernel):
    """The kernel tells textured faces by a number a face; without textures it gets none, nor anything to look up."""
    step(kernel, cube())
    flat = kernel.scenes[0]
    assert not any(t.numel() for t in (flat.texels, flat.uvs, flat.textures, flat.face_texture))
    assert not eg.plan(cube(), CAMERA)["textures"].on
    step(kernel, textured())
    assert kernel.scenes[0].texels.numel() and kernel.scenes[0].face_texture.tolist()[:2] == [0, 0]
    assert eg.plan(textured(), CAMERA)["textures"].on


def test_nothing_but_the_plan_is_kept_for_the_backward_pass():
    """Tensors that autograd saves: the inputs, coverage, depth, and which faces were hit."""
    scene, camera = requiring(cube(), CAMERA, ("verts",))
    node = eg.render(scene, camera, spp=4, seed=0).grad_fn
    while not hasattr(node, "saved_tensors"):
        node = node.next_functions[0][0]
    coverage, depth, hit, seen, *inputs = node.saved_tensors
    assert (
        coverage.nbytes + depth.nbytes + hit.nbytes + seen.nbytes == eg.plan(scene, camera)["kept for backward"].bytes
    )
    flat = [t for t in flatten(scene) if isinstance(t, torch.Tensor)] + [camera.world_to_camera[None], camera.K[None]]
    flat.append(torch.zeros(1, 8))  # distortion
    flat += [torch.zeros(1, 8, 0), torch.zeros(12, 0)]  # attributes of vertices and of faces: none
    flat += [torch.zeros(()), torch.zeros(())]  # the seeds of the image and of the gradient
    assert [tuple(t.shape) for t in inputs] == [tuple(t.shape) for t in flat]
    assert eg.render(cube(), CAMERA, spp=4, seed=0).grad_fn is None
    assert eg.plan(cube(), CAMERA)["kept for backward"].bytes == 0


def test_the_adjoint_is_not_copied(kernel):
    adjoint = torch.ones(24, 24, 3, dtype=F64)
    step(kernel, cube(), kinds=("verts",), adjoint=adjoint)
    assert kernel.adjoint.data_ptr() == adjoint.data_ptr()


def test_background_alone_runs_no_term(kernel):
    done = step(kernel, textured(), kinds=("background",))
    assert kernel.backward and not ran(done, tuple(done))
    assert ran(step(kernel, textured(), kinds=("background", "verts")), ("view",))


def test_no_interior_where_radiance_does_not_vary(kernel):
    assert not ran(step(kernel, one_colour(), kinds=("verts", "world_to_camera", "K")), INTERIOR)
    assert ran(step(kernel, one_colour(), kinds=("verts", "colors")), INTERIOR) == set(INTERIOR)
    assert ran(step(kernel, cube(), kinds=("verts",)), INTERIOR) == set(INTERIOR)


@pytest.mark.parametrize("kinds", [("colors",), ("uvs",), ("texture",), ("background",), KINDS[1:5]])
def test_no_boundary_where_nothing_moves(kinds, kernel):
    assert not ran(step(kernel, textured(), kinds=kinds), BOUNDARY)
    assert not ran(step(kernel, textured(), kinds=KINDS, visibility=False), BOUNDARY)
    for kind in ("verts", "world_to_camera", "K"):
        assert ran(step(kernel, textured(), kinds=(*kinds, kind)), BOUNDARY) >= {"edge_samples", "edge rays", "curves"}


def test_no_silhouettes_without_one_in_view(kernel):
    done = step(kernel, inside(), kinds=("verts",))
    assert not ran(done, ("silhouettes", "creases", "edge_samples", "edge rays", "edge scatter"))
    assert ran(done, ("surface_samples",))
    assert step(kernel, cube(), kinds=("verts",))["silhouettes"] > 0


def test_no_creases_where_nothing_jumps(kernel):
    assert step(kernel, cube(), kinds=("verts",))["creases"] == 0
    assert step(kernel, one_colour(), kinds=("verts",))["creases"] == 0
    assert step(kernel, creased(), kinds=("verts",))["creases"] > 0


@pytest.mark.parametrize("kind", KINDS)
def test_only_what_is_required_is_differentiated(kind, kernel):
    """The kernel gets no array to write to for what is not wanted."""
    step(kernel, textured(), kinds=(kind,))
    assert [label(slot) for slot in kernel.grads] == [kind]
    step(kernel, textured(), kinds=tuple(k for k in KINDS if k != kind))
    assert [k for k in KINDS if k not in map(label, kernel.grads)] == [kind]


@pytest.mark.parametrize("kinds", [("verts",), ("texture",), KINDS])
def test_no_samples_where_the_loss_does_not_look(kinds, kernel):
    done = step(kernel, textured(), kinds=kinds, adjoint=torch.zeros(24, 24, 3, dtype=F64))
    assert kernel.backward and not ran(done, ("surface_samples", "edge_samples", "surface rays", "edge rays"))


# -- memory -----------------------------------------------------------------------------------------------------------

MEASURE = """
import re, sys
import torch
import edgegrad as eg
from scenes import front_camera, icosphere
subdivisions, size, colors = (int(argument) for argument in sys.argv[1:])

def peak():
    return 1024 * int(re.search(r"VmHWM:\\s+(\\d+)", open("/proc/self/status").read())[1])

def step(mesh, camera):
    mesh = mesh.replace(verts=mesh.verts.requires_grad_(), colors=mesh.colors.requires_grad_(bool(colors)))
    eg.render(mesh, camera, spp=1).backward(torch.ones(*camera.size, 3, dtype=torch.float64))

step(icosphere(1), front_camera(8))  # threads and libraries
mesh, camera = icosphere(subdivisions), front_camera(size)
open("/proc/self/clear_refs", "w").write("5")  # the peak from here on
before = peak()
step(mesh, camera)
measured = peak() - before
mesh = mesh.replace(verts=mesh.verts.detach().requires_grad_())
print(measured, eg.plan(mesh, camera, 1).bytes)
"""


@pytest.mark.parametrize(
    ("subdivisions", "size", "colors"),
    [
        pytest.param(5, 360, 1, id="faces and pixels"),
        pytest.param(6, 512, 1, id="more faces and pixels", marks=pytest.mark.slow),
        pytest.param(7, 64, 0, id="faces", marks=pytest.mark.slow),
        pytest.param(3, 1024, 0, id="pixels", marks=pytest.mark.slow),
    ],
)
def test_memory_is_about_as_planned(subdivisions, size, colors):
    """Within a factor of 2. Each case has a process of its own, for one that has been larger before asks for nothing new."""
    if not Path("/proc/self/clear_refs").exists():
        pytest.skip("tells the peak of memory on Linux only")
    arguments = [sys.executable, "-c", MEASURE, *map(str, (subdivisions, size, colors))]
    said = subprocess.run(
        arguments, cwd=Path(__file__).parents[1] / "support", capture_output=True, text=True, check=True
    ).stdout
    measured, planned = map(int, said.split())
    assert 0.5 * measured < planned < 2.0 * measured, said


# -- the table, the data, errors --------------------------------------------------------------------------------------


def test_plan_prints_as_a_table():
    planned = eg.plan(*requiring(creased(), CAMERA, ("verts",)), 4)
    lines = str(planned).splitlines()
    assert len(lines) == 2 + len(planned) and max(map(len, lines)) < 100
    columns = {
        line.index(" on " if term.on else " off") for line, term in zip(lines[1:], planned.values(), strict=False)
    }
    assert len(columns) == 1  # aligned
    assert f"{planned['boundary'].samples:,}" in str(planned) and "visibility=False" not in str(planned)
    assert "visibility=False" in str(eg.plan(*requiring(creased(), CAMERA, ("verts",)), 4, visibility=False))
    assert planned.bytes == sum(term.bytes for term in planned.values()) > 0
    with pytest.raises(KeyError, match=r"boundary, silhouettes.*'shadows'"):
        planned["shadows"]


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"scene": "cube"}, TypeError),
        ({"spp": 0}, ValueError),
        ({"scene": eg.Scene([cube()], torch.zeros(3, 3, 3))}, ValueError),
    ],
)
@pytest.mark.parametrize("function", [eg.plan, eg.profile])
def test_errors_are_those_of_render(function, change, error):
    arguments = {"scene": cube(), "camera": CAMERA, **change}
    with pytest.raises(error) as expected:
        eg.render(**{"seed": 0, **arguments})
    with pytest.raises(error) as got:
        function(**arguments)
    assert str(got.value) == str(expected.value)


def test_with_a_shader():
    scene, camera = requiring(creased(), CAMERA, ("verts",))
    planned = eg.plan(scene, camera, 4, shader=lambda hits: hits.normal)
    assert planned["shader"].on and planned["interior"].on and planned["boundary"].on and planned["samples"].bytes > 0
    assert not planned["creases"].on and "colors gradient" not in planned
    assert eg.plan(scene, camera, 4, shader=lambda hits: hits.normal, sampling=eg.Sampling(creases=True))["creases"].on
    assert not eg.plan(creased(), CAMERA, shader=lambda hits: hits.normal)["boundary"].on
    with torch.no_grad():
        assert not eg.plan(creased(), CAMERA, shader=lambda hits: hits.normal)["samples"].on
    with pytest.raises(ValueError, match=r"shader: expected None, for profile\(\)"):
        eg.profile(scene, camera, shader=lambda hits: hits.normal)


def test_a_shader_that_does_not_fit_is_refused_before_it_runs(monkeypatch: pytest.MonkeyPatch):
    from edgegrad.kernel import memory

    monkeypatch.setattr(memory, "available", lambda: 100 << 20)
    asked = []
    with pytest.raises(MemoryError, match=r"render with a shader: expected to need at most the 105 MB .* lower"):
        eg.render(
            creased(),
            CAMERA,
            shader=lambda hits: asked.append(hits) or hits.normal,
            sampling=eg.Sampling(surface=10**7),
            seed=0,
        )
    assert not asked
