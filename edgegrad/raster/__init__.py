"""Triangles in clip space as images, in four steps: rasterize, interpolate, texture, antialias.

The functions and conventions are those of nvdiffrast (Laine et al., "Modular Primitives for High-Performance Differentiable
Rendering", ACM Transactions on Graphics 39(6), 2020; https://nvlabs.github.io/nvdiffrast), written from its documentation:
scripts run with `import edgegrad.raster as dr`. Row 0 of images and textures is at the bottom. Tensors are float32 or float64,
on any device; the work is done on the CPU, with the same bits at any number of threads.
"""

from .antialias import antialias, antialias_construct_topology_hash
from .interpolate import interpolate
from .rasterize import (
    DepthPeeler,
    RasterizeCudaContext,
    RasterizeGLContext,
    get_log_level,
    rasterize,
    set_log_level,
)
from .texture import texture, texture_construct_mip

__all__ = [
    "DepthPeeler", "RasterizeCudaContext", "RasterizeGLContext", "antialias", "antialias_construct_topology_hash",
    "get_log_level", "interpolate", "rasterize", "set_log_level", "texture", "texture_construct_mip",
]  # fmt: skip
