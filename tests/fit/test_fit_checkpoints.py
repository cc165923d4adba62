"""Checkpoints of fit_pose: a fit that goes on ends as one that never stopped, and files of other fits are refused."""

import pytest
import torch
from brackets import START, bracket, camera, picture, silhouette
from quiet_fits import arranged

from edgegrad.fit import fit_pose
from edgegrad.fit.checkpoints import FORMAT

pytestmark = pytest.mark.unsanitized
PICTURE = picture(camera(96))


def small_fit(**options):
    target = options.get("images", PICTURE)
    given = {"mesh": bracket(), "images": target, "cameras": camera(len(target)), "init": START, "steps": 6} | options
    return fit_pose(**arranged(**given))


@pytest.fixture(scope="module")
def uninterrupted():
    return small_fit()


def same(fit, other):
    """Check that two fits are equal to the last bit."""
    assert torch.equal(fit.matrix, other.matrix) and torch.equal(fit.camera.K, other.camera.K)
    assert (fit.loss, fit.explained, fit.converged) == (other.loss, other.explained, other.converged)
    histories = [[(s.size, s.loss, s.best, dict(s.gradient)) for s in one.history] for one in (fit, other)]
    assert histories[0] == histories[1] and any(gradient for _, _, _, gradient in histories[0])
    for a, b in zip(fit.history, other.history, strict=True):
        assert all(torch.equal(x, y) for x, y in zip(a.pose, b.pose, strict=True))


SECOND_OPINION = {"images": picture(camera(32)).flip(1), "steps": 21, "focal": True, "seed": 3}


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
        small_fit(checkpoint=tmp_path / "fit.ckpt", every=8, callback=die)
    again = small_fit(checkpoint=tmp_path / "fit.ckpt", resume=True, callback=lambda fit: steps.append(fit.steps))
    assert steps[0] == 9
    same(again, uninterrupted)


def test_a_checkpoint_of_another_fit_is_refused(tmp_path):
    file = tmp_path / "fit.ckpt"
    quick = {"steps": 1, "search": False}
    fit = small_fit(**quick, checkpoint=file)
    view = camera(size=96)
    for name, value in {
        "mesh": bracket().transformed(scale=1.01),
        "images": PICTURE + 0.01,
        "cameras": camera(size=96, distance=4.6),
        "masks": silhouette(view),
        "weights": torch.ones(96, 96).numpy(),
        "init": torch.eye(4),
        "scale": True,
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
    with pytest.warns(UserWarning, match=r"checkpoint: expected to write .*fit\.ckpt, got: No space left on device;"):
        fit = small_fit(steps=1, search=False, checkpoint=tmp_path / "fit.ckpt", every=1)
    assert fit.steps > 3 and list(tmp_path.iterdir()) == []
