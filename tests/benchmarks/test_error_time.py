"""The report on error against run time: the command end to end on a small triangle, its references, and its error messages."""

from __future__ import annotations

import importlib.util
import json
import math

import pytest
import torch
from PIL import Image
from trimesh.creation import icosphere

import edgegrad as eg
from benchmarks import mitsuba, mitsuba_scene, scenes
from benchmarks.command import INTERRUPTED
from benchmarks.error_time import references
from benchmarks.error_time import run as module
from benchmarks.error_time.__main__ import main
from benchmarks.error_time.methods import Edgegrad, FiniteDifferences, rigid
from benchmarks.error_time.references import QUICK, exact, long_run
from benchmarks.error_time.run import error_time

pytestmark = pytest.mark.unsanitized

OURS = ("edgegrad", "interior", "boundary", "finite-differences")
ASKED = ("--scene", "triangle", "--methods", *OURS, "--size", "32", "--seeds", "2", "--quick")


def run(*arguments):
    return main([str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    assert run(*ASKED, "--out", folder) == 0
    return folder


def document(folder):
    return json.loads((folder / "error-time.json").read_text())


def test_json(measured):
    found = document(measured)
    now = found["settings"]
    assert now["size"] == 32 and now["seeds"] == [0, 1] and now["threads"] == torch.get_num_threads()
    assert all(now[key] for key in ("processor", "torch", "edgegrad", "kernel", "embreex"))
    assert found["scenes"]["triangle"]["reference"]["kind"] == "exact pixel integrals"
    terms = found["scenes"]["triangle"]["terms"]
    assert {"update", "forward", "edge rays", "python"} < set(terms) and all(seconds >= 0 for seconds in terms.values())
    points = found["points"]
    assert {point["method"] for point in points} == {*OURS, "finite-differences-vertices"}
    assert len(points) == 3 * 5
    for point in points:
        assert point["seconds"] > 0 and len(point["seconds_of_seeds"]) == 2
        for metric in point["metrics"].values():
            assert 0 < min(metric["errors"]) <= metric["error"] <= max(metric["errors"])
    # More samples, less error: 16 times as many from the first to the last.
    whole = [point["metrics"]["vertex"]["error"] for point in points if point["method"] == "edgegrad"]
    assert whole[-1] < 0.5 * whole[0] and whole[-1] < 0.05


def test_table_and_figure(measured):
    text = (measured / "error-time.md").read_text()
    assert "one large triangle" in text and text.count("| edgegrad |") == 3 and "without" in text
    assert Image.open(measured / "error-time.png").width > 1000
    names = {"error-time.json", "error-time.md", "error-time.png", "reference-triangle.pt"}
    assert {path.name for path in measured.iterdir()} == names


def test_nothing_is_measured_twice(measured, monkeypatch, capsys):
    def refuse(*arguments):
        raise AssertionError("measured again")

    monkeypatch.setattr(module._Run, "_point", refuse)
    monkeypatch.setattr(references, "exact", refuse)
    before = document(measured)
    assert run(*ASKED, "--out", measured) == 0
    assert document(measured) == before
    assert "15 points are there" in capsys.readouterr().out


def test_other_settings_do_not_mix_and_keep_what_there_was(measured, capsys):
    files = {path: path.read_bytes() for path in measured.iterdir()}
    error_time(measured, ["triangle"], ["interior"], size=16, seeds=2, quick=True)
    assert "of other settings (size); kept as error-time." in capsys.readouterr().out
    assert {point["method"] for point in document(measured)["points"]} == {"interior"}
    # The first settings again: their points come back.
    assert run(*ASKED, "--out", measured) == 0
    assert "15 points are there and not measured again" in capsys.readouterr().out
    assert document(measured) == json.loads(files[measured / "error-time.json"])
    for path in set(measured.iterdir()) - set(files):
        path.unlink()
    for path, content in files.items():
        path.write_bytes(content)


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"settings": {}, "points": []}', '{"settings": {}, "scenes": {}, "points": [{}]}']
)
def test_a_file_of_something_else_is_refused(tmp_path, text, capsys):
    (tmp_path / "error-time.json").write_text(text)
    assert run("--scene", "triangle", "--quick", "--out", tmp_path) == 2
    assert "expected what an earlier run wrote" in capsys.readouterr().err
    assert (tmp_path / "error-time.json").read_text() == text


def test_ctrl_c_keeps_what_is_measured(tmp_path, monkeypatch, capsys):
    whole = Edgegrad.gradient

    def interrupted(self, budget, seed):
        if self.part == "whole" and budget == 1 and seed == 1:
            raise KeyboardInterrupt
        return whole(self, budget, seed)

    asked = ("--scene", "triangle", "--methods", "edgegrad", "--size", 32, "--seeds", 2, "--quick", "--out", tmp_path)
    monkeypatch.setattr(Edgegrad, "gradient", interrupted)
    assert run(*asked) == INTERRUPTED
    points = document(tmp_path)["points"]
    assert [point["budget"] for point in points] == [0.25]
    assert (tmp_path / "error-time.png").exists() and "| edgegrad |" in (tmp_path / "error-time.md").read_text()
    monkeypatch.undo()
    assert run(*asked) == 0
    assert document(tmp_path)["points"][0] == points[0] and len(document(tmp_path)["points"]) == 3


def test_ctrl_c_in_a_reference_keeps_its_runs(tmp_path, monkeypatch, capsys):
    """The runs that are done are not done again, and end in the reference that one go would have given."""
    asked = ("--scene", "quad", "--methods", "interior", "--size", 16, "--seeds", 2, "--quick", "--out", tmp_path)
    gradient, runs = Edgegrad.gradient, []

    def interrupted(self, budget, seed):
        if seed >= references.SEED:
            runs.append((self.part, seed - references.SEED))
        if runs == [("interior", 0), ("interior", 1), ("boundary", 0)]:
            raise KeyboardInterrupt
        return gradient(self, budget, seed)

    monkeypatch.setattr(Edgegrad, "gradient", interrupted)
    assert run(*asked) == INTERRUPTED
    assert f"interrupted; what is measured is kept in {tmp_path}" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {f"reference-quad-interior-{k}.pt" for k in (0, 1)}
    runs.clear()
    assert run(*asked) == 0
    assert runs == [("boundary", 0), ("boundary", 1)]
    assert {path.name for path in tmp_path.glob("*.pt")} == {"reference-quad.pt"}

    scene = scenes.build("quad", 16)
    kept, at_once = references.reference(scene, tmp_path, QUICK), long_run(scene, QUICK)
    torch.testing.assert_close((kept.interior, kept.boundary), (at_once.interior, at_once.boundary))
    assert kept.error.keys() == at_once.error.keys() and kept.check.keys() == {"translation", "rotation"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scene", "cube"), ("scenes", "triangle, sphere", "'cube'")),
        (("--methods", "magic"), ("methods", "finite-differences", "'magic'")),
        (("--scene", "triangle", "--seeds", "1"), ("seeds", "at least 2", "1", "try 5")),
        (("--scene", "triangle", "--mesh", "there.ply"), ("mesh", "scan", "triangle", "add scan")),
        (("--scene", "triangle", "--seeds", "1000000000000"), ("seeds", "from 1 to 1000")),
        (("--scene", "triangle", "--size", "100000"), ("size", "from 1 to 4096", "100000")),
        # Known to be wrong before the triangle is measured.
        (("--scene", "triangle", "scan", "--mesh", "there.ply"), ("there.ply", "no such file")),
        (("--scene", "triangle", "scan", "--mesh", __file__), ("test_error_time.py", ".obj", "'.py'")),
    ],
)
def test_errors(arguments, words, tmp_path, capsys):
    assert run(*arguments, "--quick", "--out", tmp_path) == 2
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
    assert not list(tmp_path.iterdir())


def test_a_file_of_someone_else_is_not_overwritten(tmp_path, capsys):
    (tmp_path / "error-time.json").write_text("[1, 2]")
    assert run(*ASKED, "--out", tmp_path) == 2
    assert "expected what an earlier run wrote" in capsys.readouterr().err
    assert (tmp_path / "error-time.json").read_text() == "[1, 2]"


@pytest.mark.parametrize("limit", ["0", "-1", "inf"])
def test_limit(limit, tmp_path, capsys):
    assert run("--limit", limit, "--out", tmp_path) == 2
    assert "limit" in capsys.readouterr().err


def test_slow_points_are_left_out(tmp_path):
    found, _ = error_time(tmp_path, ["triangle"], ["edgegrad"], size=16, seeds=2, limit=1e-9, quick=True)
    assert len(found["points"]) == 1  # the first says that the others cost more


def test_sweep_stops_where_the_next_point_would_cost_too_much():
    assert module._expected([], 4) == 0
    assert module._expected([(1, 2.0)], 4) == 2.0  # nothing is known of how it grows
    assert module._expected([(1, 2.0), (4, 2.3)], 16) == pytest.approx(3.5)  # mostly a cost that does not grow


@pytest.mark.slow
@pytest.mark.parametrize("scene", scenes.LIT)
def test_lit_scenes(scene, tmp_path):
    """The reference is computed anew. Their terms are not timed alone."""
    document, _ = error_time(tmp_path, [scene], ["edgegrad", "boundary"], size=16, seeds=2, limit=60.0, quick=True)
    of_scene = document["scenes"][scene]
    assert "not timed apart" in of_scene["left_out"]["boundary"]
    assert 0 < of_scene["reference"]["error"]["boundary"]["translation"] < 0.5
    assert [point["method"] for point in document["points"]] == ["edgegrad"] * 3


def test_scan_is_left_out_without_a_mesh(tmp_path, monkeypatch, capsys):
    def nothing(size, path):
        raise ImportError("no pyvista")

    monkeypatch.setitem(scenes.SCENES, "scan", nothing)
    monkeypatch.setattr(scenes, "_scan", nothing)
    assert run("--scene", "scan", "--quick", "--out", tmp_path) == 0
    assert "scan: left out; give one with --mesh PATH" in capsys.readouterr().out


# -- references -------------------------------------------------------------------------------------------------------


def test_references_agree():
    """Exact integrals and long runs know nothing of each other; each term within 5 standard errors of the runs."""
    scene = scenes.build("triangle", 32)
    a, b = exact(scene), long_run(scene, references.Effort(1 << 18, 1 << 16, 1.0, runs=12))
    norm = float(a.metrics(scene)["vertex"].norm())
    for part in references.PARTS:
        for name, correct in a.metrics(scene, part).items():
            error = b.error[part][name] * float(a.metrics(scene)[name].norm())
            assert (b.metrics(scene, part)[name] - correct).norm() < 5.0 * error, (part, name)
            assert error < 0.01 * norm


def test_references_that_are_wrong_are_noticed():
    """Finite differences show a gradient without its boundary."""
    scene = scenes.build("triangle", 128)
    correct = exact(scene)
    effort = references.Effort(check_spp=64, check_seeds=3)
    assert not any(references.disagrees(entry) for entry in references.check(scene, correct, effort).values())
    correct.boundary = torch.zeros_like(correct.boundary)
    assert all(references.disagrees(entry) for entry in references.check(scene, correct, effort).values())


def test_reference_is_kept(tmp_path, monkeypatch):
    scene = scenes.build("triangle", 16)
    first = references.reference(scene, tmp_path, QUICK)
    monkeypatch.setattr(references, "exact", None)  # not called again
    again = references.reference(scene, tmp_path, QUICK)
    assert torch.equal(first.interior, again.interior) and first.check == again.check
    (tmp_path / "reference-triangle.pt").write_bytes(b"nonsense")
    monkeypatch.undo()
    said = []
    references.reference(scene, tmp_path, QUICK, said.append)
    assert said == ["reference-triangle.pt cannot be read: it is computed again"]


# -- scenes and methods -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [name for name in scenes.SCENES if name not in ("million", "scan", *scenes.LIT)])
def test_scenes(name):
    scene = scenes.build(name, 32)
    image = eg.render(scene.scene, scene.camera, spp=4, seed=0)
    assert image.shape == scene.adjoint.shape == (32, 32, 3) and image.dtype == torch.float32
    background = (image == torch.tensor(scenes.BACKGROUND)).all(-1).double().mean()
    assert (background == 0) if name == "quad" else (0.1 < background < 0.9)
    assert scene.fingerprint == scenes.build(name, 32).fingerprint != scenes.build(name, 33).fingerprint


def test_scan_of_the_user(tmp_path):
    mesh = scenes.build("triangle").scene.meshes[0]
    lines = [f"v {x} {y} {z}" for x, y, z in mesh.verts.tolist()]
    (tmp_path / "mesh.obj").write_text("\n".join([*lines, "f 1 2 3", ""]))
    scene = scenes.build("scan", 32, tmp_path / "mesh.obj")
    assert scene.faces == 1 and scene.title == "mesh, 1 faces"


def test_rigid_gradients_are_those_of_motions():
    """Σ g and Σ (p − c) × g against autograd through the motion."""
    scene = scenes.build("slivers", 16)
    weights = torch.randn(scene.verts.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    shift, turn = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    arm = scene.verts - scene.center
    moved = scene.center + arm + torch.linalg.cross(turn.expand_as(arm), arm) + shift
    by_autograd = torch.autograd.grad((moved * weights).sum(), (shift, turn))
    found = rigid(scene, weights)
    torch.testing.assert_close((found["translation"], found["rotation"]), by_autograd)


def test_finite_differences_turn_the_right_way():
    """Its rotation moves the vertices to first order by ω × (p − c)."""
    scene = scenes.build("slivers", 16)
    arm, omega = scene.verts - scene.center, torch.tensor([1e-6, -2e-6, 3e-6], dtype=torch.float64)
    moved = FiniteDifferences(scene)._turned(omega) - scene.verts
    torch.testing.assert_close(moved, torch.linalg.cross(omega.expand_as(arm), arm), rtol=1e-4, atol=1e-10)


# -- Mitsuba ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def open_ball():
    """Plain, small, far from the origin and with a hole that shows its inside, as scans are: all of its gradient is at edges."""
    ball = icosphere(3)
    where = torch.tensor([3.0, -2.0, 1.0])
    kept = ball.triangles_center[:, 1] < 0.7
    mesh = eg.Mesh(where + 0.05 * torch.tensor(ball.vertices).float(), torch.tensor(ball.faces[kept]))
    camera = eg.Camera.look_at(where + torch.tensor([0.05, 0.12, 0.18]), where, (0, 1, 0), 35.0, (64, 64))
    scene = eg.Scene([mesh], scenes.background().float())
    adjoint = scenes.smooth_adjoint(64, 64, 3).float()
    return scenes.ReportScene("ball", "a ball with a hole", scene, camera.to(torch.float64), adjoint)


def test_what_mitsuba_gets_is_the_same_view(open_ball):
    scene, camera, scale = mitsuba_scene.resized(open_ball.scene, open_ball.camera)
    assert scene.meshes[0].verts.norm(dim=1).max() == pytest.approx(mitsuba_scene.RADIUS)
    assert scale == pytest.approx(mitsuba_scene.RADIUS / 0.05, rel=0.2)
    points = [
        view.project(s.meshes[0].verts.double()) for s, view in ((scene, camera), (open_ball.scene, open_ball.camera))
    ]
    torch.testing.assert_close(*points, rtol=0, atol=1e-9)


def test_mitsuba_gets_the_same_sky() -> None:
    """The first and the last row are at the poles, as one finds by asking Mitsuba's `envmap`, where it is there."""
    image = torch.rand((5, 8, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    theirs, ours = mitsuba.sky_image(image), eg.lights.Environment(image)
    theta = math.pi * (torch.arange(40, dtype=torch.float64) + 0.3) / 40
    phi = 2 * math.pi * (3 + 0.5) / 8 - math.pi  # of the centres of a column
    d = torch.stack([theta.sin() * math.sin(phi), theta.cos(), -theta.sin() * math.cos(phi)], 1)
    row = theta / math.pi * (len(theirs) - 1)
    above = row.floor().long()
    found = torch.lerp(theirs[above, 3], theirs[above + 1, 3], (row - above)[:, None])
    assert torch.allclose(found, ours.towards(d), rtol=0, atol=1e-12)
    if importlib.util.find_spec("mitsuba") is None:
        return
    mi = importlib.import_module("mitsuba")
    mi.set_variant("scalar_rgb")
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 180)
    sky = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(theirs.float().numpy()), "to_world": turned})
    at = mi.SurfaceInteraction3f()
    for direction, expected in zip(d.tolist(), found.tolist(), strict=True):
        at.wi = [-x for x in direction]
        assert list(sky.eval(at)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("integrator", mitsuba.INTEGRATORS)
def test_mitsuba_agrees_on_a_plain_open_mesh(open_ball, integrator):
    """Within 5 standard errors, which are well below the gradient."""
    pytest.importorskip("mitsuba")
    if mitsuba.available() is None:
        pytest.skip("Mitsuba finds no LLVM")
    peer = mitsuba.Mitsuba(open_ball.scene, open_ball.camera, open_ball.adjoint, integrator)
    ours = Edgegrad(open_ball).gradient(16, 0).metrics()
    theirs = [rigid(open_ball, torch.cat(peer.gradient(256, seed)[0])) for seed in range(12)]
    for name, correct in ours.items():
        runs = [run[name] for run in theirs]
        error = references.standard_error(runs)
        assert error < 0.03 * correct.norm(), name
        assert (torch.stack(runs).mean(0) - correct).norm() < 5.0 * error, name
