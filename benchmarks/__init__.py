"""What measures edgegrad, run from a checkout by `python -m benchmarks.NAME`: README.md lists it.

Scenes and oracles of tests/ and objects of examples/ are measured, too, so their folders are on the path.
"""

import sys
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / folder) for folder in ("tests", "tests/support", "tests/fit", "examples")]
