"""One triangle, whose corners are red, green and blue: rasterized and interpolated.

python examples/raster_triangle.py [--size 256] [--out triangle.png]
"""

from __future__ import annotations

import argparse

import torch
from torch import Tensor

import edgegrad as eg
import edgegrad.raster as dr


def picture(size: int = 256) -> Tensor:
    """Return (H, W, 3), row 0 at the bottom."""
    pos = torch.tensor([[[-0.8, -0.8, 0, 1], [0.8, -0.8, 0, 1], [0, 0.8, 0, 1]]])
    tri = torch.tensor([[0, 1, 2]], dtype=torch.int32)
    rast, _ = dr.rasterize(dr.RasterizeCudaContext(), pos, tri, (size, size))
    image, _ = dr.interpolate(torch.eye(3)[None], rast, tri)
    return image[0]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--out", default="triangle.png")
    options = parser.parse_args()
    eg.write_image(options.out, picture(options.size).flip(0))
    print(f"wrote {options.out}")
