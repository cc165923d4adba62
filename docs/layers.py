"""Draw the packages of edgegrad and what they import, from the imports themselves:  python docs/layers.py [FILE.svg]

Layers are counted from below: a package stands one layer above the highest that it imports. An arrow is left out where a chain
of others says the same.
"""

from __future__ import annotations

import sys
from graphlib import TopologicalSorter
from pathlib import Path

import grimp

FOLDER = Path(__file__).parent
# Names for users alone, which nothing inside imports.
LEFT_OUT = {"image", "lights", "notebook", "shapes", "textures", "__main__", "_core"}
INK, BLUE, GREY = "#222222", "#1f6fb2", "#b9bec6"


def imports() -> dict[str, set[str]]:
    """Return for each package or module in edgegrad those that it imports."""
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


def layers(imported: dict[str, set[str]]) -> list[list[str]]:
    """Return the layers from below. Raises graphlib.CycleError where packages import each other in a circle."""
    sorter = TopologicalSorter(imported)
    sorter.prepare()
    found: list[list[str]] = []
    while sorter.is_active():
        found.append(sorted(sorter.get_ready()))
        sorter.done(*found[-1])
    return found


def reduced(imported: dict[str, set[str]]) -> dict[str, set[str]]:
    """Return the imports that no chain of others implies."""

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
    matplotlib.rcParams["svg.hashsalt"] = "edgegrad"  # so that the same layers are the same file
    import matplotlib.pyplot as plt
    from matplotlib.patches import FancyBboxPatch

    imported = imports()
    every = layers(imported)
    figure, axis = plt.subplots(figsize=(9.0, 0.62 * len(every)), layout="constrained")
    place = {}
    for y, layer in enumerate(every):
        for x, name in enumerate(layer):
            place[name] = ((x + 1) / (len(layer) + 1) * 10.0, float(y))
    for name, needs in reduced(imported).items():
        for other in needs:
            (x0, y0), (x1, y1) = place[name], place[other]
            arrow = {"arrowstyle": "-|>", "color": GREY, "linewidth": 0.9, "shrinkA": 0, "shrinkB": 0}
            axis.annotate("", (x1, y1 + 0.27), (x0, y0 - 0.27), arrowprops=arrow, zorder=1)  # behind boxes
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
    axis.set_ylim(-0.5, len(every) - 0.5)
    axis.axis("off")
    figure.savefig(file, metadata={"Date": None, "Description": description(every)})


def description(every: list[list[str]]) -> str:
    """Return the text in the file by which a test sees whether it shows the imports of today."""
    return "Layers of edgegrad from below: " + "; ".join(", ".join(layer) for layer in every)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER / "layers.svg")
