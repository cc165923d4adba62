"""Draws the packages of edgegrad and what they import, from the imports themselves:  python docs/house.py [FILE.svg]

Floors are counted from below: a package stands one floor above the highest that it imports. An arrow is left out where a chain
of others says the same.
"""

from __future__ import annotations

import sys
from pathlib import Path

import grimp

FOLDER = Path(__file__).parent
LEFT_OUT = {
    "image",
    "io",
    "lights",
    "notebook",
    "__main__",
    "_core",
}  # names for users alone, which nothing inside imports
INK, BLUE, GREY = "#222222", "#1f6fb2", "#b9bec6"


def imports() -> dict[str, set[str]]:
    """Of each package or module in edgegrad, those that it imports."""
    graph = grimp.build_graph("edgegrad", cache_dir=None)
    left_out = {f"edgegrad.{name}" for name in LEFT_OUT}
    children = sorted(graph.find_children("edgegrad") - left_out)
    return {
        name.removeprefix("edgegrad."): {
            other.removeprefix("edgegrad.")
            for other in children
            if other != name and graph.direct_import_exists(importer=name, imported=other, as_packages=True)
        }
        for name in children
    }


def floors(imported: dict[str, set[str]]) -> list[list[str]]:
    """From below. Raises ValueError where packages import each other in a circle."""
    done: list[list[str]] = []
    left = dict(imported)
    while left:
        below = {name for floor in done for name in floor}
        floor = sorted(name for name, needs in left.items() if needs <= below)
        if not floor:
            raise ValueError(f"imports: expected an order, got a circle among {', '.join(sorted(left))}")
        done.append(floor)
        left = {name: needs for name, needs in left.items() if name not in floor}
    return done


def reduced(imported: dict[str, set[str]]) -> dict[str, set[str]]:
    """Without imports that a chain of others implies."""

    def reached(name: str) -> set[str]:
        return imported[name].union(*(reached(other) for other in imported[name])) if imported[name] else set()

    every = {name: reached(name) for name in imported}
    return {
        name: {other for other in needs if not any(other in every[between] for between in needs)}
        for name, needs in imported.items()
    }


def draw(file: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams["svg.hashsalt"] = "edgegrad"  # so that the same house is the same file
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyBboxPatch

    imported = imports()
    storeys = floors(imported)
    figure, axis = plt.subplots(figsize=(9.0, 0.62 * len(storeys)), layout="constrained")
    place = {}
    for y, floor in enumerate(storeys):
        for x, name in enumerate(floor):
            place[name] = ((x + 1) / (len(floor) + 1) * 10.0, float(y))
    for name, needs in reduced(imported).items():
        for other in needs:
            (x0, y0), (x1, y1) = place[name], place[other]
            arrow = {"arrowstyle": "-|>", "color": GREY, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", (x1, y1 + 0.27), (x0, y0 - 0.27), arrowprops=arrow)
    for name, (x, y) in place.items():
        package = (FOLDER.parent / "edgegrad" / name).is_dir()
        width = 0.14 * len(name) + 0.35
        box = FancyBboxPatch(
            (x - width / 2, y - 0.24), width, 0.48, boxstyle="round,pad=0.02,rounding_size=0.1", linewidth=1.0,
            facecolor="#e8f1fa" if package else "white", edgecolor=BLUE if package else GREY, zorder=2,
        )  # fmt: skip
        axis.add_patch(box)
        axis.text(x, y, name, ha="center", va="center", fontsize=9, color=INK, zorder=3)
    axis.set_xlim(0.0, 10.0)
    axis.set_ylim(-0.5, len(storeys) - 0.5)
    axis.axis("off")
    figure.savefig(file, metadata={"Date": None, "Description": description(storeys)})


def description(storeys: list[list[str]]) -> str:
    """What the file says of itself, so that a test sees whether it is that of the imports."""
    return "Floors of edgegrad from below: " + "; ".join(", ".join(floor) for floor in storeys)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER / "house.svg")
