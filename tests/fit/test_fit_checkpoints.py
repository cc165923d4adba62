"""Checkpoints of fits: one that goes on ends as if it had never stopped, and files of other fits are refused."""

from functools import partial

import pytest
import torch
from brackets import START, about_center, before_sky, bracket, camera, picture, rotation, silhouette
from photographs import photograph
from quiet_fits import arranged
from small_scenes import ball, egg_views, pictures, views

import edgegrad as eg
from edgegrad.fit import PoseParameter, Refinement, calibrate, fit_camera, fit_pose, fit_scene, fit_shape
from edgegrad.fit.checkpoints import FORMAT
from edgegrad.fit.descent.result import Fit
from edgegrad.fit.pose.result import PoseFit, Step

pytestmark = pytest.mark.unsanitized
PICTURE = picture(camera(64))


def small_fit(**options):
    target = options.get("images", PICTURE)
    shown = {"mesh": bracket(), "images": target, "cameras": camera(len(target))}
    return fit_pose(**arranged(**{**shown, "init": START, "search": False, "steps": 6, **options}))


@pytest.fixture(scope="module")
def uninterrupted():
    return small_fit()


def same(fit, other):
    """Check that two fits are equal to the last bit."""
    assert (fit.loss, fit.explained, fit.reason) == (other.loss, other.explained, other.reason)
    assert all(torch.equal(a, b) for a, b in zip(numbers(fit), numbers(other), strict=True))
    assert any(step.gradient for step in fit.history)
    for a, b in zip(fit.history, other.history, strict=True):
        assert repr((a.loss, dict(a.gradient))) == repr((b.loss, dict(b.gradient)))  # NaN equals NaN
        if isinstance(a, Step):
            assert (a.size, a.best) == (b.size, b.best) and all(map(torch.equal, a.pose, b.pose))
        else:
            assert a.step == b.step and all(torch.equal(value, b.values[name]) for name, value in a.values.items())


def numbers(fit):
    """Return the tensors that a fit has found."""
    if isinstance(fit, Fit):
        return [*fit.values.values(), *(mesh.verts for mesh in fit.scene.meshes)]
    cameras = [fit.camera] if isinstance(fit, PoseFit) else fit.cameras
    found = [fit.matrix] if isinstance(fit, PoseFit) else [camera.world_to_camera for camera in cameras]
    return found + [tensor for camera in cameras for tensor in (camera.K, camera.coefficients)]


# -- fits of every kind -----------------------------------------------------------------------------------------------


def colors(**options):
    cameras = views()
    target, start = pictures(before_sky(), cameras), bracket().replace(face_colors=torch.full((20, 3), 0.4))
    wanted = {"meshes.0.face_colors": 0.03, "background": 0.02}
    given = {"steps": 30, "patience": 5, "views_per_step": 2, "spp": 4, **options}
    return fit_scene(eg.Scene([start], torch.zeros(3)), target, cameras, wanted, **arranged(**given))


def placed(rate=0.02, **options):
    view, wanted = camera(24), {"meshes.0.pose": PoseParameter(START, rotation=rate, shift=0.01)}
    return fit_scene(before_sky(), picture(view), view, wanted, **arranged(**{"steps": 12, "spp": 4, **options}))


def region(**options):
    """It may stop between two counts of the colours."""
    view = camera(48)
    wanted = {"pose": PoseParameter(about_center(rotation(0.05, -0.04, 0.03), (0.1, 0.0, 0.0)))}
    given = {"loss": "region", "method": "gauss-newton", "spp": 4, "steps": 8, **options}
    return fit_scene(bracket(True), photograph(view), view, wanted, **arranged(**given))


def shape(**options):
    pytest.importorskip("gpytoolbox")
    cameras, masks = egg_views()
    given = {"masks": masks, "refinement": Refinement(2), "steps": 6, "spp": 4, **options}
    return fit_shape(ball(1), None, cameras, **arranged(**given))


def in_photograph(**options):
    view = camera(48)
    given = {"init": about_center(rotation(0.05, -0.04, 0.03)), "search": False, "spp": 8, "steps": 4, **options}
    return fit_pose(bracket(), photograph(view), view, **arranged(**given))


def one_camera(**options):
    true = camera(48)
    start = true.replace(world_to_camera=true.world_to_camera @ about_center(rotation(-0.05, 0.06, -0.04)))
    return fit_camera(before_sky(), picture(true), start, **arranged(**{"steps": 4, **options}))


def one_lens(**options):
    first, off = camera(48, 2.4).to(torch.float64), about_center(rotation(0.04, -0.05, 0.03), (0.05, -0.04, 0.03))
    true = [first, first.replace(world_to_camera=first.world_to_camera @ about_center(rotation(0.2, 0.9, 0.1)))]
    start = [one.replace(world_to_camera=one.world_to_camera @ off) for one in true]
    return calibrate(before_sky(), [picture(one) for one in true], start, distortion=1, **arranged(**options))


def after(count):
    return lambda seen: len(seen) == count


@pytest.mark.parametrize(
    ("fit", "stop"),
    [
        (colors, after(14)), (placed, after(6)), (partial(placed, method="gauss-newton"), after(6)), (region, after(5)),
        (shape, after(9)), pytest.param(one_camera, after(8), marks=pytest.mark.slow),
        pytest.param(in_photograph, after(5), marks=pytest.mark.slow),
        pytest.param(one_lens, after(1), marks=pytest.mark.slow, id="first picture"),
        pytest.param(one_lens, lambda seen: len(seen[-1].searches) == 2, marks=pytest.mark.slow, id="second picture"),
    ],
)  # fmt: skip
def test_fits_of_every_kind_stop_and_go_on(fit, stop, tmp_path):
    """Ctrl-C ends a fit with what it has. From its checkpoint it ends as if it had never stopped."""
    seen = []

    def after_step(now):
        seen.append(now)
        if stop(seen):
            raise KeyboardInterrupt

    whole, half = fit(), fit(checkpoint=tmp_path / "fit.ckpt", callback=after_step)
    assert half.interrupted and not half.converged and half.reason == "interrupted"
    if fit is one_lens:
        assert len(half.cameras) == len(seen[-1].searches) and half.uncertainty is None
    else:
        assert half.steps == len(seen)
    if fit is colors:
        assert half.loss < 0.7 * half.history[0].loss  # It has the best values.
    for _ in range(2):  # At last nothing is left to do.
        same(fit(checkpoint=tmp_path / "fit.ckpt", resume=True), whole)
    parts = ["fit-0001.ckpt", "fit-0002.ckpt"] if fit is one_lens else ["fit.ckpt"]
    assert sorted(path.name for path in tmp_path.iterdir()) == parts  # nothing half done stays behind


# -- poses ------------------------------------------------------------------------------------------------------------

SECOND_OPINION = {"images": picture(camera(32)).flip(1), "search": True, "steps": 21, "focal": True, "seed": 3}


@pytest.mark.parametrize(
    ("options", "stops"),
    [
        # On a finer level; on the coarsest, at the first step, between levels, and (−1) at the end of the last.
        ({}, (10,)),
        pytest.param({}, (4, 1, 7, 14, -1), marks=pytest.mark.slow, id="other places"),
        # Among other starts, on their ways to finer levels, on that of the best.
        pytest.param(SECOND_OPINION, (100, 210, 330), marks=pytest.mark.slow, id="second opinions"),
    ],
)
def test_a_resumed_fit_ends_as_if_it_had_never_stopped(options, stops, uninterrupted, tmp_path):
    whole = small_fit(**options) if options else uninterrupted
    if not options:
        sizes = [step.size[0] for step in whole.history]
        assert set(sizes) == {32, 64} and sizes.count(32) > 4 and len(sizes) > 14
    for stop in stops:
        stop = stop % whole.steps or 1  # −1: the last step but the final comparison

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
        small_fit(checkpoint=tmp_path / "fit.ckpt", every=8, callback=die)
    again = small_fit(checkpoint=tmp_path / "fit.ckpt", resume=True, callback=lambda fit: steps.append(fit.steps))
    assert steps[0] == 9
    same(again, uninterrupted)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    file = tmp_path / "fit.ckpt"
    quick = {"images": picture(camera(24)), "steps": 1}
    fit = small_fit(**quick, checkpoint=file)
    view = camera(size=24)
    for name, value in {
        "mesh": bracket().transformed(scale=1.01),
        "images": quick["images"] + 0.01,
        "cameras": camera(size=24, distance=4.6),
        "masks": silhouette(view),
        "weights": torch.ones(24, 24).numpy(),
        "depths": torch.ones(24, 24),
        "init": torch.eye(4),
        "scale": True,
        "symmetries": eg.Symmetries(),
        "spp": 4,
        "steps": 2,
    }.items():
        with pytest.raises(
            ValueError, match=rf"checkpoint: expected .* with another {name}; give what it was made with"
        ):
            small_fit(**{**quick, name: value}, checkpoint=file, resume=True)
    for other in ({"filter": "nearest"}, {"alpha_cutoff": 0.9}, {"wrap": "clamp"}):  # of no tensors
        with pytest.raises(ValueError, match="with another mesh; give what it was made with"):
            small_fit(**quick, mesh=bracket().replace(**other), checkpoint=file, resume=True)
    same(small_fit(**quick, mesh=bracket().replace(name="it"), checkpoint=file, resume=True), fit)
    placed(steps=1, checkpoint=tmp_path / "placed.ckpt")
    with pytest.raises(ValueError, match="with another parameters; give what it was made with"):
        placed(0.03, steps=1, checkpoint=tmp_path / "placed.ckpt", resume=True)
    drawn = small_fit(**quick, seed=None, checkpoint=tmp_path / "drawn.ckpt")  # by torch's generator
    same(small_fit(**quick, seed=None, checkpoint=tmp_path / "drawn.ckpt", resume=True), drawn)
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
    with pytest.warns(UserWarning, match=r"checkpoint: expected .*new\.ckpt to go on from, got no such file"):
        same(small_fit(**quick, checkpoint=tmp_path / "new.ckpt", resume=True), fit)
    with pytest.raises(TypeError, match=r"checkpoint\.resume: expected True or False, got str"):
        small_fit(resume="yes", checkpoint=file)
    with pytest.raises(FileNotFoundError, match="checkpoint: expected the folder"):
        small_fit(checkpoint=tmp_path / "none" / "fit.ckpt")


def test_a_checkpoint_that_cannot_be_written_ends_no_fit(tmp_path, monkeypatch):
    def replace(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", replace)
    with pytest.warns(UserWarning, match=r"checkpoint: .*fit\.ckpt: expected to write it, got: No space left"):
        fit = small_fit(steps=1, search=False, checkpoint=tmp_path / "fit.ckpt", every=1)
    assert fit.steps > 3 and list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["folder", "weights", "text"])
def test_a_checkpoint_overwrites_nothing_else(tmp_path, kind):
    """Before the fit begins, so that no work is lost."""
    path = tmp_path / "kept.pt"
    if kind == "folder":
        path.mkdir()
    elif kind == "weights":
        torch.save({"my": "weights"}, path)
    else:
        path.write_text("notes")
    before = None if kind == "folder" else path.read_bytes()
    steps = []
    with pytest.raises(ValueError, match=f"checkpoint: expected .*{'folder' if kind == 'folder' else 'another file'}"):
        small_fit(checkpoint=path, callback=steps.append)
    assert not steps and (before is None or path.read_bytes() == before)


def test_an_empty_file_and_another_fits_checkpoint_are_replaced(tmp_path):
    path = tmp_path / "fit.pt"
    path.touch()
    small_fit(checkpoint=path, steps=1)
    written = path.read_bytes()
    small_fit(checkpoint=path, steps=2)
    assert written and path.read_bytes() != written
