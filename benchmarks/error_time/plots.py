"""The figure and the table of error-time, from its document."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from edgegrad.files.paths import replacing

from ..document import FAINT, INK, Document, duration, machine_in_words, percent, style
from ..scenes import SCENES
from .methods import FORWARD_SPP, METRICS
from .references import disagrees

# Colours of Okabe and Ito, which the colour-blind show apart. (label, colour, width of the line, marker)
STYLES = {
    "edgegrad": ("edgegrad", "#0072B2", 2.0, "o"),
    "interior": ("interior only", "#56B4E9", 1.1, "^"),
    "boundary": ("boundary only", "#009E73", 1.1, "v"),
    "finite-differences": ("finite differences", "#6e6e6e", 1.3, "s"),
    "finite-differences-vertices": ("finite differences", "#6e6e6e", 1.3, "s"),
    "direct_projective": ("direct_projective", "#D55E00", 1.5, "D"),
    "direct_projective-guided": ("direct_projective, guided", "#D55E00", 1.0, "P"),
    "prb_projective": ("prb_projective", "#CC79A7", 1.5, "D"),
    "prb_projective-guided": ("prb_projective, guided", "#CC79A7", 1.0, "P"),
}
TITLES = {"vertex": "vertices", "translation": "translation", "rotation": "rotation"}
GAP = 0.062  # of a panel's height, between labels
ROUNDING = 1e-9  # a part of the gradient that is zero comes out with an error of rounding, which is no point of a curve


def draw(path: Path, document: Document) -> None:
    """Writes one row of panels a scene and one panel a metric: error against seconds, both logarithmic.

    Raises OSError when the file cannot be written.
    """
    names = _scenes(document)
    height = 0.75 + 2.85 * len(names)
    figure = Figure(figsize=(13.2, height), dpi=150)
    grid = figure.subplots(len(names), len(METRICS), squeeze=False, sharex="row", sharey="row")
    figure.subplots_adjust(
        left=0.07, right=0.895, top=1.0 - 1.1 / height, bottom=0.52 / height, wspace=0.6, hspace=0.46
    )
    for row, name in zip(grid, names, strict=True):
        entry = document["scenes"][name]
        for axes, metric in zip(row, METRICS, strict=True):
            _panel(axes, document, name, metric)
        row[0].set_ylabel("relative error", color=INK, fontsize=8.5)
        row[0].annotate(
            entry["title"][0].upper() + entry["title"][1:], (0.0, 1.0), (0, 22), xycoords="axes fraction",
            textcoords="offset points", fontsize=10, color=INK, weight="bold",
        )  # fmt: skip
        for axes, metric in zip(row, METRICS, strict=True):
            axes.annotate(
                TITLES[metric], (0.0, 1.0), (0, 7), xycoords="axes fraction", textcoords="offset points",
                fontsize=9, color=INK,
            )  # fmt: skip
        _limits(row[0], document, name)
        for axes in row:
            _label(axes)
    for axes in grid[-1]:
        axes.set_xlabel("time of one gradient", color=INK, fontsize=8.5)
    now = document["settings"]
    figure.text(0.07, 1.0 - 0.3 / height, "Error of the gradient against the time it takes", fontsize=13, color=INK)
    figure.text(
        0.07, 1.0 - 0.5 / height,
        f"{now['size']}² pixels, {now['threads']} threads of {now['processor']}. Points: root mean square of "
        f"{len(now['seeds'])} seeds; bars: smallest and largest. Dotted: the reference's own error.",
        fontsize=8.5, color=FAINT,
    )  # fmt: skip
    with replacing(path) as temporary:
        figure.savefig(temporary)


def _scenes(document: Document) -> list[str]:
    return [name for name in SCENES if any(point["scene"] == name for point in document["points"])]


def _panel(axes: Axes, document: Document, scene: str, metric: str) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    style(axes)
    axes.tick_params(labelleft=True)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda seconds, _: duration(seconds)))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda error, _: percent(error)))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(10.0, numticks=9))
        axis.set_minor_formatter(NullFormatter())
    for method, (label, color, width, marker) in STYLES.items():
        points = curve(document, scene, method, metric)
        if not points:
            continue
        x, y = [point["seconds"] for point, _ in points], [entry["error"] for _, entry in points]
        low = [error - min(entry["errors"]) for error, (_, entry) in zip(y, points, strict=True)]
        high = [max(entry["errors"]) - error for error, (_, entry) in zip(y, points, strict=True)]
        axes.errorbar(
            x, y, [low, high], fmt="-", color=color, linewidth=width, marker=marker, markersize=3.2 + width / 2,
            elinewidth=0.8, capsize=0, label=label, zorder=3 + width,
        )  # fmt: skip
    reference = document["scenes"][scene]["reference"]
    own = reference["error"].get("whole", {}).get(metric)
    if own is not None and own > 0:
        axes.axhline(own, color=FAINT, linewidth=1.0, linestyle=":", zorder=1)
    check = reference["check"].get(metric)
    if check is not None and disagrees(check):
        axes.annotate(
            f"reference in doubt: {percent(check['difference'])} off finite differences", (0.0, 0.0), (4, 4),
            xycoords="axes fraction", textcoords="offset points", fontsize=7.5, color="#B00020",
        )  # fmt: skip
    if not axes.lines:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", fontsize=8, color=FAINT)


def _limits(axes: Axes, document: Document, scene: str) -> None:
    """Set limits that show all points, bars and dotted lines of a row."""
    points = [pair for metric in METRICS for method in STYLES for pair in curve(document, scene, method, metric)]
    if not points:
        return
    times = [point["seconds"] for point, _ in points]
    errors = [error for _, entry in points for error in entry["errors"]]
    own = document["scenes"][scene]["reference"]["error"].get("whole", {}).values()
    errors += [error for error in own if error > 0]
    axes.set_xlim(min(times) / 1.4, max(times) * 1.4)
    axes.set_ylim(min(errors) / 1.6, max(errors) * 1.6)


def _label(axes: Axes) -> None:
    """Write the names of curves at their right ends, moved apart where they would overlap."""
    handles, labels = axes.get_legend_handles_labels()
    if not handles:
        return
    low, high = (math.log10(limit) for limit in axes.get_ylim())
    ends = []
    for handle, label in zip(handles, labels, strict=True):
        line = handle.lines[0]  # pyright: ignore[reportAttributeAccessIssue]  of an errorbar
        ends.append([(math.log10(line.get_ydata()[-1]) - low) / (high - low), label, line.get_color()])
    ends.sort(key=lambda end: end[0])
    for k, end in enumerate(ends):
        if k:
            end[0] = max(end[0], ends[k - 1][0] + GAP)
    over = max(0.0, ends[-1][0] - 0.98)
    for height, label, color in ends:
        axes.annotate(
            label, (1.0, height - over), (5, 0), xycoords="axes fraction", textcoords="offset points", color=color,
            fontsize=7.5, va="center", annotation_clip=False,
        )  # fmt: skip


def curve(document: Document, scene: str, method: str, metric: str) -> list[tuple[dict[str, Any], dict[str, Any]]]:
    """Return points of a method and their errors, by budget, without those that logarithms cannot show."""
    points = [p for p in document["points"] if (p["scene"], p["method"]) == (scene, method) and metric in p["metrics"]]
    points.sort(key=lambda point: point["budget"])
    pairs = [(point, point["metrics"][metric]) for point in points]
    return [(point, entry) for point, entry in pairs if min(entry["error"], *entry["errors"]) > ROUNDING]


# -- the table --------------------------------------------------------------------------------------------------------


def write_table(path: Path, document: Document) -> None:
    """Writes the same numbers in Markdown. Raises OSError when the file cannot be written."""
    now = document["settings"]
    text = f"""# Error of the gradient against the time it takes

Relative error ‖g − g*‖ / ‖g*‖, root mean square over {len(now["seeds"])} seeds, of the gradient of image · adjoint for the
vertices and for translation and rotation of the whole object; {now["size"]}² pixels. Times are medians: for edgegrad and
Mitsuba of a whole step (update after the vertices moved, image at {FORWARD_SPP} samples a pixel, backward pass), without
compilation, which is given apart; for interior and boundary of the backward pass alone, and their errors are relative to
the whole gradient; for finite differences of 12 images (6 a vertex).

{machine_in_words(now)}.
"""
    for name in _scenes(document):
        text += _section(document, name)
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _section(document: Document, name: str) -> str:
    entry = document["scenes"][name]
    reference = entry["reference"]
    lines = [f"\n## {name}: {entry['title']}\n", f"Reference: {reference['kind']}."]
    if reference["error"]:
        own = ", ".join(f"{metric} {percent(error)}" for metric, error in reference["error"]["whole"].items())
        lines.append(f"Its own standard error: {own}.")
    for metric, check in reference["check"].items():
        lines.append(
            f"Finite differences of {metric}: {percent(check['difference'])} apart, "
            f"± {percent(check['standard_error'])} by chance{': **they disagree**' if disagrees(check) else ''}."
        )
    lines += [f"{method}: left out; {why}." for method, why in entry["left_out"].items()]
    lines += ["", "| method | samples | vertices | translation | rotation | time | once |", "|---" * 7 + "|"]
    points = [point for point in document["points"] if point["scene"] == name]
    order = list(STYLES)
    for point in sorted(points, key=lambda point: (order.index(point["method"]), point["budget"])):
        errors = [point["metrics"].get(metric) for metric in METRICS]
        cells = ["–" if error is None else percent(error["error"]) for error in errors]
        once = duration(point["compile_seconds"]) if point["compile_seconds"] else ""
        cells = [STYLES[point["method"]][0], point["label"], *cells, duration(point["seconds"]), once]
        lines.append(f"| {' | '.join(cells)} |")
    if entry["terms"]:
        lines += ["", "| cost of each term | time |", "|---|---|"]
        lines += [f"| {term} | {duration(seconds)} |" for term, seconds in entry["terms"].items()]
    return "\n".join(lines) + "\n"
