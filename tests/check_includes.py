"""Check that the folders of the kernel include one another in one direction only.

python tests/check_includes.py [CSRC]    prints each include that goes up, and fails if there is one
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

# Each layer may include itself and the layers before it. Folders of one layer do not know one another.
LAYERS = (
    ("core",),
    ("scene", "texture"),
    ("camera",),
    ("rays",),
    ("film", "track"),
    ("accumulate",),
    ("shading",),
    ("estimator",),
    ("boundary",),
    ("forward", "interior", "primary", "discontinuities", "secondary"),
    ("backward",),
    ("checks",),
    ("python",),
)
# The operators on triangles in clip space stand next to the renderer.
STANDS_ON = {"raster": {"core", "texture"}}
INCLUDE = re.compile(r'^#include "([a-z_]+)/[^"]+"', re.MULTILINE)


def allowed() -> dict[str, set[str]]:
    """Return for each folder the other folders that it may include."""
    known: dict[str, set[str]] = {}
    below: set[str] = set()
    for layer in LAYERS:
        known.update({folder: set(below) for folder in layer})
        below |= set(layer)
    known["python"] |= STANDS_ON.keys()
    return known | STANDS_ON


def violations(root: Path) -> list[str]:
    """Return a line for each include of a folder that the file may not know, and for each folder without a layer."""
    may = allowed()
    found = []
    for path in sorted(p for p in root.rglob("*") if p.suffix in (".h", ".cpp")):
        folder = path.relative_to(root).parts[0]
        if folder not in may:
            found.append(f"{path}: the folder {folder} has no layer in {Path(__file__).name}")
            continue
        for match in INCLUDE.finditer(path.read_text()):
            other = match[1]
            if other != folder and other not in may[folder]:
                found.append(f"{path}: {folder} may not include {other}: {match[0]}")
    return found


if __name__ == "__main__":
    lines = violations(Path(sys.argv[1] if len(sys.argv) > 1 else "csrc"))
    print("\n".join(lines) or "The folders of the kernel include one another in one direction.")
    sys.exit(bool(lines))
