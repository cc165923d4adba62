"""The benchmark of pose fits: a seed makes a case, a run goes on where it ended, and its figures are right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from benchmarks.poses import __main__ as command
from benchmarks.poses import objects, runs, sensitivity, summary
from benchmarks.poses.kinds import KINDS, cases
from benchmarks.poses.objects import OBJECTS, Sources

BOARDS = [objects.clutter(k, 160) for k in range(4)]


@pytest.fixture(autouse=True)
def _same_photographs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "_photographs", lambda files: BOARDS)


@pytest.mark.parametrize("kind", ["easy15", "covered", "two", "beside"])
def test_a_kind_and_a_seed_make_one_case(kind: str) -> None:
    found, again, other = (cases(kind, seed, Sources()) for seed in (1001, 1001, 1002))
    assert len(found) == (KINDS[kind].recipe or pytest.fail()).count
    assert torch.equal(found[0].picture, again[0].picture) and torch.equal(found[0].truth.matrix, again[0].truth.matrix)
    if found[0].start is None:
        return
    assert not torch.equal(found[0].start.matrix, (other[0].start or found[0].start).matrix)
    degrees, shift = found[0].apart(found[0].start, found[0].truth)
    assert 0.0 < degrees <= 30.0 and 0.0 < shift <= 0.101


def test_tuning_has_other_objects_and_photographs_than_reporting() -> None:
    sources = Sources()
    assert {*sources.names(0)} | {*sources.names(1000)} == {*OBJECTS} and not {*sources.names(0)} & {
        *sources.names(1000)
    }
    assert not any(a is b for a in sources.photographs(0) for b in sources.photographs(1000))


def test_a_run_leaves_out_what_its_file_holds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out, asked = tmp_path / "fits.jsonl", []

    def run(jobs: Sequence[runs.Job], processes: int) -> list[list[runs.Record]]:
        asked.append([job.key for job in jobs])
        return [runs.measured(job) for job in jobs]

    monkeypatch.setattr(runs, "fitted", lambda *_: 1 / 0)
    monkeypatch.setattr(runs, "run", run)
    for count in (1, 2):
        command.main(["--kinds", "lit", "plain", "--count", str(count), "--out", str(out)])
    assert asked == [[("lit", 1000), ("plain", 1000)], [("lit", 1001), ("plain", 1001)]]
    out.write_text(out.read_text()[:-9])  # A line that was not written whole is run again.
    assert len(runs.read([out])) == 3 and "ZeroDivisionError" in runs.read([out])[0]["error"]


def test_a_fit_of_a_case_is_right() -> None:
    (record,) = runs.measured(runs.Job("mask", 1000, Sources(("carton",))))
    assert record["right"] and record["converged"] and summary.known(record)
    assert record["start_degrees"] == pytest.approx(15.0) and "mask " in command.line(record)


def test_intervals_are_those_of_wilson() -> None:
    assert summary.wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    assert summary.wilson(0, 10)[0] == 0.0 and summary.wilson(10, 10)[1] == 1.0


def test_the_calibration_error_is_that_of_bins(tmp_path: Path) -> None:
    right, wrong = ({"kind": "lit", "degrees": degrees, "shift": 0.01, "right": True} for degrees in (1.0, 9.0))
    records = [{**one, "confidence": 0.9} for one in (right, wrong)] + [{**wrong, "confidence": 0.15}] * 2
    found = summary.bins(records)
    assert [one.fits for one in found] == [2, 2]
    assert summary.calibration_error(found) == pytest.approx(0.5 * 0.4 + 0.5 * 0.15)
    summary.draw_reliability(found, tmp_path / "figure.png")
    with pytest.raises(ValueError, match="confidence"):
        summary.bins([{**right, "confidence": math.nan}])


def test_each_number_of_the_settings_is_halved_and_doubled() -> None:
    @dataclass(frozen=True)
    class Inner:
        length: float = 3.0
        name: str = "x"

    @dataclass(frozen=True)
    class Outer:
        inner: Inner = Inner()
        count: int = 4
        flag: bool = True

    found = sensitivity.variants(Outer())
    assert [(name, value) for name, value, _ in found] == [("inner.length", 3.0), ("count", 4)]
    assert [one.inner.length for one in found[0][2]] == [1.5, 6.0] and [one.count for one in found[1][2]] == [2, 8]
