"""The live view in a real browser without a window: Chromium, driven by selenium. `make test-browser` installs what it needs."""

from __future__ import annotations

import shutil
import threading
import time

import numpy as np
import pytest
import torch
from brackets import START, before_sky, bracket, camera, picture
from quiet_fits import arranged, quiet

import edgegrad as eg
from edgegrad.fit import Parameter, fit_pose, fit_scene

pytest.importorskip("viser", reason="the live view needs edgegrad[view]")
selenium = pytest.importorskip("selenium.webdriver", reason="no selenium; run `make test-browser`")
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
DRIVER = shutil.which("chromedriver")
# `make test-browser` runs them, and so does `make test-slow`.
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        BROWSER is None or DRIVER is None, reason="no chromium with its chromedriver; run `make test-browser`"
    ),
    pytest.mark.unsanitized,
]
# WebGL on the processor; --no-sandbox, for Chromium has none for root, and it opens only the test's own page.
FLAGS = ("headless=new", "no-sandbox", "use-gl=angle", "use-angle=swiftshader", "enable-unsafe-swiftshader",
         "disable-dev-shm-usage", "window-size=1200,760")  # fmt: skip
PATIENCE = 60.0  # seconds


@pytest.fixture(scope="module")
def browser():
    options = selenium.ChromeOptions()
    options.binary_location = BROWSER
    for flag in FLAGS:
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = selenium.Chrome(options=options, service=selenium.ChromeService(DRIVER))
    yield driver
    driver.quit()


def wait_for(condition, what):
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if found := condition():
            return found
        time.sleep(0.1)
    return pytest.fail(f"waited {PATIENCE:g} s for {what}")


def button(browser, label):
    def found():
        buttons = browser.find_elements("tag name", "button")
        return next((one for one in buttons if one.text.strip() == label), None)

    return wait_for(found, f"a button {label}")


def image(browser):
    """Return the address of the panel's picture, which changes with it; None before there is one."""
    return browser.execute_script(
        "const i = [...document.querySelectorAll('img')].find(i => i.naturalWidth > 2 * i.naturalHeight);"
        "return i ? i.src : null"
    )


def opened(browser, viewer):
    """Open the page and return it when it is connected to its server."""
    browser.get(viewer.url)
    return wait_for(lambda: list(viewer._display.server.get_clients().values()), "the page to connect")[0]


def test_the_page_pauses_goes_on_and_stops_a_running_fit(browser):
    at, steps, found = camera(48), [], []
    mesh = bracket().replace(face_colors=torch.full((20, 3), 0.4))

    with eg.viewer(port=0, share=0.2) as viewer:

        def callback(record):
            steps.append(record.step)
            viewer(record)

        def run():
            options = {"steps": 10**6, "loss_tolerance": 0.0, "spp": 4, "progress": False, "callback": callback}
            found.append(fit_scene(mesh, picture(at), at, {"face_colors": Parameter(0.002)}, **arranged(**options)))

        opened(browser, viewer)
        fit = threading.Thread(target=run)
        fit.start()
        try:
            assert browser.find_elements("css selector", "canvas[data-engine^='three.js']")
            logs = [entry["message"] for entry in browser.get_log("browser")]
            assert any("WebGL support: true" in line for line in logs), logs
            first = wait_for(lambda: image(browser), "a picture in the panel")
            wait_for(lambda: image(browser) != first, "the picture to change")
            wait_for(lambda: "loss" in browser.find_element("tag name", "body").text, "the loss")

            button(browser, "Pause").click()
            button(browser, "Resume")
            wait_for(lambda: "paused at step" in browser.find_element("tag name", "body").text, "the pause")
            at_pause = len(steps)
            time.sleep(1.0)
            assert len(steps) == at_pause and fit.is_alive()
            button(browser, "Resume").click()
            wait_for(lambda: len(steps) > at_pause + 5, "the fit to go on")

            button(browser, "Stop").click()
            fit.join(PATIENCE)
            assert not fit.is_alive() and found[0].interrupted and found[0].steps == len(steps)
        finally:
            viewer.stop()
            fit.join(PATIENCE)
    assert found[0].loss < found[0].history[0].loss


def test_the_page_shows_materials(browser):
    """A purple texture with a blue factor on a metal is seen as blue."""
    verts = torch.tensor([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    texels = torch.tensor([0.9, 0.0, 0.9]).expand(4, 4, 3)
    material = eg.Material(eg.Texture(texels, factor=torch.tensor([0.0, 1.0, 1.0])), metallic=0.5, roughness=0.5)
    square = eg.Mesh(verts, faces, uvs=verts[:, :2], uv_faces=faces, material=material)
    with eg.viewer(port=0) as viewer:
        viewer.update(square)
        client = opened(browser, viewer)
        place = {"wxyz": (0.0, 1.0, 0.0, 0.0), "position": (0.0, 0.0, 3.0), "fov": 0.3}

        def is_blue():
            red, green, blue = client.get_render(16, 16, **place, transport_format="png")[8, 8, :3].astype(int)
            return blue > 60 + max(red, green)

        wait_for(is_blue, "the colour of texture and factor")


def test_the_page_shows_the_meshes_where_the_camera_sees_them(browser):
    """three.js draws the same outline in the page as render() does with the same camera."""
    at = camera(96)
    fit = fit_pose(before_sky(), picture(at), at, init=START, options=quiet(steps=3, spp=4))
    moved = bracket().transformed(fit.R, fit.t, fit.scale)
    mask = eg.render_aovs(moved, at, ["alpha"], spp=16, seed=0)["alpha"][..., 0].numpy()
    with eg.viewer(port=0) as viewer:
        viewer.show(fit)
        frustum = viewer._display._frusta[0][1]
        client = opened(browser, viewer)
        place = {"wxyz": frustum.wxyz, "position": frustum.position, "fov": frustum.fov}
        frustum.visible = False

        def overlap():
            seen = client.get_render(96, 96, **place, transport_format="png")
            found = (np.abs(seen[..., :3].astype(int) - 255).max(-1) > 8) if seen.shape[-1] == 3 else seen[..., 3] > 127
            return np.sum(found & (mask > 0.5)) / max(1, np.sum(found | (mask > 0.5))) > 0.97

        wait_for(overlap, "the mesh in its place")
        # A turn by 5° is seen: the test can decide.
        other = moved.transformed(torch.linalg.matrix_exp(0.09 * torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]])))
        turned = eg.render_aovs(other, at, ["alpha"], spp=16, seed=0)["alpha"][..., 0].numpy() > 0.5
        assert np.sum(turned & (mask > 0.5)) / np.sum(turned | (mask > 0.5)) < 0.93
