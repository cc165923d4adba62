"""fit_pose on a small coloured bracket finds poses, names wrong arguments, and keeps the best pose when interrupted."""

import pickle
from dataclasses import replace

import pytest
import torch
from brackets import BACKGROUND, CENTER, START, before_sky, bracket, camera, errors, picture, silhouette
from quiet_fits import quiet

import edgegrad as eg
from edgegrad.fit import fit_pose
from edgegrad.fit.pose.result import PoseFit, pose_from_json

pytestmark = pytest.mark.unsanitized


@pytest.mark.parametrize(
    "background",
    [pytest.param(BACKGROUND, marks=pytest.mark.slow), None, pytest.param("image", marks=pytest.mark.slow)],
    ids=["colour", "border", "image"],
)
def test_finds_the_pose(background, capsys):
    view = camera(48)
    if background == "image":
        background = torch.rand(48, 48, 3, generator=torch.Generator().manual_seed(0))
    target = picture(view, background=BACKGROUND if background is None else background)
    fit = fit_pose(eg.Scene([bracket()], background), target, view, init=START, options=quiet())
    degrees, percent = errors(fit)
    # 48² pixels: a tenth of a pixel is 0.33 % of the size.
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
    view = camera(48)
    fit = fit_pose(before_sky(), picture(view), view, search=False, options=quiet(steps=12))
    assert fit.reason == "converged" and errors(fit)[0] < 0.2 and errors(fit)[1] < 0.5


@pytest.mark.parametrize("mode", [pytest.param(torch.no_grad, marks=pytest.mark.slow), torch.inference_mode])
def test_where_gradients_are_off(mode):
    """A fit takes gradients of its own, also of tensors that were made in inference mode."""

    def fit():
        view = camera(size=24).to(torch.float64)
        mesh = bracket()
        mesh = mesh.replace(verts=1.0 * mesh.verts, faces=mesh.faces.int())
        return fit_pose(
            eg.Scene([mesh], 1.0 * BACKGROUND), picture(view), view, init=1.0 * START, focal=True, search=False,
            options=quiet(steps=2),
        )  # fmt: skip

    expected = fit()
    with mode():
        found = fit()
        assert not torch.is_grad_enabled()
    assert torch.equal(found.R, expected.R) and torch.equal(found.t, expected.t) and found.loss == expected.loss
    assert expected.loss < 0.3 * expected.history[0].loss
    K, start = expected.camera.K, camera(size=24).K
    assert K[0, 0] != start[0, 0] and torch.equal(K[:2, 2], start[:2, 2].to(K))  # only the focal length was sought


@pytest.mark.parametrize("plain", [pytest.param(False, marks=pytest.mark.slow), True], ids=["coloured", "plain"])
def test_finds_the_pose_with_a_mask(plain):
    view = camera(48)
    clutter = torch.rand(48, 48, 3, generator=torch.Generator().manual_seed(0))
    fit = fit_pose(
        bracket(plain), picture(view, background=clutter), view, silhouette(view), START, options=quiet(steps=12)
    )
    degrees, percent = errors(fit)
    # Pixels on the border mix in what lies behind the object, which the mask does not undo.
    assert degrees < 1.5 and percent < 1.5


def test_finds_the_scale():
    view = camera(48)
    start = START.clone()
    # A larger object further away looks the same, so the depth is not fitted. Here it is right.
    forward = view.world_to_camera[2, :3]
    off = forward @ (START[:3, :3] @ CENTER + START[:3, 3] - CENTER)
    start[:3, 3] -= off * forward
    larger = bracket().transformed(torch.eye(3).double(), -0.12 * CENTER, 1.12)
    fit = fit_pose(
        before_sky(), picture(view, larger), view, init=start, scale=True, search=False, options=quiet(steps=12)
    )
    degrees, percent = errors(fit)
    assert fit.scale == pytest.approx(1.12, rel=0.005)
    assert degrees < 0.5 and percent < 0.5


def test_orthographic_camera_leaves_the_depth():
    view = eg.Camera.orthographic(CENTER + torch.tensor([1.4, 1.2, 3.5]).double(), CENTER, height=3.5, size=(40, 40))
    fit = fit_pose(before_sky(), picture(view), view, init=START, search=False, options=quiet(steps=10))
    degrees, _ = errors(fit)
    q = view.world_to_camera[:3, :3] @ (fit.R @ CENTER + fit.t - CENTER)
    started = view.world_to_camera[:3, :3] @ (START[:3, :3] @ CENTER + START[:3, 3] - CENTER)
    assert degrees < 0.5 and float(q[:2].norm()) < 0.01 and float(q[2] - started[2]) == pytest.approx(0.0, abs=1e-9)


def test_several_meshes_move_together_in_a_picture_larger_than_max_size():
    view, mesh = camera(64), bracket()
    parts = [mesh.replace(faces=mesh.faces[k], face_colors=mesh.face_colors[k]) for k in (slice(0, 9), slice(9, 20))]
    fit = fit_pose(
        eg.Scene(parts, BACKGROUND), picture(view), view, init=START, search=False, options=quiet(max_size=32, steps=12)
    )
    assert max(max(step.size) for step in fit.history) == 32
    assert max(errors(fit)) < 0.5
    assert torch.equal(fit.camera.K, view.K) and fit.camera.size == view.size


def test_the_same_seed_gives_the_same_fit():
    view = camera(24)
    fits = [
        fit_pose(before_sky(), picture(view), view, init=START, search=False, options=quiet(steps=2, seed=seed))
        for seed in (3, 3, 4)
    ]
    assert torch.equal(fits[0].matrix, fits[1].matrix)
    assert not torch.equal(fits[0].matrix, fits[2].matrix)


def test_interruption_keeps_the_best_pose():
    view = camera(48)
    seen = []

    def stop(fit):
        seen.append(fit)
        if len(seen) == 10:
            raise KeyboardInterrupt

    fit = fit_pose(before_sky(), picture(view), view, init=START, options=quiet(callback=stop))
    assert fit.interrupted and not fit.converged and fit.steps == len(fit.history) >= 10
    assert torch.equal(fit.matrix, seen[-1].matrix)
    assert fit.loss == min(f.loss for f in seen) and fit.loss < seen[0].loss
    assert sum(errors(fit)) < 10.0  # 12 + 8 at the start


def test_json_round_trip():
    view = camera(24)
    fit = fit_pose(before_sky(), picture(view), view, init=START, search=False, options=quiet(steps=1))
    back = PoseFit.from_json(fit.to_json())
    torch.testing.assert_close(back.matrix, fit.matrix, rtol=0, atol=1e-12)
    assert torch.equal(back.camera.K, fit.camera.K) and back.camera.size == fit.camera.size
    names = ("loss", "steps", "converged", "interrupted", "reason", "enough", "visible")
    for name in names:
        assert getattr(back, name) == getattr(fit, name), name
    assert [mode.probability for mode in back.modes] == [mode.probability for mode in fit.modes] and back.modes
    doubtful = replace(fit, conflict="ambiguous: another pose", visible=0.3)
    assert PoseFit.from_json(doubtful.to_json()).reason == doubtful.reason
    torch.testing.assert_close(pose_from_json(fit.to_json()).matrix, fit.matrix, rtol=0, atol=1e-12)
    again = fit_pose(before_sky(), picture(view), view, init=back, search=False, options=quiet(steps=1))
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
