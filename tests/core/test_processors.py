"""Rays in packets of 8, which older processors run, give the image and gradient of packets of 16."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch
from scenes import cube, front_camera, icosphere
from torch import Tensor

import edgegrad as eg
from edgegrad.library import core


@cache
def results() -> dict[str, Tensor]:
    """Images and gradients of some scenes, with samples that fill packets and that do not."""
    views = {
        "perspective": front_camera(16),
        "far": eg.Camera.look_at((0.0, 20.0, -300.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.6, (16, 16)),
        "orthographic": eg.Camera.orthographic((0.0, 0.4, -3.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0), 2.4, (16, 16)),
    }
    found = {}
    for name, camera in views.items():
        for spp in (3, 16, 67):
            verts = [mesh.verts.clone().requires_grad_() for mesh in (icosphere(2), cube(0.6))]
            ball, box = (mesh.replace(verts=v) for mesh, v in zip((icosphere(2), cube(0.6)), verts, strict=True))
            scene = eg.Scene([ball, box.transformed(t=torch.tensor([0.3, 0.2, -0.9], dtype=torch.float64))])
            image = eg.render(scene, camera, spp=spp, seed=spp)
            image.square().sum().backward()
            found[f"{name} {spp}"] = image.detach()
            found |= {f"{name} {spp} verts {k}": v.grad for k, v in enumerate(verts)}
    return found


@pytest.mark.parametrize("options", [pytest.param("max_isa=avx2", marks=pytest.mark.slow), "max_isa=sse4.2"])
def test_narrow_packets(options: str, tmp_path: Path) -> None:
    file = tmp_path / "results.pt"
    environment = {**os.environ, "EDGEGRAD_EMBREE": options, "PYTHONPATH": os.pathsep.join(sys.path)}
    program = (
        "import sys, torch, test_processors as t\n"
        "assert t.core.packet_width() == 8\n"
        "torch.save(t.results(), sys.argv[1])"
    )
    subprocess.run([sys.executable, "-c", program, file], env=environment, check=True)
    there = torch.load(file, weights_only=True)
    assert core.packet_width() in (8, 16)
    for name, here in results().items():
        # The same rays hit the same faces, and all else is done in double by the same code.
        torch.testing.assert_close(there[name], here, rtol=1e-12, atol=1e-12 * float(here.abs().max()), msg=name)
