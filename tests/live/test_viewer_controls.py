"""How the live view pauses and stops a fit, how little time it takes, and how the command line opens it."""

import json
import signal
import socket
import sys
import threading
import time
from functools import partial

import numpy as np
import pytest
import torch
from bracket_files import write_bracket
from brackets import bracket
from live_fixtures import colour_fit, page

import edgegrad as eg
from edgegrad import cli
from edgegrad.fit import fit_pose
from edgegrad.live import snapshot, view
from edgegrad.live.browser import Browser

pytestmark = [pytest.mark.quick, pytest.mark.unsanitized]
pytest_plugins = "live_fixtures"
pytest.importorskip("viser", reason="the live view needs edgegrad[view]")


def test_a_pause_holds_the_fit_and_stop_ends_it_with_its_best(viewer):
    steps, reached = [], threading.Event()

    def callback(record):
        steps.append(record.step)
        if record.step == 3:
            viewer.pause()
            reached.set()
        viewer(record)

    found = []
    thread = threading.Thread(
        target=lambda: found.append(colour_fit(steps=10**6, loss_tolerance=0.0, callback=callback))
    )
    thread.start()
    assert reached.wait(20)
    time.sleep(0.5)
    assert steps == [0, 1, 2, 3] and viewer.paused
    for _ in range(100):
        if page(viewer).status.content.startswith("**paused** at step 4"):
            break
        time.sleep(0.05)
    else:
        pytest.fail("the page does not say that it is paused")
    assert page(viewer).pause.label == "Resume"
    viewer.resume()
    while len(steps) < 8:
        time.sleep(0.01)
    viewer.pause()
    viewer.stop()  # also of a fit that is paused
    thread.join(20)
    assert not thread.is_alive() and found[0].interrupted and found[0].steps == len(steps)
    assert not viewer.stopped and not viewer.paused  # ready for the next fit
    assert colour_fit(steps=2, callback=viewer).steps == 2


def test_stop_ends_a_loop_of_ones_own(viewer):
    assert viewer.update(bracket())
    viewer.stop()
    assert not viewer.update(bracket()) and viewer.stopped


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_ctrl_c_ends_a_pause(viewer):
    viewer.pause()
    threading.Timer(0.5, signal.raise_signal, [signal.SIGINT]).start()
    fit = colour_fit(steps=10**6, callback=viewer)
    assert fit.interrupted and fit.steps == 1


def test_drawing_takes_no_more_than_its_share_of_the_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(view.time, "perf_counter", lambda: now[0])
    drawn = []
    with eg.viewer(port=0, share=0.05) as viewer:

        def draw(*_):
            drawn.append(now[0])
            now[0] += 0.04

        monkeypatch.setattr(viewer._display, "draw", draw)
        while now[0] < 20.0:
            now[0] += 0.01
            viewer.update(bracket())
    assert drawn[1] - drawn[0] < 0.2  # the first one may take long
    gaps = np.diff(drawn[1:])
    assert 0.04 / gaps.max() > 0.04 and 0.04 / gaps.min() < 0.0501


def test_scenes_are_made_only_where_they_are_drawn(viewer, monkeypatch):
    monkeypatch.setattr(view, "MIN_INTERVAL", 1e9)
    made = []
    monkeypatch.setattr(
        snapshot, "snapshot_from_scene", lambda *a, of=snapshot.snapshot_from_scene: made.append(1) or of(*a)
    )
    for _ in range(5):
        viewer.update(bracket())
    assert len(made) == 1 and viewer._steps == 5


def test_another_port_where_one_is_taken_and_only_this_computer():
    with eg.viewer(port=0) as one:
        port = int(one.url.rsplit(":", 1)[1])
        with eg.viewer(port) as two:
            assert two.url != one.url
        assert page(one).server.get_host() == "127.0.0.1"
        assert f'<iframe src="{one.url}"' in one._repr_html_()
    assert "iframe" not in one._repr_html_() and "closed" in repr(one)
    with socket.socket() as free:
        free.bind(("127.0.0.1", port))  # given back
    assert one.update(bracket())  # a fit goes on without it


def test_a_figure_where_there_is_no_server(monkeypatch):
    ipython = pytest.importorskip("IPython.display")
    shown = []

    class Handle:
        def update(self, image):
            shown.append(image.data)

    monkeypatch.setattr(view, "in_notebook", lambda: True)
    monkeypatch.setattr(ipython, "display", lambda image, display_id: shown.append(image.data) or Handle())
    monkeypatch.setattr(view.importlib.util, "find_spec", lambda name: None)
    with eg.viewer() as made:
        assert made.url is None and made._repr_html_() is None
        made._next = 0.0
        fit = colour_fit(steps=3, callback=made)
        made.show(fit)
        made.wait()  # for nobody
    titles = [ax.get_title() for ax in made._display.figure.axes]
    assert titles == ["target", "render", "difference × 4", "loss"]
    assert len(shown) >= 2 and shown[0] != shown[-1] and all(data.startswith(b"\x89PNG") for data in shown)


def test_errors_name_the_argument(viewer):
    for options, error, text in [
        ({"port": -1}, ValueError, "port: expected"), ({"port": "x"}, TypeError, "port: expected"),
        ({"host": 3}, TypeError, "host: expected a str"), ({"server": 1}, TypeError, "server: expected True"),
        ({"server": False}, ValueError, "server: expected True outside of a notebook"),
        ({"share": 0.0}, ValueError, "share: expected"), ({"share": 1.5}, ValueError, "share: expected"),
    ]:  # fmt: skip
        with pytest.raises(error, match=text):
            eg.viewer(**{"port": 0, **options})
    with pytest.raises(TypeError, match="fit: expected what a fit gives its callback"):
        viewer.show(3)
    with pytest.raises(TypeError, match="scene: expected a Scene or a Mesh, got int"):
        viewer.update(3)
    with pytest.raises(ValueError, match="cameras: expected with images and masks, got None"):
        viewer.update(bracket(), None, torch.zeros(4, 4, 3))


def test_without_viser_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"live view needs edgegrad\[view\]; install it with: pip install 'edgegrad"):
        eg.viewer()


def test_the_command_line_opens_it_and_saves_before_it_waits(tmp_path, monkeypatch, capsys):
    write_bracket(tmp_path, 48)
    out, waited = tmp_path / "out", []

    def wait(viewer):
        saved = json.loads((out / "pose.json").read_text())["mesh_to_world"]
        shown = viewer._snapshot.matrix
        waited.append(np.allclose(saved, shown) and (out / "fit.png").exists())

    monkeypatch.setattr(view.Viewer, "wait", wait)
    monkeypatch.setattr("edgegrad.fit.fit_pose", partial(fit_pose, search=False))
    arguments = ["fit-pose", "mesh.ply", "target.png", "--camera", "camera.json", "--steps", "3", "--size", "32"]
    monkeypatch.chdir(tmp_path)
    assert cli.main([*arguments, "--out", "out", "--view", "--port", "0"]) == 0
    assert waited == [True]
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("live view: http://localhost:")
    assert lines[-1] == lines[0] + " until Ctrl-C or Close" and "viser" not in "".join(lines)

    # Stop in the page is Ctrl-C in the shell.
    draw = Browser.draw
    monkeypatch.setattr(Browser, "draw", lambda self, *given: (draw(self, *given), press(self.stop)))
    assert cli.main([*arguments, "--out", "out", "--view", "--port", "0"]) == cli.INTERRUPTED
    assert len(waited) == 1 and "interrupted" in capsys.readouterr().out

    monkeypatch.setitem(sys.modules, "viser", None)
    assert cli.main([*arguments, "--out", "out", "--view"]) == 2
    assert "needs edgegrad[view]" in capsys.readouterr().err


def press(button):
    """Call a button's callback, as the server does for a click in the page."""
    for callback in button._impl.update_cb:
        callback(None)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
def test_the_page_stays_until_close_or_ctrl_c(viewer):
    viewer.update(bracket())
    threading.Timer(0.3, signal.raise_signal, [signal.SIGINT]).start()
    viewer.wait()
    assert page(viewer).stop.label == "Close"
    threading.Timer(0.3, press, [page(viewer).stop]).start()
    viewer.wait()
