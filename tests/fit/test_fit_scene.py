"""fit_scene finds values of scenes of a few faces, ends, says whether it converged, resumes and saves."""

import json
import math

import numpy as np
import pytest
import torch
from brackets import BACKGROUND, bracket
from messages import T, V, check_message
from quiet_fits import arranged
from small_scenes import QUIET, pictures, views

import edgegrad as eg
from edgegrad.fit import Checkpoint, Parameter, fit_scene, losses
from edgegrad.fit.laplacian import LaplacianSolver
from edgegrad.optim.tensors import Ending


def test_smooth_coordinates_have_their_gradient():
    mesh = bracket()
    smooth = LaplacianSolver(mesh.faces, len(mesh.verts), 3.0)
    u = smooth.to_differential(mesh.verts).requires_grad_()
    torch.testing.assert_close(smooth(u.detach()), mesh.verts)
    assert torch.autograd.gradcheck(smooth, (u,))


def test_finds_named_tensors_each_at_its_rate():
    mesh, cameras = bracket(), views()
    target = pictures(eg.Scene([mesh], BACKGROUND), cameras)
    start = eg.Scene([mesh.replace(face_colors=torch.full((20, 3), 0.4))], torch.zeros(3))
    seen = []
    fit = fit_scene(
        start, target, cameras, {"meshes.0.face_colors": Parameter(0.05, low=0.0), "background": 0.02}, **arranged(steps=250,
        patience=15, callback=seen.append, **QUIET),
    )  # fmt: skip
    assert fit.converged and fit.reason == "converged" and fit.explained > 0.95
    torch.testing.assert_close(fit.values["background"], BACKGROUND, atol=0.01, rtol=0)
    assert float((fit.mesh.face_colors - mesh.face_colors).abs().median()) < 0.02
    assert [record.loss for record in seen] == [record.loss for record in fit.history] and fit.steps == len(seen) < 250
    assert set(seen[0].gradient) == {"meshes.0.face_colors", "background"} and min(seen[0].gradient.values()) > 0
    assert torch.equal(seen[0].values["background"], torch.zeros(3)) and seen[-1].rate < seen[0].rate == 1.0
    assert fit.loss < 0.01 * seen[0].loss


def test_finds_the_values_of_a_function_that_makes_the_scene():
    mesh, cameras = bracket(), views(2)
    target = pictures(mesh.transformed(t=torch.tensor([0.1, 0.0, 0.0]).double()), cameras)
    fit = fit_scene(
        lambda values: mesh.transformed(t=torch.cat([values["shift"], torch.zeros(2)]).double()), target, cameras, {"shift":
        Parameter(0.01, torch.zeros(1))}, **arranged(steps=60, **QUIET),
    )  # fmt: skip
    assert float(fit.values["shift"]) == pytest.approx(0.1, abs=0.005)


def test_finds_a_camera_by_name():
    mesh, (view,) = bracket(), views(1)
    K = view.K.clone()
    K[0, 2] += 1.5
    target = pictures(mesh, [view.replace(K=K)])
    fit = fit_scene(mesh, target, view, {"cameras.0.K": 0.1}, **arranged(steps=40, **QUIET))
    assert float(fit.cameras[0].K[0, 2]) == pytest.approx(float(K[0, 2]), abs=0.2)


def test_weights_and_a_robust_loss_exclude_what_covers_the_object():
    mesh, (view,) = bracket(), views(1)
    mesh = mesh.replace(face_colors=torch.tensor([[0.3, 0.6, 0.2]]).repeat(20, 1))
    (target,) = pictures(eg.Scene([mesh], BACKGROUND), [view])
    target[:, :14] = 1.0
    weight = torch.ones(32, 32)
    weight[:, :14] = 0.0
    start = eg.Scene([mesh.replace(face_colors=torch.full((20, 3), 0.45))], BACKGROUND)

    def one_colour(values):
        return start.replace(meshes=[start.meshes[0].replace(face_colors=values["colour"].expand(20, 3))])

    def off(**options):
        parameters = {"colour": Parameter(0.02, torch.full((3,), 0.45))}
        fit = fit_scene(one_colour, target, view, parameters, **arranged(steps=80, **options, **QUIET))
        return float((fit.values["colour"] - mesh.face_colors[0]).abs().max())

    assert off(weights=weight) < 0.03 and off(loss=lambda a, b, w: losses.robust(a, b, w, scale=0.1)) < 0.03
    assert off() > 0.05


def background_fit(rate, start=(0.0, 0.0, 0.0), shown=None, size=32, **options):
    """Return a fit of the background behind the bracket to a picture, of the bracket or of something else."""
    cameras, scene = views(1, size), eg.Scene([bracket()], torch.tensor(start))
    target = pictures(eg.Scene([shown or bracket()], BACKGROUND), cameras)
    return fit_scene(scene, target, cameras, {"background": rate}, **arranged(**{**QUIET, **options}))


def test_a_flat_loss_alone_is_no_convergence():
    """The colours of one object cannot explain the picture of another one: the loss gets flat, at a wrong place."""
    turn = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    other = bracket().transformed(turn, torch.tensor([2.0, 1.5, 0]).double())
    fit = background_fit(0.02, BACKGROUND.tolist(), other, steps=200, patience=8)
    assert fit.ending is Ending.FLAT and not fit.converged and fit.explained < 0.6
    assert fit.reason.startswith("edges not explained: the pictures show")


@pytest.mark.parametrize(("method", "rate"), [("adam", 0.3), ("gauss-newton", 0.02)])
def test_a_tolerance_of_0_takes_all_steps(method, rate):
    def steps(tolerance):
        return background_fit(rate, method=method, loss_tolerance=tolerance, steps=60, patience=2, spp=1).steps

    assert steps(0.01) < 60 and steps(0.0) == 60


def test_a_loss_that_still_falls_is_no_convergence():
    fit = background_fit(1e-3, steps=20)
    assert not fit.converged and fit.reason.startswith("loss still falling: give it more steps")


def colour_fit(cameras, target, **options):
    start = eg.Scene([bracket().replace(face_colors=torch.full((20, 3), 0.4))], torch.zeros(3))
    return fit_scene(
        start, target, cameras, {"meshes.0.face_colors": 0.03, "background": 0.02}, **arranged(**QUIET, **options)
    )


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    cameras = views(1)
    target = pictures(bracket(), cameras)
    file = tmp_path / "fit.ckpt"
    colour_fit(cameras, target, steps=1, checkpoint=file)
    with pytest.raises(ValueError, match=r"checkpoint: expected .* made with another scene, parameters;"):
        fit_scene(
            bracket(), target, cameras, {"verts": 1e-3},
            **arranged(steps=1, checkpoint=Checkpoint(file, resume=True), **QUIET),
        )  # fmt: skip
    for name, given in {
        "images": (cameras, [picture + 0.1 for picture in target], {}),
        "cameras": ([eg.Camera.look_at((0, 0, 7), (0, 0, 0), size=view.size) for view in cameras], target, {}),
        "masks": (cameras, target, {"masks": [torch.ones(picture.shape[:2]) for picture in target]}),
        "seed": (cameras, target, {"seed": 1}),
        "bounces": (cameras, target, {"bounces": 2}),
    }.items():
        with pytest.raises(ValueError, match=rf"fit\.ckpt to be of this fit.* another {name};"):
            colour_fit(*given[:2], steps=2, checkpoint=file, resume=True, **given[2])
    assert colour_fit(cameras, target, steps=2, checkpoint=file, resume=True).steps == 2  # of the same fit
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ValueError, match="expected a checkpoint of a fit"):
        colour_fit(cameras, target, steps=1, checkpoint=file, resume=True)


def test_a_step_too_far_is_taken_back():
    """A learning rate throws the values out of float32. The fit goes back and continues with shorter steps."""

    def broken(image, wanted, weight):
        loss = losses.l2(image, wanted, weight)
        return loss * (math.nan if float(image.detach().max()) > 1.5 else 1.0)

    fit = background_fit(0.9, size=16, loss=broken, steps=40)
    assert all(bool(value.isfinite().all()) for value in fit.values.values())
    assert fit.loss < fit.history[0].loss


def test_saves_everything_and_draws_itself(tmp_path):
    cameras = views(2)
    mesh = bracket()
    fit = fit_scene(mesh, pictures(mesh, cameras), cameras, {"verts": 1e-3}, **arranged(steps=3, **QUIET))
    names = fit.save(tmp_path / "new")
    assert sorted(names) == sorted(path.name for path in (tmp_path / "new").iterdir())
    assert {"fit.json", "values.pt", "history.json", "mesh.ply", "camera0.json", "fit.png", "loss.png"} <= set(names)
    assert json.loads((tmp_path / "new" / "fit.json").read_text())["steps"] == 3
    values = torch.load(tmp_path / "new" / "values.pt", weights_only=True)
    assert torch.equal(values["verts"], fit.values["verts"])
    assert eg.load_mesh(tmp_path / "new" / "mesh.ply").verts.shape == mesh.verts.shape


def test_saves_the_materials_it_found(tmp_path):
    cameras = views(1)
    mesh = bracket().replace(material=eg.Material(roughness=0.4, emission=torch.tensor([0.2, 3.0, 0.1])))
    target = pictures(mesh.replace(material=mesh.material.replace(emission=torch.tensor([0.4, 2.0, 0.3]))), cameras)
    fit = fit_scene(mesh, target, cameras, {"material.emission": 0.05}, **arranged(steps=5, **QUIET))
    assert "mesh.glb" in fit.save(tmp_path, figures=False)
    (found,) = eg.load_scene(tmp_path / "mesh.glb", lit=True).meshes
    assert float(fit.values["material.emission"][1]) < 2.95
    torch.testing.assert_close(found.material.emission, fit.values["material.emission"])
    assert float(found.material.roughness) == pytest.approx(0.4)


def errors_of(**change):
    """Return the call of a fit of the background to two pictures, with other arguments."""
    given = {
        "scene": eg.Scene([bracket()], BACKGROUND), "cameras": views(2), "images": torch.zeros(2, 32, 32, 3),
        "parameters": {"background": 0.1},
    }  # fmt: skip
    if "options" in change:
        return lambda: fit_scene(**given, **change)
    return lambda: fit_scene(**arranged(**{**given, **change}))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"scene": 3}, T, "scene: expected a Scene, a Mesh, or a function"),
        ({"images": torch.zeros(8, 8, 3)}, V, "images: expected 2, one for each camera, got 1 in shape"),
        ({"images": None}, V, "images: expected pictures or masks"),
        ({"cameras": []}, V, "cameras: expected one for each picture, got an empty list"),
        ({"cameras": "here"}, T, "cameras: expected a Camera"),
        ({"masks": torch.ones(2, 32, 32, 3)}, V, "masks[0]: expected shape (32, 32) or (32, 32, 1)"),
        ({"masks": torch.zeros(2, 32, 32)}, V, "masks: expected numbers above 0 somewhere"),
        ({"weights": -torch.ones(2, 32, 32)}, V, "weights[0]: expected numbers from 0 up"),
        ({"weights": torch.zeros(2, 32, 32)}, V, "weights: expected numbers above 0 somewhere"),
        ({"loss": "l3"}, V, "loss: expected one of l1, l2"),
        ({"loss": lambda a, b, weight: a - b}, V, "gives a tensor of one number, got shape"),
        (
            {"loss": lambda a, b, weight: (a - b).detach().mean()},
            V,
            "options.loss: expected a number with a gradient by",
        ),
        ({"max_size": 64}, V, "options.max_size: fit_scene compares pictures at their own size"),
        ({"options": {"steps": 3}}, T, "options: expected FitOptions, got dict; give FitOptions(steps=…)"),
        ({"steps": 0}, V, "steps: expected an int from 1"),
        ({"checkpoint": "/nowhere/at/all"}, FileNotFoundError, "checkpoint: expected the folder"),
        ({"sampling": {"lights": 3}}, T, "options.sampling: expected a Sampling, got dict"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    check_message(errors_of(**change), error, message)


@pytest.mark.parametrize(
    ("parameters", "error", "message"),
    [
        ({}, V, "parameters: expected a name or more of what is sought, got none"),
        (["background"], T, "parameters: expected a mapping of names to learning rates or Parameters, got list"),
        ({0: 0.1}, T, "parameters: expected names of what is sought as str, got int (0)"),
        ({"meshes.0.vert": 1e-3}, V, "did you mean 'meshes.0.verts'"),
        ({"cameras.0.world_to_camera": 0.1}, V, "expected 'cameras.0.pose' to move a camera"),
        ({"background": [0.1]}, T, "background: expected a learning rate or a Parameter, got list"),
        ({"background": "fast"}, T, "background: expected a learning rate or a Parameter, got str"),
        ({"background": Parameter("0")}, T, "background: lr: expected a number, got str"),
        ({"background": Parameter(0.1, torch.zeros(4))}, V, "background: expected shape (3,)"),
        ({"background": Parameter(0.1, 1.0)}, V, "background: expected shape (3,), got ()"),
        ({"background": Parameter(0.1, [0.1, 0.2])}, V, "background: expected shape (3,), got (2,)"),
        ({"background": Parameter(0.1, "0")}, T, "background: value: expected a tensor, array"),
        ({"background": Parameter(0.1, [math.nan] * 3)}, V, "background: "),
        ({"background": Parameter(0.1, low=1.0, high=0.0)}, V, "background: expected low ≤ high"),
        ({"background": Parameter(0.1, high=0.01)}, V, "background: expected a start within"),
        ({"background": Parameter(0.1, low="0")}, T, "background: low: expected a tensor, array"),
        ({"background": Parameter(0.1, high=math.nan)}, V, "background: high: expected a number"),
        ({"background": Parameter(0.1, low=[0.0, 0.0])}, V, "background: low: expected a number or"),
    ],
)
def test_errors_name_the_parameter(parameters, error, message):
    check_message(errors_of(parameters=parameters), error, message)


def test_a_scene_that_does_not_depend_on_a_parameter_is_named():
    change = {"scene": lambda values: eg.Scene([bracket()], values["background"].detach())}
    change["parameters"] = {"background": Parameter(0.1, BACKGROUND)}
    check_message(errors_of(**change), V, "scene: expected a function whose scene depends on the parameters background")


def test_numbers_and_lists_are_values_and_bounds():
    fit = background_fit(Parameter(0.1, [0.0, 0.0, 0.0], low=0, high=np.full(3, 0.15)), size=16, steps=5)
    assert float(fit.values["background"].min()) > 0.0 and float(fit.values["background"].max()) <= 0.151


def test_views_that_do_not_show_what_is_sought_change_nothing():
    cameras = views(2, 16)
    target = pictures(bracket(), cameras)
    fit = fit_scene(bracket(), target, cameras, {"cameras.0.K": 1e-3}, **arranged(views_per_step=1, steps=4, **QUIET))
    assert fit.steps == 4


def test_unknown_names_are_not_answered_with_what_cannot_be_sought():
    cameras = views(1, 16)
    with pytest.raises(ValueError, match=r"cameras\.0\.K") as caught:
        fit_scene(bracket(), torch.zeros(16, 16, 3), cameras, {"cameras.0.k": 0.1})
    assert "world_to_camera" not in str(caught.value)


def test_a_folder_that_is_a_file_is_named(tmp_path):
    cameras = views(1, 16)
    fit = fit_scene(bracket(), pictures(bracket(), cameras), cameras, {"verts": 1e-3}, **arranged(steps=1, **QUIET))
    (tmp_path / "file.glb").write_text("")
    with pytest.raises(FileExistsError, match="folder: expected a folder, got a file of that name"):
        fit.save(tmp_path / "file.glb")
    with pytest.raises(OSError, match="folder: expected a folder to write to"):
        fit.save(tmp_path / "file.glb" / "out")
    with pytest.raises(TypeError, match="folder: expected a path, got NoneType"):
        fit.save(None)


def test_the_best_values_are_not_those_of_the_easiest_views():
    """The first of two views has a smaller loss at the start than both have at the end."""
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = eg.Mesh(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.full((2, 1), 0.4))
    cameras = [eg.Camera.look_at((x, 0.0, 3.0), (0, 0, 0), size=(8, 8)) for x in (0.0, 0.1)]
    easy, hard = (torch.full((8, 8, 1), value) for value in (0.45, 1.0))
    for images in ([easy, hard], [hard, easy]):
        fit = fit_scene(
            mesh, images, cameras, {"face_colors": 0.02}, weights=torch.ones(2, 8, 8),
            **arranged(views_per_step=1, steps=60, **QUIET),
        )  # fmt: skip
        assert float(fit.values["face_colors"].mean()) > 0.6  # the mean of both is the best
