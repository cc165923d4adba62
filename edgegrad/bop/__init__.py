"""BOP, the benchmark for 6D object pose estimation: data sets and result files, pose errors, and refined poses.

All is as BOP defines it: millimetres, poses from the mesh to the camera (+X right, +Y down, +Z forward), angles in degrees.

Hodaň et al., "BOP: Benchmark for 6D Object Pose Estimation", ECCV 2018; "BOP Challenge 2020 on 6D Object Localization", ECCVW
2020; https://bop.felk.cvut.cz
"""

import lazy_loader as _lazy

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
