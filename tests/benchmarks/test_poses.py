"""The benchmark of pose fits: a seed makes a case, a run goes on where it ended, and its figures are right."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
import torch

from benchmarks.poses import __main__ as command
from benchmarks.poses import cases as drawing
from benchmarks.poses import runs, sensitivity, summary
from benchmarks.poses.kinds import cases
from benchmarks.poses.objects import OBJECTS, Sources


@pytest.fixture(autouse=True)
def _small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(drawing, "SIDES", (72, 97))


@pytest.mark.parametrize("kind", ["easy15", "covered", "two", "beside"])
def test_a_kind_and_a_seed_make_one_case(kind: str) -> None:
    found, again, other = (cases(kind, seed, Sources())[-1] for seed in (1001, 1001, 1002))
    assert torch.equal(found.picture, again.picture) and torch.equal(found.truth.matrix, again.truth.matrix)
    assert found.start and other.start and not torch.equal(found.start.matrix, other.start.matrix)
    degrees, shift = found.apart(found.start, found.truth)
    assert 4.99 < degrees < 15.01 and 0.0 < shift < 0.051


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


def test_the_calibration_error_is_that_of_bins(tmp_path: Path) -> None:
    assert summary.wilson(8, 10) == pytest.approx((0.4902, 0.9433), abs=1e-4)
    right, wrong = ({"kind": "lit", "degrees": degrees, "shift": 0.01} for degrees in (1.0, 9.0))
    records = [{**one, "confidence": 0.9} for one in (right, wrong)] + [{**wrong, "confidence": 0.15}] * 2
    found = summary.bins(summary.said(records))
    assert summary.calibration_error(found) == pytest.approx(0.5 * 0.4 + 0.5 * 0.15)
    summary.draw_reliability(found, tmp_path / "figure.png")
    with pytest.raises(ValueError, match="confidence"):
        summary.said([{**right, "confidence": math.nan}])


def test_each_number_of_the_settings_is_halved_and_doubled() -> None:
    @dataclass(frozen=True)
    class Settings:
        length: float = 3.0
        flag: bool = True

    ((name, value, changed),) = sensitivity.variants(Settings())
    assert (name, value, [one.length for one in changed]) == ("length", 3.0, [1.5, 6.0])
