"""The mutants of `make mutants` change lines that exist, and name tests that exist."""

from __future__ import annotations

import re

import mutants
import pytest

pytestmark = pytest.mark.quick


def test_lines_stand_once_and_tests_exist() -> None:
    every = mutants.changes()
    mutants.changed_sources(every)
    names = [name for change in every for name in change.mutants]
    assert len(names) == len(set(names)) > 80
    for test in {test for change in every for tests in change.mutants.values() for test in tests}:
        file, function = test.split("::")
        assert re.search(rf"^def {function}\(", mutants.path_of(file).read_text(), re.MULTILINE), test
    for change in every:
        assert not re.search(r"\boff\b", change.changed), f"hides off<>, which is what OFF is: {change}"
        assert all(f'OFF("{name}")' in change.changed for name in change.mutants), change


def test_a_line_that_is_gone_is_named() -> None:
    gone = mutants.Change("backward/backward.cpp", "no such line", "", {})
    with pytest.raises(ValueError, match=r"backward/backward.cpp: 0 times: no such line"):
        mutants.changed_sources([gone])
