"""Scripts that render in a process of their own, which must not hang."""

import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import psutil
import pytest

TESTS = Path(__file__).parents[1]
posix = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="signals and processes as in POSIX")

# What the scripts below share. `step(k)` tells the bits of an image and of its gradients; k moves the vertices.
COMMON = """
import hashlib, json, os, sys, threading, time
import torch
import edgegrad as eg
from scenes import front_camera, icosphere

SPHERE = icosphere(4)

def step(k=0, size=48):
    verts = (SPHERE.verts * (1.0 + 0.001 * k)).requires_grad_()
    colors = SPHERE.colors.clone().requires_grad_()
    image = eg.render(SPHERE.replace(verts=verts, colors=colors), front_camera(size), spp=4, seed=0)
    image.square().mean().backward()
    return hashlib.sha256(b"".join(t.detach().numpy().tobytes() for t in (image, verts.grad, colors.grad))).hexdigest()
"""


def script(code, *arguments, timeout=120, folder=None, silent=False):
    """The last line that the code prints, as JSON; it runs in a process of its own, which must not hang."""
    file = folder / "script.py"
    file.write_text(textwrap.dedent(COMMON) + textwrap.dedent(code))
    run = subprocess.run(
        [sys.executable, str(file), *map(str, arguments)],
        env={**psutil.Process().environ(), "PYTHONPATH": f"{TESTS}/support:{TESTS.parent}"},
        capture_output=True, text=True, timeout=timeout,
    )  # fmt: skip
    assert run.returncode == 0 and not (silent and run.stderr), run.stderr
    return json.loads(run.stdout.splitlines()[-1])
