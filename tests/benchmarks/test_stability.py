"""Extreme cases: image and gradient against independent references, and the report that measures them.

The cases are those of `python -m benchmarks.stability`. Here each must have its verdict from few seeds, and in `make test-slow`
from as many as the report takes.
"""

from __future__ import annotations

import dataclasses
import json
import math

import pytest
import torch
from PIL import Image
from scenes import cube, front_camera, one_triangle

import edgegrad as eg
from benchmarks.command import INTERRUPTED
from benchmarks.stability import fits, statistics, steps
from benchmarks.stability import run as stability
from benchmarks.stability.__main__ import main
from benchmarks.stability.cases import CASES, bounced, measure
from benchmarks.stability.cases.case import Case, Problem, everything
from benchmarks.stability.cases.measure import LIMIT, NOISY, QUICK, RAISED, RIGHT, WRONG, Effort
from benchmarks.stability.painted import PAINTED
from edgegrad.fit.laplacian import LaplacianSolver

FAST = [name for name, case in CASES.items() if not case.slow and case.group not in ("light", "bounces")]
# Of each there is another that is more extreme, or differs in one thing.
LIKE_OTHERS = {
    "scale-1e-3", "scale-1e3", "offset-1e3", "fov-120", "inside-smooth", "on-surface", "4096x1",
    "sliver-long-smooth", "sliver-thin-smooth", "fan-3", "fan-5", "soup-64", "through-each-other-orthographic",
    "ortho-box-32", "copies-32", "copies-sphere", "t-junction-32", "t-junction-silhouette-32", "stacked-32",
    "ortho-box-plain", "stacked-plain", "lattice-behind-plain", "lattice-isometric-dent", "adjoint-1e8",
    "emerging-1e-3", "hiding-1e-3",
}  # fmt: skip


def check(name: str, effort: Effort) -> dict:
    """Measure a case and assert that it is right, or at a known limit: what has become right is none any longer.

    Time has no limit. Else a busy machine would have fewer seeds, and with more noise more is right.
    """
    row = measure.measure(CASES[name], dataclasses.replace(effort, seconds=math.inf))
    assert row["verdict"] == (LIMIT if CASES[name].limit else RIGHT), row
    return row


# These reach lines of the kernel that other tests of `make sanitize` do not.
WATCHED = {"crop", "orthographic", "camera-plane", "soup", "copies-3", "t-junction", "stacked", "ortho-two-colours"}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.watched] if name in WATCHED else [])
        for name in FAST
        if name not in LIKE_OTHERS
    ],
)
def test_case(name):
    check(name, QUICK)


def test_cases_that_wait_for_full_accuracy_are_there():
    assert set(FAST) >= LIKE_OTHERS


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_case_at_full_accuracy(name):
    row = check(name, Effort())
    if (
        CASES[name].more > 1 or CASES[name].group == "bounces"
    ):  # for a gradient that is 5 % off to be wrong, beyond four standard errors and 2 %
        assert max(part["noise"] for part in row["parts"].values()) < 0.0075, row


# -- the references are checked ---------------------------------------------------------------------------------------

LARGE = {"two-details", "two-details-far", "copies-sphere"}  # a second and more for one image


def own_differences(problem: Problem, name: str) -> list[float]:
    """How far the derivative of the exact image along its gradient is from its own central difference, relative, for
    ever shorter steps. NaN where the step goes where there is no exact image: parts through each other, or out of view."""
    assert problem.exact is not None
    image, grads = measure.exact(problem, problem.exact)
    adjoint = problem.cotangent(image)
    parts = {key: value.double() for key, value in problem.parts.items()}
    size = float(grads[name].norm())
    if size < 1e-9 * float(adjoint.norm()):
        return [0.0, 0.0]
    direction = grads[name] / size
    loss, place = float((adjoint * image).abs().sum()), float(parts[name].abs().max())
    off = []
    for share in (10.0**-k for k in range(4, 15)):
        # A step that changes the loss by its share, and coordinates by no more than ten of it: other parts may be brighter.
        h = min(share * loss / size, 10.0 * share * place / float(direction.abs().max()) if place > 0 else math.inf)
        try:
            with torch.no_grad():
                high, low = (problem.exact({**parts, name: parts[name] + s * h * direction}) for s in (1.0, -1.0))
            off.append(abs(float(((high - low) * adjoint).sum()) / (2.0 * h) / size - 1.0))
        except (AssertionError, ValueError) as error:
            assert "intersect" in str(error) or "expected at least one Mesh" in str(error)
            off.append(math.nan)
        if all(entry < 2e-3 for entry in off[-2:]) and len(off) > 1:
            break
    return off


def references(names):
    # Of those that have an exact image.
    return [name for name in names if name not in LARGE | {"tangled"} and CASES[name].group != "light"]


@pytest.mark.slow
@pytest.mark.parametrize("name", references(CASES))
def test_references_agree_with_their_own_differences(name):
    problem = CASES[name].build()
    for part in problem.parts:
        off = own_differences(problem, part)
        # Two steps, one a tenth of the other: what differences give there no longer depends on them.
        assert all(entry < 2e-3 for entry in off[-2:]), (part, off)


def test_a_clipped_scene_is_the_same():
    """Clipped to the view, a scene before the camera has the same image and gradient as whole."""
    camera = front_camera(32)
    far = torch.tensor([[0.0, 0.0, 9.0], [0.1, 0.0, 9.0], [0.0, 0.1, 9.5]], dtype=torch.float64)  # behind the camera
    behind = eg.Mesh(far, torch.tensor([[0, 1, 2]]), colors=torch.zeros((3, 3), dtype=torch.float64))
    plain = everything(eg.Scene([cube(0.9)], torch.zeros(3, dtype=torch.float64)), camera)
    clipped = everything(
        eg.Scene([cube(0.9)], torch.zeros(3, dtype=torch.float64)), camera,
        equal=lambda scene: scene.replace(meshes=[*scene.meshes, behind]),
    )  # fmt: skip
    assert plain.exact is not None and clipped.exact is not None
    (image, grads), (image_2, grads_2) = (measure.exact(p, p.exact) for p in (plain, clipped))
    torch.testing.assert_close(image_2, image)
    torch.testing.assert_close(grads_2, grads)


# -- the verdicts are checked -----------------------------------------------------------------------------------------


def case_of(problem: Problem, **fields) -> Case:
    return Case("test", "test", "nothing", lambda: problem, **fields)


@pytest.fixture
def triangle():
    return everything(one_triangle(), front_camera(32))


def test_a_wrong_gradient_is_rejected(triangle):
    """The interior alone; and a gradient with a single part 3 % off."""
    row = measure.measure(case_of(triangle), QUICK)
    assert row["verdict"] == RIGHT
    interior = dataclasses.replace(triangle, options={**triangle.options, "visibility": False})
    assert measure.measure(case_of(interior), QUICK)["verdict"] == WRONG

    def stretched(parts):
        return triangle.make({**parts, "skew": 1.03 * parts["skew"] - 0.03 * parts["skew"].detach()})

    row = measure.measure(case_of(dataclasses.replace(triangle, make=stretched)), QUICK)
    assert (row["verdict"], row["worst"]) == (WRONG, "skew")


@pytest.mark.parametrize(
    "name",
    [
        *("keyhole", "bounced-mirror", "bounced-million"),
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("all-cancels", "bounced-standing")),
    ],
)
def test_bounces_without_borders_are_rejected(name, monkeypatch):
    """The gradient is wrong without secondary edges."""
    if name == "bounced-million":
        monkeypatch.setitem(CASES, name, dataclasses.replace(CASES[name], build=lambda: bounced.million(3)))
    problem = CASES[name].build()
    options = {**problem.options, "sampling": eg.Sampling(surface=20_000, edges=1), "visibility": False}
    row = measure.measure(case_of(dataclasses.replace(problem, options=options, spp=16)), Effort(seeds=(4,)))
    assert row["verdict"] == WRONG, row


def test_a_wrong_image_is_rejected(triangle):
    def brighter(parts):
        return triangle.exact(parts) * 1.0 + 0.03 * triangle.exact(parts).detach()

    row = measure.measure(case_of(dataclasses.replace(triangle, exact=brighter)), QUICK)
    assert (row["verdict"], row["worst"]) == (WRONG, "image")


def test_noise_does_not_pass(triangle):
    few = dataclasses.replace(triangle, options={"sampling": eg.Sampling(surface=3, edges=3)}, spp=1)
    assert measure.measure(case_of(few), Effort(seeds=(16,)))["verdict"] == NOISY


def test_nan_is_wrong(triangle):
    def broken(parts):
        image = triangle.exact(parts)
        return image + torch.where(image > 0.5, math.nan, 0.0)

    row = measure.measure(case_of(dataclasses.replace(triangle, exact=broken)), Effort(seeds=(4,)))
    assert row["verdict"] == WRONG


def test_a_limit_has_a_size(triangle):
    interior = dataclasses.replace(triangle, options={**triangle.options, "visibility": False})
    assert measure.measure(case_of(interior, limit="no boundary", most=3.0), QUICK)["verdict"] == LIMIT
    assert measure.measure(case_of(interior, limit="no boundary", most=0.1), QUICK)["verdict"] == WRONG


def test_what_is_raised_is_told(triangle):
    def refuse(parts):
        raise ValueError("verts: expected finite values")

    row = measure.measure(case_of(dataclasses.replace(triangle, make=refuse)), QUICK)
    assert row["verdict"] == RAISED and "verts: expected finite" in row["raised"]


def shifted_triangle(visibility: bool = True) -> Problem:
    """Return a problem without exact integrals: its gradient is compared with finite differences."""
    scene, camera = one_triangle(), front_camera(32)
    direction = torch.tensor([0.7, 0.6, -0.2], dtype=torch.float64)
    return Problem(
        {"shift": torch.zeros(1, dtype=torch.float64)},
        lambda parts: (scene.transformed(t=parts["shift"] * direction), camera), None, "finite differences", {"shift": 0.01},
        options={"sampling": eg.Sampling(surface=20_000, edges=20_000), "visibility": visibility},
    )  # fmt: skip


@pytest.mark.parametrize("visibility", [True, False])
def test_finite_differences_tell(visibility):
    """The renderer shifts a triangle, with and without its boundary term."""
    row = measure.measure(case_of(shifted_triangle(visibility)), QUICK)
    assert row["verdict"] == (RIGHT if visibility else WRONG), row


@pytest.mark.parametrize(("more", "noise", "seeds", "differences"), [(1, 0.0, 4, 2), (4, 0.0, 16, 8), (4, 1.0, 2, 2)])
def test_a_case_takes_more_seeds_where_noise_asks_for_them(more, noise, seeds, differences, monkeypatch):
    counts = []

    def count(*arguments):
        run = found(*arguments)
        counts.append(run.count)
        return run

    found = measure.differences
    monkeypatch.setattr(measure, "differences", count)
    effort = Effort(seeds=(2, 4), noise=noise, difference_seeds=(2,), difference_spp=16, seconds=math.inf)
    row = measure.measure(case_of(shifted_triangle(), more=more), effort)
    assert row["seeds"] == seeds and counts == [differences] * 2  # of a step and of half of it


# -- statistics and fits ----------------------------------------------------------------------------------------------


def test_holm():
    p = torch.tensor([0.004, 0.03, 0.01, 0.9], dtype=torch.float64)
    # 0.004 ≤ 0.05/4, 0.01 ≤ 0.05/3, 0.03 > 0.05/2: it stops there.
    assert statistics.holm(p, 0.05).tolist() == [True, False, True, False]
    # The largest p may lie below α, but not after one that stays.
    assert statistics.holm(torch.tensor([0.04, 0.045]), 0.05).tolist() == [False, False]


@pytest.mark.slow
def test_unbiased():
    found = statistics.unbiased()
    assert found["rejected"] == 0 and found["components"] > 1000, found


def test_a_bias_is_noticed(triangle):
    """One of half a standard deviation of a single gradient, in the image of one part."""
    found = statistics.components(triangle, 64)
    assert found.z.abs().max() < 5.0
    off = dataclasses.replace(triangle, exact=lambda parts: (1.0 + 2.0 * found.deviation) * triangle.exact(parts))
    assert statistics.components(off, 64).z.abs().max() > 8.0


def test_tails_of_known_samples():
    norms = torch.tensor([1.0, 1.0, 2.0, 4.0], dtype=torch.float64)
    found = statistics._tail(norms, torch.tensor([8.0], dtype=torch.float64))
    assert found is not None
    assert (found["share"], found["times"], found["squares"]) == (0.5, 2.0, 16.0 / 22.0)
    assert found["deviation"] == pytest.approx((22.0 / 4.0 - 4.0) ** 0.5 / 2.0)
    assert statistics._tail(torch.zeros(4), torch.zeros(1)) is None


@pytest.mark.slow
def test_a_squared_loss_has_no_bias_in_the_gradient_for_what_moves():
    rows = statistics.squared_loss(quick=True)["rows"]
    for row in rows:
        for name in (" behind", " in front"):
            entry = row["vertices" + name]
            assert entry["bias"] < 4.0 * entry["noise"] + 1e-3, row
    # The loss itself has the variance of the image, which falls at least like 1/n.
    assert rows[0]["loss"]["bias"] > 10.0 * rows[2]["loss"]["bias"]


def test_smoothing_solves():
    mesh = cube(1.0)
    solve = LaplacianSolver(mesh.faces, len(mesh.verts), fits.SMOOTHNESS)
    x = torch.randn((8, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(solve(solve.to_differential(x)), x)
    ones = torch.ones((8, 3), dtype=torch.float64)
    torch.testing.assert_close(solve.to_differential(ones), ones)  # the Laplacian of a constant is zero


@pytest.mark.slow
def test_ill_conditioned_fits():
    camera, adam, preconditioned = fits.measure()
    for fit in (camera, adam, preconditioned):
        assert len(fit["losses"]) == fits.STEPS and fit["finite"]
        assert fit["rise"] < fits.RISE, fit["fit"]
        assert fit["losses"][-1] < 0.2 * fit["losses"][0]
    assert camera["error"][1] < camera["error"][0]
    # Plain Adam moves each vertex by itself, and what the image does not say leaves the mean distance to chance: it gets
    # nowhere, in either direction.
    assert adam["error"][1] < 1.02 * adam["error"][0]
    assert preconditioned["error"][1] < 0.5 * adam["error"][1]


@pytest.mark.parametrize("name", list(steps.cases()))
def test_painted_areas(name):
    """Lines that are close give the area within 3.5 %, which a derivative that is 5 % off does not."""
    case = steps.cases()[name]
    found = torch.stack([steps.derivative(case, 0.25, seed) for seed in range(4)]) / (case.area * steps.SCALE**2)
    error = float(found.std()) / 4**0.5
    assert error < 0.01
    assert float(found.mean()) == pytest.approx(1.0, abs=0.005 + 3.0 * error)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "floor of a shader" else name for name in PAINTED]
)
def test_painted_problems(name):
    """Image and gradient against exact integrals."""
    problem = PAINTED[name](front_camera(32))
    sampling = problem.options.get("sampling", eg.Sampling())
    problem.options["sampling"] = dataclasses.replace(sampling, discontinuity_spacing=0.25)
    effort = dataclasses.replace(QUICK, seeds=(*QUICK.seeds, 160), seconds=math.inf)
    row = measure.measure(Case("painted", name, "", lambda: problem), effort)
    assert row["verdict"] == RIGHT, row


# -- the command ------------------------------------------------------------------------------------------------------


def run(*arguments):
    return main([str(argument) for argument in arguments])


def test_command(tmp_path, capsys, monkeypatch):
    for name in [case.name for case in CASES.values() if case.group == "coincident"][2:]:
        monkeypatch.delitem(CASES, name)
    assert run("--case", "crop", "coincident", "--quick", "--out", tmp_path) == 0
    document = json.loads((tmp_path / "stability.json").read_text())
    names = [row["name"] for row in document["cases"]]
    assert names[0] == "crop" and {case.name for case in CASES.values() if case.group == "coincident"} == set(names[1:])
    assert len(names) == 3
    assert document["settings"]["quick"] and document["settings"]["kernel"]
    text = (tmp_path / "stability.md").read_text()
    assert all(f"| {name} |" in text for name in names)
    assert Image.open(tmp_path / "stability.png").width > 500
    assert "crop" in capsys.readouterr().out


def test_command_draws_errors_against_spacings(tmp_path, monkeypatch):
    monkeypatch.setattr(steps, "SPACINGS", (4.0, 1.0))
    monkeypatch.setattr(steps, "SEEDS", 8)
    assert run("--case", "steps", "--quick", "--out", tmp_path) == 0
    wide, narrow = json.loads((tmp_path / "stability.json").read_text())["sections"]["steps"]["rows"]
    assert wide["cases"]["disc, hits.where"]["error"] > narrow["cases"]["disc, hits.where"]["error"]
    assert "| 4 |" in (tmp_path / "stability.md").read_text()
    assert Image.open(tmp_path / "stability-steps.png").width > 500


def test_exit_code_tells_of_a_wrong_case(tmp_path, monkeypatch, triangle, capsys):
    interior = dataclasses.replace(triangle, options={**triangle.options, "visibility": False})
    monkeypatch.setitem(CASES, "crop", dataclasses.replace(CASES["crop"], build=lambda: interior))
    assert run("--case", "crop", "--quick", "--out", tmp_path) == 1
    assert "1 not right: crop" in capsys.readouterr().out
    assert "**wrong**" in (tmp_path / "stability.md").read_text()


def test_ctrl_c_keeps_what_is_measured(tmp_path, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setitem(CASES, "orthographic", dataclasses.replace(CASES["orthographic"], build=interrupt))
    assert run("--case", "crop", "orthographic", "--quick", "--out", tmp_path) == INTERRUPTED
    document = json.loads((tmp_path / "stability.json").read_text())
    assert [row["name"] for row in document["cases"]] == ["crop"]
    assert (tmp_path / "stability.md").exists() and (tmp_path / "stability.png").exists()


def test_unknown_case(tmp_path, capsys):
    assert run("--case", "cropp", "--out", tmp_path) == 2
    said = capsys.readouterr().err
    assert "case: expected one of" in said and "crop," in said and "'cropp'" in said


def test_a_missing_package_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(stability.NEEDS, "fits", ["no_such_package"])
    assert run("--case", "fits", "--out", tmp_path) == 2
    assert "fits needs no_such_package; install with: pip install 'edgegrad[fit]'" in capsys.readouterr().err


LIT = [name for name, case in CASES.items() if case.group == "light" and not case.slow]


@pytest.mark.parametrize("name", LIT)
def test_lit_extremes_are_finite(name: str) -> None:
    image, grads = measure.sample(CASES[name].build(), 0, spp=4, sampling=eg.Sampling(surface=500, edges=500))
    assert bool(image.isfinite().all()) and all(bool(grad.isfinite().all()) for grad in grads.values())
