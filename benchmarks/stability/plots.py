"""The figures and the tables of stability, from its document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from edgegrad.files.paths import replacing

from ..document import FAINT, INK, Document, machine_in_words, percent, style
from . import NAME
from .cases.measure import LIMIT, NOISE, NOISY, RAISED, RIGHT, TOLERANCE, WRONG, worst_part

COLORS = {RIGHT: "#0072B2", LIMIT: "#E69F00", WRONG: "#D55E00", NOISY: "#CC79A7", RAISED: "#6e6e6e"}
FLOOR = 1e-5  # smaller errors are drawn there
FITS = ("#6e6e6e", "#D55E00", "#0072B2")
STEPS = {"disc": "#0072B2", "stripes": "#D55E00", "texels": "#009E73"}  # what is painted; the second of each is dashed


def publish(out: Path, document: Document) -> None:
    """Writes stability.md, and stability.png, stability-steps.png and stability-fits.png if there is what they show. Raises
    OSError."""
    with replacing(out / f"{NAME}.md") as temporary:
        temporary.write_text(table(document), encoding="utf-8")
    rows = [row for row in document["cases"] if "parts" in row]
    if rows:
        with replacing(out / f"{NAME}.png") as temporary:
            errors(rows).savefig(temporary, bbox_inches="tight", pad_inches=0.15)
    if document["sections"].get("steps"):
        with replacing(out / f"{NAME}-steps.png") as temporary:
            spacings(document["sections"]["steps"]).savefig(temporary)
    if document["sections"].get("fits"):
        with replacing(out / f"{NAME}-fits.png") as temporary:
            losses(document["sections"]["fits"]).savefig(temporary)


# -- figures ----------------------------------------------------------------------------------------------------------


def errors(rows: list[dict[str, Any]]) -> Figure:
    """The gradient's error of every case, with bars of one standard error, by group and in two columns."""
    groups: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault(row["group"], []).append(row)
    columns: list[list[str]] = [[], []]
    lengths = [0, 0]
    for name, members in groups.items():  # in order, the first column first
        k = 0 if lengths[0] + len(members) / 2 <= len(rows) / 2 else 1
        columns[k].append(name)
        lengths[k] += len(members) + 2
    columns = [names for names in columns if names]
    height = 1.3 + 0.185 * max(lengths)
    figure = Figure(figsize=(6.6 * len(columns), height), dpi=150)
    figure.subplots_adjust(
        left=0.34 / len(columns), right=0.985, top=1.0 - 0.72 / height, bottom=0.55 / height, wspace=0.52
    )
    for axes, names in zip(figure.subplots(1, len(columns), squeeze=False)[0], columns, strict=True):
        _column(axes, {name: groups[name] for name in names}, max(lengths))
    figure.text(0.012, 1.0 - 0.28 / height, "Error of the gradient in extreme cases", fontsize=13, color=INK)
    figure.text(
        0.012, 1.0 - 0.48 / height,
        "Of the part that is farthest off, relative to its own size, against an independent reference. Bars: one standard "
        f"error. Line: {percent(TOLERANCE)}. Errors below {percent(FLOOR)} are drawn there.", fontsize=8.5, color=FAINT,
    )  # fmt: skip
    shown = [verdict for verdict in COLORS if any(row["verdict"] == verdict for row in rows)]
    handles = [Line2D([], [], color=COLORS[v], marker="o", linestyle="", markersize=5, label=v) for v in shown]
    figure.legend(handles=handles, loc="upper right", ncols=len(handles), frameon=False, fontsize=8.5)
    return figure


def _column(axes: Axes, groups: dict[str, list[dict[str, Any]]], length: int) -> None:
    axes.set_xscale("log")
    axes.set_xlim(0.7 * FLOOR, 10.0)
    axes.set_ylim(length - 0.5, -0.8)
    style(axes)
    axes.grid(False, axis="y")
    axes.spines["left"].set_visible(False)
    axes.axvline(TOLERANCE, color=FAINT, linewidth=1.0)
    axes.xaxis.set_major_locator(LogLocator(10.0, numticks=9))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda error, _: percent(error)))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.tick_params(length=0)
    axes.set_xlabel("relative error of the gradient", color=INK, fontsize=8.5)
    ticks, labels, y = [], [], 0
    for group, rows in groups.items():
        axes.annotate(
            group[0].upper() + group[1:], (0.0, y), (-4, 0), xycoords=("axes fraction", "data"),
            textcoords="offset points", ha="right", va="center", fontsize=9, weight="bold", color=INK,
        )  # fmt: skip
        for row in rows:
            y += 1
            ticks.append(y)
            labels.append(row["name"])
            _, part = worst_part(row)
            error, noise, color = part["error"], part["noise"], COLORS[row["verdict"]]
            low, high = (min(max(x, FLOOR), 9.0) for x in (error - noise, error + noise))
            axes.plot([low, high], [y, y], color=color, linewidth=1.4, solid_capstyle="butt")
            axes.plot([min(max(error, FLOOR), 9.0)], [y], marker="o", markersize=4.2, color=color)
        y += 2
    axes.set_yticks(ticks, labels)


def spacings(found: dict[str, Any]) -> Figure:
    """The error of one image's derivative against the spacing of lines, each case named at the end of its curve."""
    figure = Figure(figsize=(8.4, 4.2), dpi=150)
    figure.subplots_adjust(left=0.1, right=0.76, top=0.83, bottom=0.13)
    axes = figure.subplots()
    x = [row["spacing"] for row in found["rows"]]
    for name in found["rows"][0]["cases"]:
        y = [max(row["cases"][name]["error"], FLOOR) for row in found["rows"]]
        painted, means = name.split(", ")
        line = "-" if means.startswith("hits") else "--"
        axes.plot(x, y, line, color=STEPS[painted], linewidth=1.4, marker="o", markersize=3.5, label=name)
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    style(axes)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda spacing, _: f"{spacing:g}"))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda error, _: percent(error)))
    axes.set_xlabel("spacing of lines, px (1 is the default)", color=INK, fontsize=8.5)
    axes.set_ylabel("relative error of one image's derivative", color=INK, fontsize=8.5)
    figure.legend(loc="center left", bbox_to_anchor=(0.775, 0.48), frameon=False, fontsize=8.5)
    figure.text(0.012, 0.94, "Steps within faces", fontsize=13, color=INK)
    figure.text(
        0.012, 0.885, f"Derivative of a painted area by its size, root mean square of {found['seeds']} seeds. Solid: declared "
        "by a shader. Dashed: the kernel's own.", fontsize=8.5, color=FAINT,
    )  # fmt: skip
    return figure


def losses(fits: list[dict[str, Any]]) -> Figure:
    """The loss at each step, each fit named at the end of its curve."""
    figure = Figure(figsize=(8.4, 3.6), dpi=150)
    figure.subplots_adjust(left=0.08, right=0.72, top=0.87, bottom=0.14)
    axes = figure.subplots()
    for fit, color in zip(fits, FITS, strict=False):
        axes.plot(range(1, len(fit["losses"]) + 1), fit["losses"], color=color, linewidth=1.2)
        axes.annotate(
            fit["fit"], (len(fit["losses"]), fit["losses"][-1]), (5, 0), textcoords="offset points", color=color,
            fontsize=8, va="center", annotation_clip=False,
        )  # fmt: skip
    axes.set_yscale("log")
    style(axes)
    axes.set_xlabel("step", color=INK, fontsize=8.5)
    axes.set_ylabel("mean squared difference", color=INK, fontsize=8.5)
    figure.text(0.012, 0.94, "Ill-conditioned fits", fontsize=13, color=INK)
    return figure


# -- tables -----------------------------------------------------------------------------------------------------------


def table(document: Document) -> str:
    """All numbers in Markdown."""
    now = document["settings"]
    rows = document["cases"]
    counts = {v: sum(row["verdict"] == v for row in rows) for v in COLORS}
    lines = [f"""# Extreme cases

![Error of the gradient in extreme cases]({NAME}.png)

Image and gradient of image · adjoint in {len(rows)} cases: {", ".join(f"{n} {v}" for v, n in counts.items() if n)}. Errors are
‖mean over seeds − reference‖ / ‖reference‖ ± one standard error. The gradient's error is computed for each of its parts (the
vertices of each mesh, its colours, the background, the camera's rotation and translation, focal length, skew, principal point, or
motions of the whole), and the table names the part with the largest. The image's error is relative to what the scene adds to its
background. Where a reference is zero, errors are relative to the norm of the adjoint.

*right*: within four standard errors and {percent(TOLERANCE)}, with a standard error below {percent(NOISE)}.
*limit*: not right, of known cause and size; see below. *too noisy to decide* and *wrong* do not pass.

{machine_in_words(now)}; {document.get("seconds", 0.0):.0f} s.
"""]  # fmt: skip
    for group in dict.fromkeys(row["group"] for row in rows):
        lines += [
            f"## {group[0].upper()}{group[1:]}\n",
            "| case | what is extreme | image | gradient | of | reference | verdict |",
        ]
        lines += ["|---" * 7 + "|", *(_row(row) for row in rows if row["group"] == group), ""]
    limits = [row for row in rows if "limit" in row]
    if limits:
        lines += ["## Limits\n", "Why these cases are not right:\n"]
        lines += [_limit(row) for row in limits] + [""]
    for name, write in (("statistics", _statistics), ("steps", _steps), ("fits", _fits)):
        if name in document["sections"]:
            lines += write(document["sections"][name])
    return "\n".join(lines).rstrip() + "\n"


def _entry(entry: dict[str, float]) -> str:
    return f"{percent(entry['error'])} ± {percent(entry['noise'])}"


def _row(row: dict[str, Any]) -> str:
    if "raised" in row:
        return f"| {row['name']} | {row['extreme']} | | | | | error raised: {row['raised']} |"
    name, part = worst_part(row)
    reference = row["reference"]
    if row["steps"]:
        reference += ", steps " + ", ".join(f"{step:g}" for step in dict.fromkeys(row["steps"].values()))
    verdict = row["verdict"] if row["verdict"] in (RIGHT, LIMIT) else f"**{row['verdict']}**"
    cells = [row["name"], row["extreme"], _entry(row["image"]), _entry(part), name, reference, verdict]
    return f"| {' | '.join(cells)} |"


def _limit(row: dict[str, Any]) -> str:
    if row["verdict"] == RIGHT:
        return f"- {row['name']}: {row['limit']}. Not seen in this run."
    name, part = worst_part(row)
    return (
        f"- {row['name']}: {row['limit']}. {percent(part['error'])} of {name}, image {percent(row['image']['error'])}."
    )


def _statistics(found: dict[str, Any]) -> list[str]:
    fair, squared = found["unbiased"], found["squared loss"]
    verdict = "none is rejected" if not fair["rejected"] else f"**{fair['rejected']} are rejected**"
    lines = [f"""## Unbiased

Mean of {fair["seeds"]} seeds against exact integrals, few samples each: z = (mean − exact) / standard error for
every component of every part and 16 random sums of all pixels. Lit scenes are compared with finite differences, whose noise is
in z. {fair["components"]} components in all, tested
together by Holm's method at {percent(fair["alpha"])}, the probability of any false rejection in a run of all scenes,
whatever the correlations: {verdict}.

| scene | components | largest \\|z\\| | beyond 3 | expected, if independent | deviation of one seed | reference ± |
|---|---|---|---|---|---|---|"""]  # fmt: skip
    lines += [
        f"| {row['scene']} | {row['components']} | {row['largest']:.2f} | {row['beyond']} | {row['expected']:.1f} "
        f"| {percent(row['deviation'])} | {percent(row['reference'])} |" for row in fair["rows"]
    ]  # fmt: skip
    lines += [
        f"""
## Tails

Single samples of the vertices' gradient ({found["tails"][0]["samples"]:,} each). Largest share:
the largest sample's share of the sum of all norms, its ratio to the mean norm, and in brackets its share of the sum of squares.
Deviation: the standard deviation of one sample over the gradient's norm. That of n independent samples would be 1/√n of it;
samples placed evenly along curves and surfaces have less.

| scene | interior: largest share | deviation | boundary: largest share | deviation |
|---|---|---|---|---|"""
    ]
    lines += [f"| {row['scene']} | {_tail(row['interior'])} | {_tail(row['boundary'])} |" for row in found["tails"]]
    names = [name for name in squared["rows"][0] if name != "spp"]
    lines += [
        f"""
## A squared loss

Σ (I − T)², {squared["seeds"]} seeds: relative error of the mean ± one standard error. The value of the loss is biased by
the variance of the image, which falls faster than 1/n. The gradient for what moves has independent samples and no bias. That
for the background is the derivative of the image as it was made, and shares its noise.

| samples a pixel | {" | ".join(names)} |
|{"---|" * (1 + len(names))}"""
    ]
    for row in squared["rows"]:
        cells = [f"{percent(row[name]['bias'])} ± {percent(row[name]['noise'])}" for name in names]
        lines.append(f"| {row['spp']} | {' | '.join(cells)} |")
    return [*lines, ""]


def _tail(part: dict[str, float] | None) -> str:
    if part is None:
        return "– | –"
    return f"{percent(part['share'])}, {part['times']:.1f} × ({percent(part['squares'])}) | {part['deviation']:.1f}"


def _steps(found: dict[str, Any]) -> list[str]:
    names = list(found["rows"][0]["cases"])
    lines = [f"""## Steps within faces

![Error against the spacing of lines]({NAME}-steps.png)

The error of the derivative of a painted area by its size: a disc 31 px wide, stripes of 3.2 px with gaps as wide, and a
rotated checkerboard of texels of 3.2 px. A shader declares them, or alpha or nearest texels paint them.
Mean over {found["seeds"]} seeds ± its standard error, and the root mean square error of one image, with the default of everything
but the spacing of the lines that find steps (`Sampling.discontinuity_spacing`).

| spacing, px | {" | ".join(names)} | an image and its gradient, ms |
|---{"|---" * (len(names) + 1)}|"""]  # fmt: skip
    for row in found["rows"]:
        cells = [_spaced(row["cases"][name]) for name in names]
        times = [1e3 * row["cases"][name]["seconds"] for name in names]
        lines.append(f"| {row['spacing']:g} | {' | '.join(cells)} | {min(times):.0f} … {max(times):.0f} |")
    return [*lines, ""]


def _spaced(entry: dict[str, float]) -> str:
    return f"{100 * entry['bias']:+.2f} ± {100 * entry['noise']:.2f} %, {percent(entry['error'])}"


def _fits(fits: list[dict[str, Any]]) -> list[str]:
    lines = [
        f"""## Ill-conditioned fits

![Loss at each step]({NAME}-fits.png)

| fit, {len(fits[0]["losses"])} steps | finite | loss, first and last | largest rise in a step | error of | first | last |
|---|---|---|---|---|---|---|"""
    ]
    lines += [
        f"| {fit['fit']} | {'yes' if fit['finite'] else '**no**'} | {fit['losses'][0]:.2e}, {fit['losses'][-1]:.2e} "
        f"| × {fit['rise']:.2f} | {fit['error of']} | {fit['error'][0]:.3g} | {fit['error'][1]:.3g} |" for fit in fits
    ]  # fmt: skip
    return [*lines, ""]
