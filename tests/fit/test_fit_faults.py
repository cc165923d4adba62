"""fit-pose is killed, has no room or rights to write, or cannot print."""

import errno
import json
import os
import random
import shutil
import signal
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from bracket_files import write_bracket

import edgegrad.fit
from edgegrad import cli
from edgegrad.fit.pose.result import PoseFit

pytestmark = pytest.mark.unsanitized

try:
    import resource
except ImportError:  # Windows
    resource = None

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals, limits and /dev/full of Linux")


@pytest.fixture
def files(tmp_path, monkeypatch):
    return write_bracket(tmp_path, 24)


def arguments(files, out="out", steps=None):
    names = {"--camera": "camera.json", "--init": "init.json", "--out": out}
    paths = [text for name, file in names.items() for text in (name, str(files / file))]
    paths += [] if steps is None else ["--steps", str(steps)]
    return ["fit-pose", str(files / "mesh.ply"), str(files / "target.png"), *paths]


class Forked:
    """A child process that runs `work()` and exits with its result; `out` is what it writes to file descriptors 1 and
    2."""

    def __init__(self, work):
        read, write = os.pipe()
        self.pid = os.fork()
        if self.pid == 0:
            code = 70
            try:
                os.dup2(write, 1), os.dup2(write, 2)
                # Not pytest's, which keep what is written.
                sys.stdout, sys.stderr = (os.fdopen(number, "w", closefd=False) for number in (1, 2))
                code = work()
                sys.stdout.flush(), sys.stderr.flush()
            finally:
                os._exit(code)
        os.close(write)
        self.out = os.fdopen(read)

    def wait(self):
        """Return the exit code, or minus the signal that ended the child."""
        with self.out:
            return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


# -- killed -----------------------------------------------------------------------------------------------------------


def printing_fit(*args, options, **given):
    """Run fit_pose and print the best pose before it may be written, so that the file is at most one step behind."""

    def print_and_call(fit):
        print(fit.to_json().replace("\n", " "), flush=True)
        options.callback(fit)

    return FIT_POSE(*args, options=replace(options, callback=print_and_call, progress=False), **given)


FIT_POSE = edgegrad.fit.fit_pose


@linux
@pytest.mark.parametrize("kills", [2, pytest.param(60, marks=pytest.mark.slow)])
def test_a_killed_fit_leaves_the_best_pose_so_far(files, kills, monkeypatch):
    monkeypatch.setattr(edgegrad.fit, "fit_pose", printing_fit)
    chance = random.Random(kills)
    for kill in range(kills):
        out = f"out{kill}"
        run = Forked(lambda out=out: cli.main(arguments(files, out)))
        steps = chance.randint(0, 40) if kill else 0  # of about 60
        printed = [json.loads(run.out.readline()) for _ in range(steps)]
        # From the next step's beginning to its end; the first step comes after reading the files.
        time.sleep(chance.uniform(0.0, 0.02 if steps else 0.2))
        os.kill(run.pid, signal.SIGKILL)
        printed += [json.loads(line) for line in run.out if line.endswith("\n")]
        assert run.wait() == -signal.SIGKILL
        file = files / out / "pose.json"
        if len(printed) > 1 or file.exists():
            found = json.loads(file.read_text())
            PoseFit.from_json(file.read_text())  # nothing is missing
            assert found in printed[-2:], (steps, found, printed[-2:])


def test_the_pose_on_disk_follows_the_search(files, monkeypatch):
    poses = []

    def watched(*args, options, **given):
        def watch(fit):
            options.callback(fit)
            text = (files / "out" / "pose.json").read_text()
            assert text == fit.to_json() + "\n"
            poses.append(PoseFit.from_json(text))

        return FIT_POSE(*args, options=replace(options, callback=watch), **given)

    monkeypatch.setattr(edgegrad.fit, "fit_pose", watched)
    assert cli.main(arguments(files, steps=4)) == 0
    assert [pose.steps for pose in poses] == list(range(1, len(poses) + 1))
    assert len(poses) > 5 and len({str(pose.matrix) for pose in poses}) > 2


# -- nowhere to write -------------------------------------------------------------------------------------------------


def is_a_result(printed):
    """Return whether a pose is printed: four rows of four numbers, the last 0 0 0 1."""
    lines = printed.splitlines()
    at = lines.index("mesh to world:")
    rows = [[float(number) for number in line.split()] for line in lines[at + 1 : at + 5]]
    return rows[3] == [0.0, 0.0, 0.0, 1.0] and all(len(row) == 4 for row in rows) and "loss" in lines[at - 1]


@pytest.mark.parametrize("code", [errno.ENOSPC, pytest.param(errno.EACCES, marks=pytest.mark.slow)])
def test_a_fit_that_cannot_be_written_is_printed(files, code, monkeypatch, capsys):
    """The disk is full, or the rights to write are taken away during the fit."""

    def replace(source, target):
        raise OSError(code, os.strerror(code), source, None, target)

    monkeypatch.setattr(os, "replace", replace)
    monkeypatch.setattr(edgegrad.fit, "fit_pose", partial(FIT_POSE, search=False))
    with pytest.warns(UserWarning, match=rf"checkpoint\.pt: expected .*{os.strerror(code)}.*; the fit goes on without"):
        assert cli.main(arguments(files, steps=1)) == 2
    said = capsys.readouterr()
    assert is_a_result(said.out)
    last = said.err.splitlines()[-1]
    assert f"{files / 'out' / 'pose.json'}: expected to write it" in last and os.strerror(code) in last
    assert list((files / "out").iterdir()) == []  # nothing half done stays behind


def test_a_folder_that_vanishes_during_the_fit(files, monkeypatch, capsys):
    def vanishing(*args, options, **given):
        def after_step(fit):
            options.callback(fit)
            if fit.steps == 3:
                shutil.rmtree(files / "out")

        return FIT_POSE(*args, options=replace(options, callback=after_step), **{**given, "search": False})

    monkeypatch.setattr(edgegrad.fit, "fit_pose", vanishing)
    assert cli.main(arguments(files, steps=1)) == 0  # it is made again
    assert is_a_result(capsys.readouterr().out) and (files / "out" / "pose.json").exists()


@pytest.mark.parametrize("out", ["mesh.ply", "mesh.ply/out"])
def test_a_folder_that_cannot_be_made_is_named_before_the_fit(files, out, monkeypatch, capsys):
    monkeypatch.setattr(edgegrad.fit, "fit_pose", lambda *_, **__: pytest.fail("no fit should begin"))
    assert cli.main(arguments(files, out)) == 2
    said = capsys.readouterr()
    assert f"--out: expected a folder to write to, got {files / out}" in said.err and said.out == ""


def test_a_folder_without_permission_is_named_before_the_fit(files, monkeypatch, capsys):
    """The test replaces access(), since root, who may run tests, may write anywhere."""
    monkeypatch.setattr(edgegrad.fit, "fit_pose", lambda *_, **__: pytest.fail("no fit should begin"))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != files / "out")
    assert cli.main(arguments(files)) == 2
    assert f"got {files / 'out'} (Permission denied)" in capsys.readouterr().err


@pytest.mark.slow
@linux
@pytest.mark.filterwarnings("ignore:checkpoint. .*expected to write")  # of files larger than the limits
@pytest.mark.parametrize(("limit", "file"), [(100, "pose.json"), (6144, "fit.png")])
def test_a_file_that_cannot_grow(files, limit, file):
    def fit():
        # Python ignores SIGXFSZ, so writing fails as on a full disk.
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
        return cli.main(arguments(files, steps=1))

    run = Forked(fit)
    said = run.out.read()
    assert run.wait() == 2 and is_a_result(said), said
    last = said.splitlines()[-1]
    assert f"{files / 'out' / file}: expected to write it, got: File too large" in last, said
    # What could be written is whole; what could not is not there.
    left = sorted(path.name for path in (files / "out").iterdir())
    assert left == ([] if file == "pose.json" else ["pose.json"])
    if left:
        assert PoseFit.from_json((files / "out" / "pose.json").read_text()).steps > 5


@pytest.mark.slow
@linux
def test_a_result_that_cannot_be_printed_is_written(files, monkeypatch, capsys):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        assert cli.main(arguments(files, steps=1)) == 2
        monkeypatch.undo()
        # Closing would fail again on what is still to be written.
        os.dup2(os.open(os.devnull, os.O_WRONLY), full.fileno())
    assert "No space left on device" in capsys.readouterr().err.splitlines()[-1]
    assert PoseFit.from_json((files / "out" / "pose.json").read_text()).steps > 5
    assert (files / "out" / "fit.png").exists()
