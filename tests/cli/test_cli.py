"""The command line as a whole: demo, doctor, help, typing errors, and Ctrl-C while it starts."""

import subprocess
import sys
from functools import partial

import pytest
from cli_fixtures import run

import edgegrad as eg
from edgegrad import cli, demo
from edgegrad.cli import doctor

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]


def test_demo_prints_errors_and_writes_pictures(tmp_path, capsys, monkeypatch):
    pytest.importorskip("pyvista", reason="needs the extra edgegrad[demo]")
    monkeypatch.setattr(demo, "SIZE", 64)
    monkeypatch.setattr(demo, "fit_pose", partial(demo.fit_pose, search=False))
    assert run("demo", "--runs", 1, "--out", tmp_path / "demo") == 0
    said = capsys.readouterr().out
    assert "1 of 1 within 0.5° and 0.5 %" in said
    assert sorted(p.name for p in (tmp_path / "demo").iterdir()) == ["fit.png", "loss.png", "pose.json"]


def test_demo_without_pyvista_says_how_to_get_it(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyvista.examples", None)
    assert run("demo", "--out", tmp_path) == 2
    assert "pip install 'edgegrad[demo]'" in capsys.readouterr().err


def test_version_as_a_program():
    done = subprocess.run([sys.executable, "-m", "edgegrad", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout == f"edgegrad {eg.__version__}\n"


@pytest.mark.parametrize("typed, meant", [
    (["rendr"], "render"),
    (["render", "mesh.ply", "--out", "a.png", "--sede", "3"], "--seed"),
    (["bop", "refin"], "refine"),
])  # fmt: skip
def test_did_you_mean(capsys, typed, meant):
    with pytest.raises(SystemExit):
        run(*typed)
    assert f"did you mean {meant}?" in capsys.readouterr().err


def test_help_comes_without_torch():
    code = "import sys\nfrom edgegrad import cli\ntry: cli.main(['render', '--help'])\nfinally: assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True).returncode == 0


def test_doctor(capsys, monkeypatch):
    assert run("doctor") == 0
    said = capsys.readouterr().out
    for word in ("torch", "Embree       4.", "threads", "right"):
        assert word in said
    assert doctor.gradient_error() < 0.01
    monkeypatch.setattr(doctor, "TOLERANCE", 0.05 * doctor.gradient_error())
    assert run("doctor") == 1 and "WRONG" in capsys.readouterr().out


def test_ctrl_c_while_modules_are_imported_is_not_lost():
    code = (
        "import os, signal, time\nfrom edgegrad import cli\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "with cli._ended_by_ctrl_c():\n"
        "    try:\n        os.kill(os.getpid(), signal.SIGINT)\n        time.sleep(1)\n"
        "    except BaseException:\n        pass\n"
        "print('went on')"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (cli.INTERRUPTED, "", "edgegrad: interrupted\n")
