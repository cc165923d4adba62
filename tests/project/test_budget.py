"""The budget of tests (conftest.py) is kept, and failures are written as they come."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]
CONFTEST = Path(__file__).parents[1] / "conftest.py"

TESTS = """
import time
import pytest

def work():
    end = time.process_time() + 0.12
    while time.process_time() < end:
        pass

def test_quick():
    pass

def test_long():
    work()

def test_asleep():
    time.sleep(0.3)

@pytest.mark.slow
def test_slow():
    work()
"""


def test_a_test_over_budget_fails(pytester: pytest.Pytester) -> None:
    pytester.makeconftest(CONFTEST.read_text(encoding="utf-8"))
    pytester.makepyfile(TESTS)
    pytester.makeini("[pytest]\nmarkers = slow")
    pytester.runpytest_inprocess().assert_outcomes(passed=4)
    result = pytester.runpytest_inprocess("--budget", "0.06")
    result.assert_outcomes(passed=3, failed=1)
    result.stdout.fnmatch_lines(["took 0.* s of processor time, may take 0.06 s; *"])


FAILING = """
import os, signal

def test_fails():
    print("captured words")
    assert 1 + 1 == 3

def test_is_ended():
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_failures_are_left_by_a_run_that_is_ended(pytester: pytest.Pytester) -> None:
    """They are written and shown as they come."""
    pytester.makeconftest(CONFTEST.read_text(encoding="utf-8"))
    pytester.makepyfile(FAILING, torch="set_num_threads = manual_seed = lambda count: None")  # takes long to import
    result = pytester.runpytest_subprocess("--failures", "out/failures.txt")
    assert result.ret == -signal.SIGKILL
    written = (pytester.path / "out" / "failures.txt").read_text(encoding="utf-8")
    for text in (written, result.stdout.str()):
        assert "::test_fails (call)" in text and "assert (1 + 1) == 3" in text and "captured words" in text
