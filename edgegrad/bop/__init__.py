"""BOP, the benchmark for 6D object pose estimation: data sets and result files, pose errors, and refined poses.

All is as BOP defines it: millimetres, poses from the mesh to the camera (+X right, +Y down, +Z forward), angles in degrees.

Hodaň et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; "BOP Challenge 2020 on 6D Object Localization", ECCVW
2020; https://bop.felk.cvut.cz
"""

from .dataset import Dataset, Target
from .depth import depth_image
from .errors import add, adi, mspd, mssd, vsd
from .evaluate import Evaluation, PairErrors, Recalls, Row, evaluate
from .frame import Frame, Truth
from .model import Model
from .refine import Refined, refine
from .results import Estimate, read_results, write_results
from .write import Shot, write_models, write_scene

__all__ = [
    "Dataset", "Estimate", "Evaluation", "Frame", "Model", "PairErrors", "Recalls", "Refined", "Row", "Shot", "Target", "Truth",
    "add", "adi", "depth_image", "evaluate", "mspd", "mssd", "read_results", "refine", "vsd", "write_models", "write_results",
    "write_scene",
]  # fmt: skip
