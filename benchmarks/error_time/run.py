"""The error of the gradient against the time it takes: every scene, method and number of samples, in one run.

A point is one method at one number of samples: the relative error ‖g − g*‖ / ‖g*‖, root mean square over seeds, and the median
seconds. Points are written as soon as they are measured; a later run with the same settings goes on from them.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from edgegrad.check import check_positive, check_positive_int
from edgegrad.files.paths import replacing
from edgegrad.profile import profile

from ..document import Document, duration, machine, percent
from ..scenes import SCENES, ReportScene, build
from .methods import METHODS, METRICS, Method, missing
from .references import BOUNCED, LIT, QUICK, Effort, Reference, disagrees, reference

NAME = "error-time"
WARM_UP = 1 << 20  # a seed that is not measured
LARGEST = 4096  # pixels on a side: references and finite differences hold several such images in double


def error_time(
    out: Path,
    scenes: Sequence[str] | None = None,
    methods: Sequence[str] | None = None,
    *,
    size: int = 256,
    seeds: int = 5,
    limit: float = 10.0,
    quick: bool = False,
    mesh: Path | None = None,
) -> tuple[Document, bool]:
    """Measures and writes error-time.json, .md and .png in the folder `out`; (what is in the JSON, whether Ctrl-C ended it).

    scenes, methods  names, all when None
    size             pixels on a side of the image
    seeds            gradients a point
    limit            seconds a gradient may take; more samples than that are left out
    quick            few points and a rough reference, to try it out
    mesh             file of the scene "scan"

    Raises ValueError for an unknown name, a number out of range, a mesh that cannot be shown or a file that an earlier run did
    not write, OSError for a mesh that is not there; all before anything is measured.
    """
    scenes = _known("scenes", scenes, SCENES)
    methods = _known("methods", methods, METHODS)
    check_positive_int("size", size, most=LARGEST)
    check_positive_int("seeds", seeds, most=1000)
    check_positive("limit", limit, least=1e-9, most=1e9)
    if seeds < 2:
        raise ValueError(f"seeds: expected at least 2, for the spread, got {seeds}; try 5")
    if mesh is not None and "scan" not in scenes:
        raise ValueError(f"mesh: expected with the scene scan, got {', '.join(scenes)}; add scan")
    scan = None if mesh is None else build("scan", size, mesh)
    run = _Run(out, size, seeds, limit, quick)
    for name in methods:
        if (lack := missing(name)) is not None:
            run.say(f"{name}: left out; {lack}")
    methods = [name for name in methods if missing(name) is None]

    interrupted = False
    with tqdm(total=len(scenes) * len(methods), unit="sweep", dynamic_ncols=True) as run.bar:
        try:
            for name in scenes:
                run.measure_scene(name, methods, scan if name == "scan" else None)
        except KeyboardInterrupt:
            interrupted = True
    if run.document["points"]:
        run.write()
        run.publish()
    return run.document, interrupted


def _known(argument: str, names: Sequence[str] | None, known: Sequence[str] | dict[str, Any]) -> list[str]:
    for name in names or ():
        if name not in known:
            raise ValueError(f"{argument}: expected some of {', '.join(known)}, got {name!r}")
    return list(dict.fromkeys(known if names is None else names))


class _Run:
    """One run: its settings, its progress bar and its document."""

    def __init__(self, out: Path, size: int, seeds: int, limit: float, quick: bool) -> None:
        self.out, self.size, self.seeds, self.limit, self.quick = out, size, seeds, limit, quick
        self.bar: tqdm | None = None
        self.file = out / f"{NAME}.json"
        self.document = self._resume({"size": size, "seeds": list(range(seeds)), "quick": quick, **machine()})

    def say(self, text: str) -> None:
        tqdm.write(text)

    def _resume(self, now: dict[str, Any]) -> Document:
        """Return the document of these settings, if any. One of other settings is renamed, and found again with these."""
        if self.file.exists():
            before = self._read(self.file)
            if before["settings"] == now:
                self.say(f"{self.file}: {len(before['points'])} points are there and not measured again")
                return before
            old = before["settings"]
            differ = sorted(key for key in old.keys() | now.keys() if old.get(key) != now.get(key))
            os.replace(self.file, self._aside(old))
            self.say(f"{self.file}: of other settings ({', '.join(differ)}); kept as {self._aside(old).name}")
        if self._aside(now).exists():
            before = self._read(self._aside(now))
            self.say(f"{self._aside(now)}: {len(before['points'])} points are there and not measured again")
            os.replace(self._aside(now), self.file)
            return before
        return {"settings": now, "scenes": {}, "points": []}

    def _aside(self, settings: dict[str, Any]) -> Path:
        key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:8]
        return self.out / f"{NAME}.{key}.json"

    def _read(self, file: Path) -> Document:
        try:
            document = json.loads(file.read_text(encoding="utf-8"))
            _ = dict(document["settings"]), dict(document["scenes"])
            _ = [(point["scene"], point["method"], point["version"]) for point in document["points"]]
            return document
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"{file}: expected what an earlier run wrote, got something else ({error!r}); "
                "remove it or choose another folder"
            ) from error

    def write(self) -> None:
        with replacing(self.file) as temporary:
            temporary.write_text(json.dumps(self.document, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")

    def publish(self) -> None:
        """Write the table and the figure of all points."""
        from . import plots  # matplotlib takes a while to import

        plots.write_table(self.out / f"{NAME}.md", self.document)
        plots.draw(self.out / f"{NAME}.png", self.document)

    def measure_scene(self, name: str, methods: Sequence[str], scene: ReportScene | None) -> None:
        assert self.bar is not None
        self.bar.set_description(f"{name}: building")
        try:
            scene = scene or build(name, self.size)
        except ImportError as error:
            if name != "scan":
                raise
            self.say(f"\nscan: left out; give one with --mesh PATH ({error})")
            self.bar.update(len(methods))
            return
        self.bar.set_description(f"{name}: reference")
        lit = BOUNCED if scene.bounces > 1 else LIT
        effort = QUICK if self.quick else lit if scene.scene.is_lit else Effort()
        correct = reference(scene, self.out, effort, self.say)
        self._describe(scene, correct)
        for method_name in methods:
            try:
                found = METHODS[method_name](scene)
            except (ValueError, RuntimeError) as error:  # what a peer does not support
                self.document["scenes"][name]["left_out"][method_name] = str(error)
                self.say(f"  {method_name}: left out; {error}")
                found = []
            for method in found:
                self._sweep(scene, correct, method)
            self.bar.update()
        self.publish()

    def _describe(self, scene: ReportScene, correct: Reference) -> None:
        entries = self.document["scenes"]
        entry = entries.get(scene.name)
        if entry is None or entry["fingerprint"] != scene.fingerprint:
            points = self.document["points"]
            self.document["points"] = [point for point in points if point["scene"] != scene.name]
            entry = entries[scene.name] = {
                "title": scene.title, "fingerprint": scene.fingerprint, "faces": scene.faces,
                "vertices": len(scene.verts), "left_out": {}, "terms": cost_of_terms(scene),
            }  # fmt: skip
        entry["reference"] = {"kind": correct.kind, "error": correct.error, "check": correct.check}
        self.say(f"\n{scene.name}: {scene.title}\n  reference: {correct.kind}{_errors_in_words(correct)}")
        self.say(f"  {'method':28s}{'samples':>9s}{'vertex':>10s}{'translation':>13s}{'rotation':>10s}{'time':>11s}")

    def _sweep(self, scene: ReportScene, correct: Reference, method: Method) -> None:
        assert self.bar is not None
        budgets = method.budgets[1:4] if self.quick else method.budgets
        known = {
            point["budget"]: point
            for point in self.document["points"]
            if (point["scene"], point["method"], point["version"]) == (scene.name, method.name, method.version)
        }
        costs: list[tuple[float, float]] = []
        warm = False
        for budget in budgets:
            if _expected(costs, budget) > self.limit:
                break
            point = known.get(budget)
            if point is None:
                self.bar.set_description(f"{scene.name}: {method.name} {method.label(budget)}")
                point = self._point(scene, correct, method, budget, warm)
                warm = True
                self.document["points"] = [p for p in self.document["points"] if not _same(p, point)] + [point]
                self.write()
            costs.append((budget, point["seconds"]))
            self.say(_row(point))

    def _point(
        self, scene: ReportScene, correct: Reference, method: Method, budget: float, warm: bool
    ) -> dict[str, Any]:
        compiled = method.compile_seconds
        if not warm:
            method.gradient(budget, WARM_UP)
        gradients = [method.gradient(budget, seed) for seed in range(self.seeds)]
        target, whole = correct.metrics(scene, method.part), correct.metrics(scene)
        metrics = {}
        for name in METRICS:
            estimates = [gradient.metrics()[name] for gradient in gradients if name in gradient.metrics()]
            if not estimates:
                continue
            norm = float(whole[name].norm())
            errors = [float((estimate - target[name]).norm()) / max(norm, 1e-300) for estimate in estimates]
            rms = math.sqrt(sum(error * error for error in errors) / len(errors))
            metrics[name] = {"error": _finite(rms), "errors": [_finite(error) for error in errors]}
        seconds = [gradient.seconds for gradient in gradients]
        return {
            "scene": scene.name, "method": method.name, "part": method.part, "version": method.version,
            "budget": budget, "label": method.label(budget), "metrics": metrics,
            "seconds": statistics.median(seconds), "seconds_of_seeds": seconds,
            "compile_seconds": method.compile_seconds - compiled, "measured": time.strftime("%Y-%m-%d %H:%M:%S"),
        }  # fmt: skip


def cost_of_terms(scene: ReportScene) -> dict[str, float]:
    """Return median seconds of each part of a step, by edgegrad.profile; none for lit scenes."""
    return {} if scene.scene.is_lit else dict(profile(scene.scene, scene.camera, scene.adjoint))


def _expected(costs: list[tuple[float, float]], budget: float) -> float:
    """Return the seconds of the next point, extrapolated from the last two (budget, seconds)."""
    if not costs:
        return 0.0
    (x1, t1), (x0, t0) = costs[-1], costs[-2] if len(costs) > 1 else (costs[-1][0] - 1.0, costs[-1][1])
    return t1 + max(0.0, (t1 - t0) / (x1 - x0)) * (budget - x1)


def _same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return all(a[key] == b[key] for key in ("scene", "method", "budget"))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _errors_in_words(correct: Reference) -> str:
    if correct.error:
        own = ", ".join(f"{name} {percent(error)}" for name, error in correct.error["whole"].items())
        text = f"; its own error: {own}"
    else:
        text = "; without sampling error"
    for name, check in correct.check.items():
        text += f"\n  finite differences of {name}: {percent(check['difference'])} apart"
        text += f", ± {percent(check['standard_error'])} by chance"
        if disagrees(check):
            text += "; THEY DISAGREE: do not trust the errors below"
    return text


def _row(point: dict[str, Any]) -> str:
    name, label = point["method"], point["label"]
    errors = [point["metrics"].get(metric) for metric in METRICS]
    v, t, r = ("–" if error is None else percent(error["error"]) for error in errors)
    compiled = f"  + {duration(point['compile_seconds'])} once" if point["compile_seconds"] else ""
    return f"  {name:28s}{label:>9s}{v:>10s}{t:>13s}{r:>10s}{duration(point['seconds']):>11s}{compiled}"
