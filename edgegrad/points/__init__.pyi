from .check_shader import check_shader
from .hits import Hits
from .rays import trace
from .samples import attach_boundary, edge_samples, primary_hits, surface_samples

__all__ = ["Hits", "attach_boundary", "check_shader", "edge_samples", "primary_hits", "surface_samples", "trace"]
