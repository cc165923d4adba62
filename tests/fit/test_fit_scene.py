"""Fits by descent on scenes of a few faces: they find, stop, stop claiming, resume and save."""

import json
import math

import pytest
import torch
from test_fit import BACKGROUND, bracket, camera

import edgegrad as eg
from edgegrad.fit import Parameter, fit_scene, fit_shape, fit_texture, losses, regularizers
from edgegrad.fit.descent.adam import Adam
from edgegrad.fit.edge_support import _gradient, edge_support, picture_noise
from edgegrad.fit.ending import Ending
from edgegrad.fit.laplacian import LaplacianSolver

QUIET = {"progress": False, "spp": 4}


def views(count=3, size=32):
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    angles = [2.0 * math.pi * k / count + 0.3 for k in range(count)]
    eyes = [center + 4.5 * torch.tensor([0.9 * math.sin(a), 0.3, 0.9 * math.cos(a)]).double() for a in angles]
    return [eg.Camera.look_at(eye, center, fov_y=45.0, size=(size, size)) for eye in eyes]


def pictures(scene, cameras):
    return [eg.render(scene, view, spp=64, seed=1 << 20) for view in cameras]


# -- losses and regularizers ------------------------------------------------------------------------------------------


def test_losses_equal_their_formulas():
    a, b = torch.tensor([[[0.5, 0.0]]]), torch.tensor([[[0.2, 0.4]]])  # 1 pixel, 2 channels: r = 0.3, −0.4
    assert float(losses.l1(a, b)) == pytest.approx(0.35)
    assert float(losses.l2(a, b)) == pytest.approx(0.125)
    assert float(losses.huber(a, b, scale=0.1)) == pytest.approx(0.1 * (0.25 + 0.35) / 2)
    x2 = [9.0, 16.0]  # (r / 0.1)²
    assert float(losses.robust(a, b, scale=0.1, alpha=2.0)) == pytest.approx(sum(x2) / 4)
    assert float(losses.robust(a, b, scale=0.1, alpha=0.0)) == pytest.approx(sum(math.log1p(x / 2) for x in x2) / 2)
    assert float(losses.robust(a, b, scale=0.1)) == pytest.approx(sum(2 * x / (x + 4) for x in x2) / 2)
    welsch = losses.robust(a, b, scale=0.1, alpha=-math.inf)
    assert float(welsch) == pytest.approx(sum(1 - math.exp(-x / 2) for x in x2) / 2)
    assert float(losses.robust(a, b, scale=0.1, alpha=1.0)) == pytest.approx(sum(math.sqrt(x + 1) - 1 for x in x2) / 2)
    masks = torch.tensor([[[1.0], [0.5], [0.0]]]), torch.tensor([[[0.5], [0.5], [1.0]]])
    assert float(losses.iou(*masks)) == pytest.approx(1.0 - 1.0 / 2.5)


@pytest.mark.parametrize("name", losses.LOSSES)
def test_losses_vanish_at_the_target_and_heed_weights(name):
    loss = losses.LOSSES[name]
    g = torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 16, 16, 3, generator=g), torch.rand(2, 16, 16, 3, generator=g)
    assert abs(float(loss(target, target, None))) < 1e-6 < 0.01 < float(loss(image, target, None))
    if name == "iou":  # of one channel
        image, target = image[..., :1], target[..., :1]
    weight = torch.ones(2, 16, 16, 1)
    assert float(loss(image, target, weight)) == pytest.approx(float(loss(image, target, None)), rel=1e-5)
    malformed = image.clone()
    malformed[:, :8] = 5.0
    weight[:, :8] = 0.0
    if name != "ssim":  # whose windows reach across
        assert float(loss(malformed, target, weight)) == pytest.approx(float(loss(image, target, weight)), rel=1e-5)


def test_a_multiscale_loss_sees_further_than_a_pixel():
    """The two dots do not touch, so only coarse levels see that one of them is nearer."""
    x = torch.arange(32.0)

    def dot(at):
        return torch.exp(-0.5 * ((x - at) / 0.7) ** 2)[None, :, None].expand(32, -1, 1)

    ratios = [float(f(dot(16.0), dot(20.0)) / f(dot(8.0), dot(20.0))) for f in (losses.l2, losses.multiscale())]
    assert ratios[0] > 0.999 and ratios[1] < 0.9
    weight = torch.ones(32, 32, 1)
    assert float(losses.multiscale()(dot(10.0), dot(16.0), weight)) == pytest.approx(
        float(losses.multiscale()(dot(10.0), dot(16.0))), rel=1e-4
    )


def test_regularizers_equal_their_formulas():
    flat = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]).double()
    faces = torch.tensor([[0, 1, 2], [1, 3, 2]])
    assert float(regularizers.normal_consistency(flat, faces)) == pytest.approx(0.0, abs=1e-12)
    bent = flat.clone()
    bent[3] = torch.tensor([0.5, 0.5, 0.5**0.5])  # by 90°
    assert float(regularizers.normal_consistency(bent, faces)) == pytest.approx(1.0)
    tetrahedron = torch.tensor([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]).double()
    sides = torch.tensor([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]])
    assert float(regularizers.edge_length(tetrahedron, sides)) == pytest.approx(0.0, abs=1e-12)
    # v − the mean of the others is 4/3 v, |v|² = 3; edges have length √8.
    assert float(regularizers.laplacian(tetrahedron, sides)) == pytest.approx(16 / 9 * 3 / 8)
    assert regularizers.edges(sides).shape == (6, 2) and regularizers.edge_pairs(sides).shape == (6, 2)
    for function in (regularizers.laplacian, regularizers.edge_length, regularizers.normal_consistency):
        assert float(function(3.0 * bent, faces)) == pytest.approx(float(function(bent, faces)))  # no units
    assert float(regularizers.total_variation(torch.ones(4, 4, 3))) == 0.0
    assert float(regularizers.total_variation(torch.eye(2)[..., None])) == pytest.approx(2.0)


# -- the loop ---------------------------------------------------------------------------------------------------------


def test_steps_equal_those_of_torch_adam():
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(0)).double()
    mine, theirs = (start.clone().requires_grad_() for _ in range(2))
    ours, torchs = Adam({"x": mine}, {"x": 0.1}), torch.optim.Adam([theirs], lr=0.1)
    for _ in range(5):
        ours.step({"x": torch.autograd.grad(mine.pow(4).sum(), mine)[0]})
        torchs.zero_grad()
        theirs.pow(4).sum().backward()
        torchs.step()
    torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-5)  # ε is relative here


def test_uniform_steps_keep_the_gradients_direction():
    x = torch.zeros(4, 3, dtype=torch.float64)
    gradient = torch.randn(4, 3, generator=torch.Generator().manual_seed(0)).double()
    Adam({"x": x}, {"x": 0.1}, uniform={"x"}).step({"x": gradient})
    torch.testing.assert_close(x, -0.1 * gradient / gradient.abs().max())


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
        start, cameras, target, {"meshes.0.face_colors": Parameter(0.05, low=0.0), "background": 0.02},
        steps=250, patience=15, callback=seen.append, **QUIET,
    )  # fmt: skip
    assert fit.converged and fit.reason == "converged" and fit.explained > 0.95
    torch.testing.assert_close(fit.values["background"], BACKGROUND, atol=0.01, rtol=0)
    assert float((fit.mesh.face_colors - mesh.face_colors).abs().median()) < 0.02
    assert seen == fit.history and fit.steps == len(seen) < 250
    assert set(seen[0].gradient) == {"meshes.0.face_colors", "background"} and min(seen[0].gradient.values()) > 0
    assert torch.equal(seen[0].values["background"], torch.zeros(3)) and seen[-1].rate < seen[0].rate == 1.0
    assert fit.loss < 0.01 * seen[0].loss


def test_finds_the_values_of_a_function_that_makes_the_scene():
    mesh, cameras = bracket(), views(2)
    target = pictures(mesh.transformed(t=torch.tensor([0.1, 0.0, 0.0]).double()), cameras)
    fit = fit_scene(
        lambda values: mesh.transformed(t=torch.cat([values["shift"], torch.zeros(2)]).double()),
        cameras, target, {"shift": Parameter(0.01, torch.zeros(1))}, steps=60, **QUIET,
    )  # fmt: skip
    assert float(fit.values["shift"]) == pytest.approx(0.1, abs=0.005)


def test_finds_a_camera_by_name():
    mesh, (view,) = bracket(), views(1)
    K = view.K.clone()
    K[0, 2] += 1.5
    target = pictures(mesh, [view.replace(K=K)])
    fit = fit_scene(mesh, view, target, {"cameras.0.K": 0.1}, steps=40, **QUIET)
    assert float(fit.cameras[0].K[0, 2]) == pytest.approx(float(K[0, 2]), abs=0.2)


@pytest.mark.parametrize("how", ["weights", "robust"])
def test_weights_exclude_what_covers_the_object(how):
    mesh, (view,) = bracket(), views(1)
    mesh = mesh.replace(face_colors=torch.tensor([[0.3, 0.6, 0.2]]).repeat(20, 1))
    (target,) = pictures(eg.Scene([mesh], BACKGROUND), [view])
    target[:, :14] = 1.0
    weight = torch.ones(32, 32)
    weight[:, :14] = 0.0
    start = eg.Scene([mesh.replace(face_colors=torch.full((20, 3), 0.45))], BACKGROUND)
    more = {"weights": weight} if how == "weights" else {"loss": lambda a, b, w: losses.robust(a, b, w, scale=0.1)}

    def one_colour(values):
        return start.replace(meshes=[start.meshes[0].replace(face_colors=values["colour"].expand(20, 3))])

    parameters = {"colour": Parameter(0.02, torch.full((3,), 0.45))}
    fit = fit_scene(one_colour, view, target, parameters, steps=80, **more, **QUIET)
    torch.testing.assert_close(fit.values["colour"], mesh.face_colors[0], atol=0.03, rtol=0)
    plain = fit_scene(one_colour, view, target, parameters, steps=80, **QUIET)
    assert float((plain.values["colour"] - mesh.face_colors[0]).abs().max()) > 0.05


def test_a_flat_loss_alone_is_no_convergence():
    """The colours of one object cannot explain the picture of another one: the loss gets flat, at a wrong place."""
    cameras = views(1)
    other = bracket().transformed(
        torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double(), torch.tensor([2.0, 1.5, 0]).double()
    )
    target = pictures(eg.Scene([other], BACKGROUND), cameras)
    fit = fit_scene(
        eg.Scene([bracket()], BACKGROUND), cameras, target, {"background": 0.02}, steps=200, patience=8, **QUIET
    )
    assert fit.ending is Ending.FLAT and not fit.converged and fit.explained < 0.6
    assert fit.reason.startswith("edges not explained: the pictures show")


@pytest.mark.parametrize(("method", "rate"), [("adam", 0.3), ("gauss-newton", 0.02)])
def test_a_tolerance_of_0_takes_all_steps(method, rate):
    cameras = views(1)
    options = {"steps": 60, "patience": 2, "method": method, **QUIET, "spp": 1}
    target = pictures(eg.Scene([bracket()], BACKGROUND), cameras)

    def steps(tolerance):
        scene = eg.Scene([bracket()], torch.zeros(3))
        return fit_scene(scene, cameras, target, {"background": rate}, tolerance=tolerance, **options).steps

    assert steps(0.01) < 60 and steps(0.0) == 60


def test_a_loss_that_still_falls_is_no_convergence():
    cameras = views(1)
    target = pictures(eg.Scene([bracket()], BACKGROUND), cameras)
    fit = fit_scene(eg.Scene([bracket()], torch.zeros(3)), cameras, target, {"background": 1e-3}, steps=20, **QUIET)
    assert not fit.converged and fit.reason.startswith("loss still falling: give it more steps")


def colour_fit(cameras, target, **options):
    start = eg.Scene([bracket().replace(face_colors=torch.full((20, 3), 0.4))], torch.zeros(3))
    return fit_scene(start, cameras, target, {"meshes.0.face_colors": 0.03, "background": 0.02}, **QUIET, **options)


@pytest.mark.parametrize("views_per_step", [None, 2])
def test_a_resumed_fit_ends_as_if_it_had_never_stopped(tmp_path, views_per_step):
    cameras = views()
    target = pictures(eg.Scene([bracket()], BACKGROUND), cameras)

    def stop(record):
        if record.step == 13:
            raise KeyboardInterrupt

    whole = colour_fit(cameras, target, steps=30, patience=5, views_per_step=views_per_step)
    file = tmp_path / "fit.ckpt"
    options = {"steps": 30, "patience": 5, "checkpoint": file, "resume": True, "views_per_step": views_per_step}
    half = colour_fit(cameras, target, callback=stop, **options)
    assert half.interrupted and not half.converged and half.steps == 14 and file.exists()
    again = colour_fit(cameras, target, **options)
    assert again.steps == whole.steps and not again.interrupted
    for name, value in whole.values.items():
        assert torch.equal(again.values[name], value)
    assert [r.loss for r in again.history] == [r.loss for r in whole.history]
    assert list(tmp_path.iterdir()) == [file]  # nothing half done stays behind
    assert colour_fit(cameras, target, **options).steps == whole.steps  # nothing left to do


def test_a_checkpoint_of_something_else_is_refused(tmp_path):
    cameras = views(1)
    target = pictures(bracket(), cameras)
    file = tmp_path / "fit.ckpt"
    colour_fit(cameras, target, steps=1, checkpoint=file)
    with pytest.raises(ValueError, match=r"resume: expected .* made with another scene, parameters;"):
        fit_scene(bracket(), cameras, target, {"verts": 1e-3}, steps=1, checkpoint=file, resume=True, **QUIET)
    for name, given in {
        "images": (cameras, [picture + 0.1 for picture in target], {}),
        "cameras": ([eg.Camera.look_at((0, 0, 7), (0, 0, 0), size=view.size) for view in cameras], target, {}),
        "masks": (cameras, target, {"masks": [torch.ones(picture.shape[:2]) for picture in target]}),
        "seed": (cameras, target, {"seed": 1}),
        "render": (cameras, target, {"render": {"filter": "gaussian"}}),
    }.items():
        with pytest.raises(ValueError, match=rf"fit\.ckpt to be a checkpoint of this fit.* another {name};"):
            colour_fit(*given[:2], steps=2, checkpoint=file, resume=True, **given[2])
    assert colour_fit(cameras, target, steps=2, checkpoint=file, resume=True).steps == 2  # of the same fit
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ValueError, match="expected a checkpoint of a fit"):
        colour_fit(cameras, target, steps=1, checkpoint=file, resume=True)


def test_an_interruption_keeps_the_best_values():
    cameras = views(1)
    target = pictures(eg.Scene([bracket()], BACKGROUND), cameras)
    fit = colour_fit(
        cameras, target, steps=40, callback=lambda r: (_ for _ in ()).throw(KeyboardInterrupt) if r.step == 25 else None
    )
    assert fit.interrupted and fit.reason == "interrupted" and fit.steps == 26
    assert fit.loss < 0.5 * fit.history[0].loss


def test_a_step_too_far_is_taken_back():
    """A learning rate that throws the values out of float32: the fit goes back and on with shorter steps."""
    cameras = views(1, 16)
    target = pictures(eg.Scene([bracket()], BACKGROUND), cameras)

    def broken(image, wanted, weight):
        loss = losses.l2(image, wanted, weight)
        return loss * (math.nan if float(image.detach().max()) > 1.5 else 1.0)

    fit = fit_scene(
        eg.Scene([bracket()], torch.zeros(3)), cameras, target, {"background": 0.9}, loss=broken, steps=40, **QUIET
    )
    assert all(bool(value.isfinite().all()) for value in fit.values.values())
    assert fit.loss < fit.history[0].loss


def test_saves_everything_and_draws_itself(tmp_path):
    cameras = views(2)
    mesh = bracket()
    fit = fit_scene(mesh, cameras, pictures(mesh, cameras), {"verts": 1e-3}, steps=3, **QUIET)
    names = fit.save(tmp_path / "new")
    assert sorted(names) == sorted(path.name for path in (tmp_path / "new").iterdir())
    assert {"fit.json", "values.pt", "history.json", "mesh.ply", "camera0.json", "fit.png", "loss.png"} <= set(names)
    assert json.loads((tmp_path / "new" / "fit.json").read_text())["steps"] == 3
    values = torch.load(tmp_path / "new" / "values.pt", weights_only=True)
    assert torch.equal(values["verts"], fit.values["verts"])
    assert eg.load_mesh(tmp_path / "new" / "mesh.ply").verts.shape == mesh.verts.shape
    assert fit._repr_png_()[:4] == b"\x89PNG"


def test_saves_the_materials_it_found(tmp_path):
    cameras = views(1)
    mesh = bracket().replace(material=eg.Material(roughness=0.4, emission=torch.tensor([0.2, 3.0, 0.1])))
    target = pictures(mesh.replace(material=mesh.material.replace(emission=torch.tensor([0.4, 2.0, 0.3]))), cameras)
    fit = fit_scene(mesh, cameras, target, {"material.emission": 0.05}, steps=5, **QUIET)
    assert "mesh.glb" in fit.save(tmp_path, figures=False)
    (found,) = eg.load_scene(tmp_path / "mesh.glb", lit=True).meshes
    assert float(fit.values["material.emission"][1]) < 2.95
    torch.testing.assert_close(found.material.emission, fit.values["material.emission"])
    assert float(found.material.roughness) == pytest.approx(0.4)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"parameters": {"meshes.0.vert": 1e-3}}, ValueError, "did you mean 'meshes.0.verts'"),
        ({"parameters": {}}, ValueError, "parameters: expected a name or more of what is sought, got none"),
        (
            {"parameters": ["background"]},
            TypeError,
            "parameters: expected a mapping of names to learning rates or Parameters, got list",
        ),
        (
            {"parameters": {"background": [0.1]}},
            TypeError,
            "background: expected a learning rate or a Parameter, got list",
        ),
        ({"cameras": []}, ValueError, "cameras: expected one for each picture, got an empty list"),
        (
            {"parameters": {"background": "fast"}},
            TypeError,
            "background: expected a learning rate or a Parameter, got str",
        ),
        ({"parameters": {"background": Parameter(0.1, torch.zeros(4))}}, ValueError, "background: expected shape (3,)"),
        (
            {"parameters": {"background": Parameter(0.1, low=1.0, high=0.0)}},
            ValueError,
            "background: expected low ≤ high",
        ),
        ({"images": torch.zeros(8, 8, 3)}, ValueError, "images: expected 2, one for each camera, got 8"),
        ({"images": None}, ValueError, "images: expected pictures or masks"),
        ({"weights": -torch.ones(2, 32, 32)}, ValueError, "weights: expected numbers from 0 up"),
        ({"masks": torch.ones(2, 32, 32, 3)}, ValueError, "masks[0]: expected shape (32, 32) or (32, 32, 1)"),
        ({"cameras": "here"}, TypeError, "cameras[0]: expected a Camera"),
        ({"scene": 3}, TypeError, "scene: expected a Scene, a Mesh, or a function"),
        ({"loss": "l3"}, ValueError, "loss: expected one of l1, l2"),
        ({"step": 3}, TypeError, "did you mean 'steps'"),
        ({"steps": 0}, ValueError, "steps: expected an int from 1"),
        ({"resume": True}, ValueError, "resume: expected a checkpoint"),
        ({"checkpoint": "/nowhere/at/all"}, FileNotFoundError, "checkpoint: expected the folder"),
        ({"render": {"spps": 3}}, ValueError, "render: expected arguments of render() among surface_samples"),
        ({"render": {"spp": 3}}, ValueError, "got 'spp'; it is an option of its own"),
        (
            {"loss": lambda image, target: image.mean()},
            TypeError,
            "loss: expected a function of image, target and weight",
        ),
        ({"loss": lambda image, target, weight: image - target}, ValueError, "gives a tensor of one number, got shape"),
        ({"weights": torch.zeros(2, 32, 32)}, ValueError, "weights: expected numbers above 0 somewhere"),
        ({"masks": torch.zeros(2, 32, 32)}, ValueError, "masks: expected numbers above 0 somewhere"),
        ({"parameters": {"background": Parameter(0.1, high=0.01)}}, ValueError, "background: expected a start within"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    cameras = views(2)
    arguments = {
        "scene": eg.Scene([bracket()], BACKGROUND), "cameras": cameras, "images": torch.zeros(2, 32, 32, 3),
        "parameters": {"background": 0.1},
    }  # fmt: skip
    with pytest.raises(error) as caught:
        fit_scene(**{**arguments, "progress": False, **change})
    assert message in str(caught.value)


# -- what tells a right fit from a wrong one --------------------------------------------------------------------------


def test_picture_noise_is_that_of_the_picture():
    g = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.linspace(0, 1, 64), torch.linspace(0, 1, 64), indexing="ij")
    picture = torch.stack([x, y, (x > 0.5).float()], -1) + 0.03 * torch.randn(64, 64, 3, generator=g)
    torch.testing.assert_close(picture_noise(picture), torch.full((3,), 0.03), rtol=0.1, atol=0)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_edge_support_decreases_with_misplacement(noise):
    view, g = camera(96), torch.Generator().manual_seed(0)
    scene = eg.Scene([bracket()], BACKGROUND)
    a, b = (eg.render(scene, view, spp=64, seed=s) for s in (1, 2))

    def share(pixels):
        K = view.K.clone()
        K[:2, 2] += pixels
        picture = eg.render(scene, view.replace(K=K), spp=64, seed=3)
        return edge_support([(a, b, picture + noise * torch.randn(picture.shape, generator=g), None)])

    shares = [share(pixels) for pixels in (0.0, 0.5, 2.0, 8.0)]
    assert shares[0] > 0.95 and shares == sorted(shares, reverse=True) and shares[1] > 0.6 and shares[2] < 0.5, shares


def test_a_channel_missing_in_the_picture_counts_by_the_edges_of_the_render():
    """If the only blue object is covered, its edge is missing and the others are not."""
    render = torch.zeros(32, 32, 3)
    render[8:24, 8:24, :2] = 1.0
    render[12:14, 12:14, 2] = 1.0
    picture = render.clone()
    picture[10:16, 10:16] = torch.tensor([1.0, 1.0, 0.0])
    picture[0, 0, 2] = 1e-3  # that nothing else of the channel is there does not make it larger
    share = edge_support([(render, render, picture, None)])
    edges = [float(_gradient(render[..., k : k + 1]).norm(dim=0).sum()) for k in range(3)]
    assert share == pytest.approx((edges[0] + edges[1]) / sum(edges), abs=1e-3) and share > 0.8


# -- texture and shape ------------------------------------------------------------------------------------------------


def test_finds_a_texture():
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    uvs = 0.5 + 0.5 * square[:, :2]
    g = torch.Generator().manual_seed(0)
    image = torch.nn.functional.interpolate(torch.rand(1, 3, 6, 6, generator=g), (24, 24), mode="bicubic")
    mesh = eg.Mesh(square, faces, texture=image[0].movedim(0, -1).clamp(0.05, 1.0), uvs=uvs, uv_faces=faces)
    cameras = [eg.Camera.look_at((x, 0.3, 3.0), (0, 0, 0), size=(48, 48)) for x in (-1.0, 0.5, 1.5)]
    bare = eg.Mesh(square, faces, uvs=uvs, uv_faces=faces)
    fit = fit_texture(bare, cameras[:2], pictures(mesh, cameras[:2]), 24, steps=80, **QUIET)
    (truth,), (found,) = pictures(mesh, cameras[2:]), pictures(fit.mesh, cameras[2:])
    assert -10.0 * math.log10(float((truth - found).square().mean())) > 30.0
    assert fit.mesh.texture.shape == (24, 24, 3) and float(fit.mesh.texture.min()) >= 0.0


def ball(subdivisions):
    trimesh = pytest.importorskip("trimesh")
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    return eg.Mesh(torch.tensor(shape.vertices).float(), torch.tensor(shape.faces))


def egg_views():
    egg = ball(3)
    egg = egg.replace(verts=egg.verts * torch.tensor([0.7, 1.1, 0.8]) + 0.05)
    axes = torch.tensor([[3.0, 0.2, 0], [0.2, 0, 3.0], [-2, 2, 0.5], [0.5, -3, 0.3]])
    cameras = [eg.Camera.look_at(eye, (0, 0, 0), (0.3, 0.5, 0.9), size=(64, 64)) for eye in axes]
    masks = [eg.render_aovs(egg, view, ["alpha"], spp=64, seed=5)["alpha"] for view in cameras]
    return cameras, masks


def test_finds_a_shape_from_masks():
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    fit = fit_shape(ball(1), cameras, masks=masks, levels=2, faces=600, steps=40, mask_loss="l2", **QUIET)
    v = fit.mesh.verts - 0.05
    off = ((v / torch.tensor([0.7, 1.1, 0.8])).norm(dim=1) - 1.0).abs()
    assert float(off.mean()) < 0.04, float(off.mean())
    assert 400 < len(fit.mesh.faces) < 900 and fit.steps <= 80
    assert [record.step for record in fit.history] == list(range(fit.steps))


def test_a_shape_that_cannot_be_remeshed_is_refused_before_the_first_level():
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    mesh = ball(1)
    fin = torch.cat([mesh.faces[0, :2], torch.tensor([len(mesh.verts)])])[None]
    finned = eg.Mesh(torch.cat([mesh.verts, mesh.verts[:1] * 2]), torch.cat([mesh.faces, fin]))
    with pytest.raises(ValueError, match=r"mesh: expected no more than two triangles at each edge, .* got 1 edges"):
        fit_shape(finned, cameras, masks=masks, levels=2, steps=2, **QUIET)
    assert fit_shape(finned, cameras, masks=masks, levels=1, steps=2, **QUIET).steps == 2


def test_a_shape_resumes_on_a_later_level(tmp_path):
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    file = tmp_path / "shape.ckpt"

    def stop(record):
        stop.count += 1
        if stop.count == 9:
            raise KeyboardInterrupt

    stop.count = 0
    options = {"masks": masks, "levels": 2, "steps": 6, "checkpoint": file, "resume": True, **QUIET}
    half = fit_shape(ball(1), cameras, callback=stop, **options)
    assert half.interrupted and half.steps == 9
    again = fit_shape(ball(1), cameras, **options)
    file.unlink()
    whole = fit_shape(ball(1), cameras, **options)
    assert again.steps == whole.steps == 12
    torch.testing.assert_close(again.mesh.verts, whole.mesh.verts, rtol=0, atol=1e-6)


def test_the_best_values_are_not_those_of_the_easiest_views():
    """Two views of which the first drawn has the smaller loss at the start than both have at the end."""
    square = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    mesh = eg.Mesh(square, torch.tensor([[0, 1, 2], [0, 2, 3]]), face_colors=torch.full((2, 1), 0.4))
    cameras = [eg.Camera.look_at((x, 0.0, 3.0), (0, 0, 0), size=(8, 8)) for x in (0.0, 0.1)]
    easy, hard = (torch.full((8, 8, 1), value) for value in (0.45, 1.0))
    for images in ([easy, hard], [hard, easy]):
        fit = fit_scene(
            mesh,
            cameras,
            images,
            {"face_colors": 0.02},
            views_per_step=1,
            steps=60,
            weights=torch.ones(2, 8, 8),
            **QUIET,
        )
        assert float(fit.values["face_colors"].mean()) > 0.6  # the mean of both is the best
