"""fit_pose on a small coloured bracket: poses come back, errors are told, an interruption keeps the best."""

import math
import pickle

import numpy as np
import pytest
import torch

import edgegrad as eg
from edgegrad.fit import PoseFit, fit_pose
from edgegrad.fit.checkpoints import FORMAT
from edgegrad.fit.pose.gauss_newton import GaussNewton, NormalEquations
from edgegrad.fit.pose.result import pose_from_json

pytestmark = pytest.mark.unsanitized

BACKGROUND = torch.tensor([0.1, 0.2, 0.3])


def bracket(plain=False):
    """An L of 20 triangles, one colour a side, so that no pose is ambiguous."""
    profile = torch.tensor([[0.0, 0.0], [2.0, 0.0], [2.0, 0.6], [0.7, 0.6], [0.7, 1.5], [0.0, 1.5]]).double()
    verts = torch.cat([torch.cat([profile, torch.full((6, 1), z).double()], 1) for z in (0.0, 0.8)])
    cap = [[3, 4, 5], [3, 5, 0], [3, 0, 1], [3, 1, 2]]  # seen from its reflex corner, the L is a fan
    faces = [[c, b, a] for a, b, c in cap] + [[a + 6, b + 6, c + 6] for a, b, c in cap]
    colors = [[0.8, 0.2, 0.1]] * 4 + [[0.2, 0.7, 0.2]] * 4
    for k in range(6):
        a, b = k, (k + 1) % 6
        faces += [[a, b, b + 6], [a, b + 6, a + 6]]
        colors += [[0.15 * k, 0.9 - 0.15 * k, 0.4 + 0.1 * (k % 3)]] * 2
    return eg.Mesh(verts, torch.tensor(faces), face_colors=None if plain else torch.tensor(colors))


def camera(size=64, distance=4.5):
    eye = torch.tensor([1.0, 0.75, 0.4]).double() + distance * torch.tensor([0.35, 0.3, 0.89]).double()
    return eg.Camera.look_at(eye, torch.tensor([1.0, 0.75, 0.4]).double(), fov_y=45.0, size=(size, size))


def rotation(*vector):
    x, y, z = vector
    return torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]).double())


def about_center(R, shift=(0.0, 0.0, 0.0)):
    """The pose (4, 4) that turns the bracket about its centre and shifts it."""
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    M = torch.eye(4, dtype=torch.float64)
    M[:3, :3], M[:3, 3] = R, center + torch.tensor(shift).double() - R @ center
    return M


START = about_center(rotation(0.12, -0.15, 0.1), (0.12, -0.1, 0.15))  # 12.3°, and 8.4 % of the size, 2.62


def picture(view, mesh=None, background=BACKGROUND):
    return eg.render(eg.Scene([mesh or bracket()], background), view, spp=64, seed=1 << 40)


def silhouette(view):
    mesh = bracket().replace(face_colors=torch.ones(20, 1))
    return eg.render(mesh, view, spp=64, seed=1 << 40)


def errors(fit, R=None):
    """Degrees, and percent of the size, from the identity."""
    apart = fit.R if R is None else fit.R @ R.T
    degrees = math.degrees(math.acos(max(-1.0, min(1.0, (float(apart.trace()) - 1.0) / 2.0))))
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    moved = fit.scale * fit.R @ center + fit.t - center
    return degrees, 100.0 * float(moved.norm()) / 2.62


@pytest.mark.parametrize(
    "background",
    [pytest.param(BACKGROUND, marks=pytest.mark.slow), None, pytest.param("image", marks=pytest.mark.slow)],
    ids=["colour", "border", "image"],
)
def test_finds_the_pose(background, capsys):
    view = camera()
    if background == "image":
        background = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    target = picture(view, background=BACKGROUND if background is None else background)
    fit = fit_pose(bracket(), target, view, init=START, background=background, progress=False)
    degrees, percent = errors(fit)
    # 64² pixels: a tenth of a pixel is 0.25 % of the size.
    assert degrees < 0.5 and percent < 0.5
    assert fit.converged and not fit.interrupted and fit.scale == pytest.approx(1.0, abs=1e-9)
    assert fit.steps == len(fit.history) and fit.seconds > 0
    torch.testing.assert_close(fit.history[0].pose.matrix, START, rtol=0, atol=1e-12)
    assert torch.equal([s for s in fit.history if s.best][-1].pose.matrix, fit.matrix)
    assert capsys.readouterr() == ("", "")
    again = pickle.loads(pickle.dumps(fit))
    assert again.loss == fit.loss and [step.loss for step in again.history] == [step.loss for step in fit.history]


def test_a_start_that_is_the_answer_is_converged():
    """More steps would not find a better one."""
    target = picture(camera())
    fit = fit_pose(bracket(), target, camera(), background=BACKGROUND, steps=12, progress=False)
    assert fit.converged and errors(fit)[0] < 0.2 and errors(fit)[1] < 0.5


@pytest.mark.parametrize("mode", [pytest.param(torch.no_grad, marks=pytest.mark.slow), torch.inference_mode])
def test_where_gradients_are_off(mode):
    """A fit takes gradients of its own, also of what was made there."""

    def fit():
        view = camera(size=24).to(torch.float64)
        mesh = bracket()
        mesh = mesh.replace(verts=1.0 * mesh.verts, faces=mesh.faces.int())
        return fit_pose(
            mesh, picture(view), view, init=1.0 * START, background=1.0 * BACKGROUND, fit_focal=True, steps=2, progress=False
        )  # fmt: skip

    expected = fit()
    with mode():
        found = fit()
        assert not torch.is_grad_enabled()
    assert torch.equal(found.R, expected.R) and torch.equal(found.t, expected.t) and found.loss == expected.loss
    assert expected.loss < 0.3 * expected.history[0].loss


PICTURE = picture(camera(96))


def small_fit(**options):
    target = options.get("target", PICTURE)
    given = {"mesh": bracket(), "target": target, "camera": camera(len(target)), "init": START, "steps": 6} | options
    return fit_pose(**given, progress=False)


@pytest.fixture(scope="module")
def uninterrupted():
    return small_fit()


def same(fit, other):
    """To the last bit."""
    assert torch.equal(fit.matrix, other.matrix) and torch.equal(fit.camera.K, other.camera.K)
    assert (fit.loss, fit.explained, fit.converged) == (other.loss, other.explained, other.converged)
    told = [[(s.size, s.loss, s.best, dict(s.gradient)) for s in one.history] for one in (fit, other)]
    assert told[0] == told[1] and any(gradient for _, _, _, gradient in told[0])
    for a, b in zip(fit.history, other.history, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a.pose, b.pose, strict=True))


SECOND_OPINION = {"target": picture(camera(32)).flip(1), "steps": 21, "fit_focal": True, "seed": 3}


@pytest.mark.parametrize(
    ("options", "stops"),
    [
        # On the coarsest level, on the next, at the first step, between levels, and (−1) at the end of the last.
        ({}, (4, 10)),
        pytest.param({}, (1, 7, 14, -1), marks=pytest.mark.slow, id="other places"),
        # Among other starts, on their ways to finer levels, on that of the best.
        pytest.param(SECOND_OPINION, (100, 210, 330), marks=pytest.mark.slow, id="second opinions"),
    ],
)
def test_a_resumed_fit_ends_as_if_it_had_never_stopped(options, stops, uninterrupted, tmp_path):
    whole = small_fit(**options) if options else uninterrupted
    if not options:
        sizes = [step.size[0] for step in whole.history]
        assert set(sizes) == {24, 48, 96} and sizes.count(24) > 4 and len(sizes) > 14
    for stop in stops:
        stop %= whole.steps  # −1: the last step but the final comparison

        def after_step(fit, stop=stop):
            if fit.steps == stop:
                raise KeyboardInterrupt

        options = {**options, "checkpoint": tmp_path / "fit.ckpt"}
        half = small_fit(**options, callback=after_step)
        assert half.interrupted and half.steps == stop
        again = small_fit(**options, resume=True)
        assert again.seconds > half.seconds
        same(again, whole)
    same(small_fit(**options, resume=True), whole)  # nothing left to do
    assert [path.name for path in tmp_path.iterdir()] == ["fit.ckpt"]  # nothing half done stays behind


def test_a_fit_that_was_killed_goes_on_from_its_last_checkpoint(uninterrupted, tmp_path):
    def die(fit):
        if fit.steps == 12:
            raise MemoryError

    steps = []
    with pytest.raises(MemoryError):
        small_fit(checkpoint=tmp_path / "fit.ckpt", checkpoint_every=8, callback=die)
    again = small_fit(checkpoint=tmp_path / "fit.ckpt", resume=True, callback=lambda fit: steps.append(fit.steps))
    assert steps[0] == 9
    same(again, uninterrupted)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    file = tmp_path / "fit.ckpt"
    fit = small_fit(steps=1, checkpoint=file)
    view = camera(size=96)
    for name, value in {
        "mesh": bracket().transformed(scale=1.01),
        "target": PICTURE + 0.01,
        "camera": camera(size=96, distance=4.6),
        "mask": silhouette(view),
        "weight": torch.ones(96, 96).numpy(),
        "init": torch.eye(4),
        "background": BACKGROUND,
        "fit_scale": True,
        "spp": 4,
        "steps": 2,
    }.items():
        with pytest.raises(ValueError, match=rf"resume: expected .* with another {name}; give what it was made with"):
            small_fit(**{"steps": 1, name: value}, checkpoint=file, resume=True)
    for other in ({"filter": "nearest"}, {"alpha_cutoff": 0.9}, {"wrap": "clamp"}):  # of no tensors
        with pytest.raises(ValueError, match="with another mesh; give what it was made with"):
            small_fit(steps=1, mesh=bracket().replace(**other), checkpoint=file, resume=True)
    same(small_fit(steps=1, mesh=bracket().replace(name="it"), checkpoint=file, resume=True), fit)
    for damaged in ({"format": 2}, {"format": FORMAT}, {"format": FORMAT, "given": 3, "state": {}}):
        torch.save(damaged, tmp_path / "damaged.ckpt")
        expected = (
            rf"of format {FORMAT}, got 2, which another version"
            if damaged["format"] == 2
            else "of a fit, got something else"
        )
        with pytest.raises(ValueError, match=rf"damaged\.ckpt: expected a checkpoint {expected}"):
            small_fit(checkpoint=tmp_path / "damaged.ckpt", resume=True)
    with pytest.raises(TypeError, match=r"checkpoint: expected a path, got int \(3\)"):
        small_fit(checkpoint=3)
    with pytest.raises(ValueError, match="resume: expected a checkpoint to go on from, got none"):
        small_fit(resume=True)
    with pytest.raises(TypeError, match="resume: expected True or False, got str"):
        small_fit(resume="yes", checkpoint=file)
    with pytest.raises(FileNotFoundError, match="checkpoint: expected the folder"):
        small_fit(checkpoint=tmp_path / "none" / "fit.ckpt")


def test_a_checkpoint_that_cannot_be_written_ends_no_fit(tmp_path, monkeypatch):
    def replace(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", replace)
    with pytest.warns(UserWarning, match=r"checkpoint: expected to write .*fit\.ckpt, got: No space left on device;"):
        fit = small_fit(steps=1, search=False, checkpoint=tmp_path / "fit.ckpt", checkpoint_every=1)
    assert fit.steps > 3 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("plain", [pytest.param(False, marks=pytest.mark.slow), True], ids=["coloured", "plain"])
def test_finds_the_pose_with_a_mask(plain):
    view = camera()
    clutter = torch.rand(64, 64, 3, generator=torch.Generator().manual_seed(0))
    fit = fit_pose(
        bracket(plain), picture(view, background=clutter), view, silhouette(view), START, steps=12, progress=False
    )
    degrees, percent = errors(fit)
    # Pixels on the border mix in what lies behind the object, which the mask does not undo.
    assert degrees < 1.5 and percent < 1.5


def test_finds_the_scale():
    view = camera()
    start = START.clone()
    # Larger and further away looks the same, so the depth is not sought: here it is right.
    forward = view.world_to_camera[2, :3]
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    off = forward @ (START[:3, :3] @ center + START[:3, 3] - center)
    start[:3, 3] -= off * forward
    larger = bracket().transformed(torch.eye(3).double(), -0.12 * center, 1.12)
    fit = fit_pose(
        bracket(),
        picture(view, larger),
        view,
        init=start,
        background=BACKGROUND,
        fit_scale=True,
        steps=12,
        progress=False,
    )
    degrees, percent = errors(fit)
    assert fit.scale == pytest.approx(1.12, rel=0.005)
    assert degrees < 0.5 and percent < 0.5


def test_finds_the_focal_length():
    near = camera(96, distance=2.6)  # perspective shows
    K = near.K.clone()
    K[:2, :2] *= 1.1
    start = about_center(rotation(0.05, -0.06, 0.04), (0.04, -0.03, 0.05))
    fit = fit_pose(
        bracket(),
        picture(near.replace(K=K)),
        near,
        init=start,
        background=BACKGROUND,
        fit_focal=True,
        steps=12,
        seed=1,  # of other samples, 1 of 12 takes more steps
        progress=False,
    )
    degrees, percent = errors(fit)
    assert float(fit.camera.K[0, 0] / K[0, 0]) == pytest.approx(1.0, abs=0.02)
    assert float(fit.camera.K[0, 2]) == float(near.K[0, 2])
    assert degrees < 0.5 and percent < 2.0


def test_orthographic_camera_leaves_the_depth():
    center = torch.tensor([1.0, 0.75, 0.4]).double()
    view = eg.Camera.orthographic(center + torch.tensor([1.4, 1.2, 3.5]).double(), center, height=3.5, size=(64, 64))
    fit = fit_pose(bracket(), picture(view), view, init=START, background=BACKGROUND, steps=10, progress=False)
    degrees, _ = errors(fit)
    q = view.world_to_camera[:3, :3] @ (fit.R @ center + fit.t - center)
    started = view.world_to_camera[:3, :3] @ (START[:3, :3] @ center + START[:3, 3] - center)
    assert degrees < 0.5 and float(q[:2].norm()) < 0.01 and float(q[2] - started[2]) == pytest.approx(0.0, abs=1e-9)


def test_scene_of_several_meshes_moves_together():
    view, mesh = camera(), bracket()
    parts = [mesh.replace(faces=mesh.faces[k], face_colors=mesh.face_colors[k]) for k in (slice(0, 9), slice(9, 20))]
    fit = fit_pose(eg.Scene(parts, BACKGROUND), picture(view), view, init=START, steps=10, progress=False)
    assert max(errors(fit)) < 0.5


def test_a_picture_larger_than_max_size_is_reduced():
    view = camera(96)
    fit = fit_pose(
        bracket(), picture(view), view, init=START, background=BACKGROUND, max_size=32, steps=12, progress=False
    )
    assert max(max(step.size) for step in fit.history) == 32
    assert max(errors(fit)) < 1.5
    assert fit.camera is view


def test_the_same_seed_gives_the_same_fit():
    view = camera(24)
    fits = [
        fit_pose(bracket(), picture(view), view, init=START, background=BACKGROUND, seed=s, steps=2, progress=False)
        for s in (3, 3, 4)
    ]
    assert torch.equal(fits[0].matrix, fits[1].matrix)
    assert not torch.equal(fits[0].matrix, fits[2].matrix)


def test_interruption_keeps_the_best_pose():
    view = camera(48)
    seen = []

    def stop(fit):
        seen.append(fit)
        if len(seen) == 7:
            raise KeyboardInterrupt

    fit = fit_pose(bracket(), picture(view), view, init=START, background=BACKGROUND, progress=False, callback=stop)
    assert fit.interrupted and not fit.converged and fit.steps == 7
    assert torch.equal(fit.matrix, seen[-1].matrix)
    assert fit.loss == min(f.loss for f in seen) and fit.loss < seen[0].loss
    assert sum(errors(fit)) < 5.0  # 12 + 8 at the start, 1.3 now


def test_json_round_trip():
    view = camera(24)
    fit = fit_pose(bracket(), picture(view), view, init=START, background=BACKGROUND, steps=1, progress=False)
    back = PoseFit.from_json(fit.to_json())
    torch.testing.assert_close(back.matrix, fit.matrix, rtol=0, atol=1e-12)
    assert torch.equal(back.camera.K, fit.camera.K) and back.camera.size == fit.camera.size
    assert (back.loss, back.steps, back.converged, back.interrupted) == (fit.loss, fit.steps, fit.converged, False)
    torch.testing.assert_close(pose_from_json(fit.to_json()).matrix, fit.matrix, rtol=0, atol=1e-12)
    again = fit_pose(bracket(), picture(view), view, init=back, background=BACKGROUND, steps=1, progress=False)
    assert torch.allclose(again.history[0].pose.matrix, fit.matrix)


@pytest.mark.parametrize(
    "text, message",
    [
        ("{", "expected JSON"),
        ("[]", 'expected a JSON object, got list; write {"mesh_to_world": …}'),
        ("{}", "expected the entry 'mesh_to_world'"),
        ('{"mesh_to_world": [[1, 0], [0, 1]]}', "mesh_to_world: expected shape (4, 4)"),
        ('{"mesh_to_world": "here"}', "mesh_to_world: expected"),
        ('{"mesh_to_world": [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]}', "determinant"),
        ('{"mesh_to_world": [[1,0.5,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}', "shear"),
        ('{"mesh_to_world": [[1,0,0,0],[0,1,0,0],[0,0,1,0],[1,2,3,1]]}', "transposed"),
    ],
)
def test_faults_of_pose_json(text, message):
    with pytest.raises((ValueError, TypeError)) as caught:
        pose_from_json(text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    "change, error, message",
    [
        ({"mesh": "bracket.obj"}, TypeError, "mesh: expected a Mesh or a Scene, got str"),
        ({"target": torch.zeros(32, 64, 3)}, ValueError, "target: expected shape (64, 64, C), got (32, 64, 3)"),
        ({"target": torch.zeros(64, 64, 4)}, ValueError, "target: expected 3 channels"),
        (
            {"target": [torch.zeros(64, 64, 3)] * 2},
            ValueError,
            "target: expected one, for the one camera, got a list of 2",
        ),
        (
            {"target": torch.zeros(64, 64, 3)},
            ValueError,
            "target: expected a picture of the object, got the same in every",
        ),
        (
            {"mask": torch.ones(64, 64), "target": torch.zeros(64, 64, 3)},
            ValueError,
            "mask: expected a picture of the object",
        ),
        ({"target": torch.full((64, 64, 3), math.nan)}, ValueError, "target: expected finite"),
        ({"camera": np.eye(4)}, TypeError, "camera: expected a Camera, got ndarray"),
        ({"camera": eg.Camera.stack([camera(), camera()])}, ValueError, "camera: expected one camera, got 2"),
        ({"mask": torch.ones(8, 8)}, ValueError, "mask: expected shape (64, 64) or (64, 64, 1), got (8, 8)"),
        ({"mask": torch.ones(64, 64), "background": 0.0}, ValueError, "background: expected None with a mask"),
        ({"background": torch.ones(2)}, ValueError, "background: expected shape (3,) or (64, 64, 3), got (2,)"),
        ({"init": torch.eye(3)}, ValueError, "init: expected shape (4, 4), got (3, 3)"),
        (
            {"init": about_center(torch.eye(3).double(), (20.0, 0.0, -8.0))},
            ValueError,
            "init: expected a pose at which",
        ),
        (
            {"init": about_center(torch.eye(3).double(), (3.0, 3.0, 9.0))},
            ValueError,
            "init: expected the object in front",
        ),
        ({"steps": 0}, ValueError, "steps: expected an int from 1"),
        ({"spp": 1.5}, TypeError, "spp: expected an int"),
        ({"tolerance": 0.0}, ValueError, "tolerance: expected a number above 0 and below 1, got 0"),
    ],
)
def test_errors_name_the_argument(change, error, message):
    something = torch.eye(64)[..., None].expand(-1, -1, 3)
    arguments = {"mesh": bracket(), "target": something, "camera": camera(), **change}
    with pytest.raises(error) as caught:
        fit_pose(**arguments, progress=False)
    assert message in str(caught.value)


def test_the_curvature_from_probes():
    """Their mean is JᵀJ: for 24 probes the relative error is about √(2/24) = 0.29 an entry on the diagonal."""
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(4000, 3, generator=generator).double()
    p = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    found = [NormalEquations.from_probes(p, [J @ p + 1.0], 24, generator) for _ in range(50)]
    mean = torch.stack([one.curvature for one in found]).mean(0)
    # 1200 probes: √(2/1200) = 0.04; four of it.
    assert float((mean - J.T @ J).norm() / (J.T @ J).norm()) < 0.16
    torch.testing.assert_close(found[0].gradient, J.sum(0))


def test_the_normal_equations_of_several_images():
    generator = torch.Generator().manual_seed(0)
    tangents = [torch.randn(3, *shape, generator=generator) for shape in ((4, 5, 2), (6, 3, 2))]
    residuals = [torch.randn(J.shape[1:], generator=generator) for J in tangents]
    curvature, gradient = NormalEquations.from_tangents(residuals, tangents)
    J = torch.cat([one.flatten(1) for one in tangents], 1).double()
    torch.testing.assert_close(curvature, J @ J.T)
    torch.testing.assert_close(gradient, J @ torch.cat([r.flatten() for r in residuals]).double())


def test_gauss_newton_goes_to_the_minimum_and_back_from_a_rise():
    generator = torch.Generator().manual_seed(0)
    J = torch.randn(500, 3, generator=generator).double() * torch.tensor([1.0, 0.2, 3.0]).double()
    truth, at = torch.tensor([0.2, -0.3, 0.1]).double(), torch.zeros(3).double()
    search = GaussNewton()

    def refused():
        raise AssertionError

    for _ in range(40):
        r = J @ (at - truth)
        assert search.observe(float(r.square().mean()), lambda r=r: NormalEquations.from_tangents([r], [J.T]))
        at = at + search.step()
    assert float((at - truth).norm()) < 1e-3
    damping = search.damping
    assert not search.observe(1e6, refused) and search.damping > damping
    assert not search.observe(math.nan, refused)
