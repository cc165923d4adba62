"""Draws viewer.png, the page of a live view in Chromium:  python docs/viewer.py [FOLDER]

Needs edgegrad[view,demo], selenium, pillow, and Chromium with its chromedriver.
"""

from __future__ import annotations

import io
import math
import shutil
import sys
import time
from pathlib import Path

import torch
from PIL import Image
from selenium import webdriver

import edgegrad as eg
from edgegrad.demo import airliner
from edgegrad.fit import FitOptions, fit_pose
from edgegrad.fit.pose.result import PoseFit

FLAGS = ("headless=new", "no-sandbox", "use-gl=angle", "use-angle=swiftshader", "enable-unsafe-swiftshader",
         "window-size=1240,780")  # fmt: skip
BACKGROUND = torch.tensor([0.55, 0.7, 0.85])
AT_STEP = 6
COLORS = 128  # of the file


def main() -> None:
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parent)
    mesh = airliner()
    low, high = mesh.verts.aminmax(dim=0)
    center, size = (low + high) / 2, float((high - low).norm())
    eyes = [(0.75 * math.sin(a), 0.7 * math.cos(a), 0.95) for a in (2.3, 3.5, 4.7)]
    up = torch.tensor([0.0, 0.0, 1.0])
    cameras = [
        eg.Camera.look_at(center + size * torch.tensor(eye), center, up, 50.0, (256, 256)).to(torch.float64)
        for eye in eyes
    ]
    pictures = [eg.render(eg.Scene(mesh, BACKGROUND), camera, spp=64) for camera in cameras]
    turn = torch.eye(4, dtype=torch.float64)
    turn[:3, :3] = torch.linalg.matrix_exp(0.35 * torch.tensor([[0.0, -1, 0.3], [1, 0, 0.5], [-0.3, -0.5, 0]]).double())
    turn[:3, 3] = center - turn[:3, :3] @ center

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium") or ""
    for flag in FLAGS:
        options.add_argument(f"--{flag}")
    browser = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    with eg.viewer(port=0, share=1.0) as view:
        browser.get(view.url)

        def callback(fit: PoseFit) -> None:
            view(fit)
            if len(fit.history) == AT_STEP:
                time.sleep(5.0)  # for the page, which draws on the processor
                browser.execute_script(
                    "document.querySelectorAll('.mantine-Notification-root').forEach(n => n.remove())"
                )
                shot = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
                shot.quantize(COLORS).save(folder / "viewer.png", optimize=True)
                raise KeyboardInterrupt

        options = FitOptions(seed=0, callback=callback, progress=False)
        fit_pose(eg.Scene([mesh], BACKGROUND), pictures, cameras, init=turn, options=options)
    browser.quit()


if __name__ == "__main__":
    main()
