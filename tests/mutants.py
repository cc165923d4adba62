"""Mutants: do the tests notice a gradient of which one term is 5 % off?

    python tests/mutants.py [NAME …] [--list]

Each mutant changes a line of a copy of the kernel's sources (tests/mutants.txt). One kernel is compiled with all of them; the
environment variable EDGEGRAD_MUTANT names the one that it is, if any. For each, the tests that stand next to it are run until
one fails, and at first all of them without a mutant: then each must pass. `make mutants` runs this; it is no test itself.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import pytest

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
BUILD = ROOT / "build" / "mutants"
KERNEL = BUILD / "kernel" / "_core.abi3.so"
# off<"name">: 1.05 in the mutant of that name, and else 1.
HEADER = """#pragma once
#include <algorithm>
#include <cstddef>
#include <cstdlib>
#include <string_view>
namespace edgegrad {
template <std::size_t n>
struct MutantName {
    char letters[n];
    constexpr MutantName(const char (&text)[n]) { std::copy_n(text, n, letters); }
};
template <MutantName name>
inline const double off = [] {
    const char* chosen = std::getenv("EDGEGRAD_MUTANT");
    return chosen && std::string_view(chosen) == name.letters ? 1.05 : 1.0;
}();
}  // namespace edgegrad
"""


class Change(NamedTuple):
    file: str  # below csrc/
    line: str  # a part of it that stands there once
    changed: str
    mutants: dict[str, list[str]]  # by name: the tests


def path_of(file: str) -> Path:
    """Return the path of a file of tests, whose name stands in one folder alone."""
    (path,) = TESTS.rglob(file)
    return path


def changes() -> list[Change]:
    found = []
    for block in (TESTS / "mutants.txt").read_text().split("\n\n"):
        rows = [row for row in block.splitlines() if not row.startswith("#")]
        if not rows:
            continue
        file, line, *rest = rows
        changed = [row[2:] for row in rest if row.startswith("+ ")]
        mutants = [row for row in rest if not row.startswith("+ ")]
        assert line.startswith("- ") and changed and mutants, block
        tests = {name.strip(): listed.split() for name, listed in (row.split(": ") for row in mutants)}
        found.append(Change(file, line[2:], "\n".join(changed), tests))
    return found


def changed_sources(changes: list[Change]) -> dict[str, str]:
    """The kernel's sources with all mutants, by their names below csrc/."""
    texts = {path.relative_to(ROOT / "csrc"): path for path in (ROOT / "csrc").rglob("*") if path.is_file()}
    new = {str(name): path.read_text() for name, path in texts.items()}
    lost = []
    for change in changes:
        count = new.get(change.file, "").count(change.line)
        if count != 1:
            lost.append(f"{change.file}: {count} times: {change.line}")
            continue
        new[change.file] = new[change.file].replace(
            change.line, change.changed.replace('OFF("', 'off<"').replace('")', '">')
        )
    if lost:
        raise ValueError("tests/mutants.txt names what is not, or not once, in csrc/:\n" + "\n".join(lost))
    return new


def build(changes: list[Change]) -> None:
    """The kernel of all mutants; only files that changed are compiled again."""
    sources = BUILD / "csrc"
    new = changed_sources(changes)
    new["core/mutants.h"] = HEADER
    new["core/math.h"] = new["core/math.h"].replace("#pragma once\n", '#pragma once\n#include "core/mutants.h"\n', 1)
    for name, text in new.items():
        path = sources / name
        if not path.exists() or path.read_text() != text:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
    for path in sources.rglob("*"):
        if path.is_file() and str(path.relative_to(sources)) not in new:
            path.unlink()
    tool = Path(sys.executable).parent
    environment = {**os.environ, "PATH": f"{tool}:{os.environ['PATH']}"}
    nanobind = subprocess.check_output([sys.executable, "-m", "nanobind", "--cmake_dir"], text=True).strip()
    setup = ["cmake", "-S", str(sources), "-B", str(KERNEL.parent), "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Release"]
    setup += [f"-DPython_EXECUTABLE={sys.executable}", f"-Dnanobind_DIR={nanobind}"]
    for command in (setup, ["ninja", "-C", str(KERNEL.parent)]):
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)


class Outcome:
    """What pytest found."""

    def __init__(self) -> None:
        self.failed: list[str] = []
        self.passed = 0

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.append(report.nodeid)
        elif report.when == "call" and report.passed:
            self.passed += 1


def run(mutant: str, tests: list[str], *options: str) -> tuple[list[str], int]:
    """The tests that fail, and the number of those that pass, in a child that loads the kernel anew."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read)
        os.environ |= {"EDGEGRAD_KERNEL": str(KERNEL), "EDGEGRAD_MUTANT": mutant}
        silent = os.open(os.devnull, os.O_WRONLY)
        os.dup2(silent, 1), os.dup2(silent, 2)
        outcome = Outcome()
        names = ["::".join([str(path_of(file)), *rest]) for file, *rest in (test.split("::") for test in tests)]
        code = pytest.main(["-q", "-m", "not slow", "-p", "no:cacheprovider", *options, *names], plugins=[outcome])
        if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED):
            outcome.failed.append(f"pytest ended with {code!r}")
        os.write(write, json.dumps([outcome.failed, outcome.passed]).encode())
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        text = pipe.read()
    os.waitpid(child, 0)
    failed, passed = json.loads(text) if text else (["the process ended"], 0)
    return failed, passed


def main() -> None:
    parser = argparse.ArgumentParser(description="Runs tests with gradients of which one term is 5 % off.")
    parser.add_argument("names", nargs="*", help="of mutants; without any, all of them")
    parser.add_argument("--list", action="store_true", help="print the mutants and their tests alone")
    options = parser.parse_args()
    every = changes()
    chosen = {name: tests for change in every for name, tests in change.mutants.items()}
    if unknown := [name for name in options.names if name not in chosen]:
        parser.error(f"no mutant {unknown[0]!r}; `--list` prints them")
    chosen = {name: tests for name, tests in chosen.items() if not options.names or name in options.names}
    if options.list:
        for name, tests in chosen.items():
            print(f"{name:45}{' '.join(tests)}")
        return
    build(every)
    import torch  # noqa: F401  # once for all children

    failed, passed = run("", sorted({test for tests in chosen.values() for test in tests}))
    print(f"without a mutant: {passed} tests pass", flush=True)
    if failed:
        sys.exit("and these fail: " + ", ".join(failed))
    missed = 0
    for name, tests in chosen.items():
        began = time.perf_counter()
        failed, passed = run(name, tests, "-x")
        seconds = time.perf_counter() - began
        how = f"caught by {failed[0].split('/')[-1]}" if failed else f"NOT CAUGHT by {passed} tests"
        print(f"{name:45}{seconds:5.1f} s  {how}", flush=True)
        missed += not failed
    if missed:
        sys.exit(f"{missed} of {len(chosen)} mutants are not caught.")
    print(f"All {len(chosen)} mutants are caught.")


if __name__ == "__main__":
    main()
