"""The budget of tests (conftest.py) is kept."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

TESTS = """
import time
import pytest

def work():
    end = time.process_time() + 0.3
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
    pytester.makeconftest(Path(__file__).with_name("conftest.py").read_text(encoding="utf-8"))
    pytester.makepyfile(TESTS)
    pytester.makeini("[pytest]\nmarkers = slow")
    pytester.runpytest_inprocess().assert_outcomes(passed=4)
    result = pytester.runpytest_inprocess("--budget", "0.15")
    result.assert_outcomes(passed=3, failed=1)
    result.stdout.fnmatch_lines(["took 0.* s of processor time, may take 0.15 s; *"])
