"""Which lines of the kernel do the tests of `make sanitize` reach?

    python tests/kernel_coverage.py

Compiles the kernel for gcov in build/coverage, runs the tests with it, and prints the share of lines of each source that ran.
Fails where that is less than two thirds of a source that has ten lines and more. `make coverage` runs this; it is no test itself.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BUILD = ROOT / "build" / "coverage"
LEAST, FEW = 2 / 3, 10  # the share of lines; lines of a source too short to ask it of


def build() -> None:
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"}
    nanobind = subprocess.check_output([sys.executable, "-m", "nanobind", "--cmake_dir"], text=True).strip()
    setup = ["cmake", "-S", str(ROOT / "csrc"), "-B", str(BUILD), "-G", "Ninja", "-DCMAKE_BUILD_TYPE=Debug"]
    setup += ["-DCMAKE_CXX_FLAGS_DEBUG=-O1", "-DEDGEGRAD_COVERAGE=ON"]
    setup += [f"-DPython_EXECUTABLE={sys.executable}", f"-Dnanobind_DIR={nanobind}"]
    for command in (setup, ["ninja", "-C", str(BUILD)]):
        subprocess.run(command, check=True, env=environment, stdout=subprocess.DEVNULL)


def lines() -> dict[str, dict[int, bool]]:
    """By source below csrc/: the lines that have code, and whether they ran."""
    found: dict[str, dict[int, bool]] = defaultdict(dict)
    # Files that gcov writes would overwrite each other: sources of several folders have one name.
    data = [str(path) for path in BUILD.rglob("*.gcda")]
    for report in subprocess.check_output(["gcov", "--json-format", "--stdout", *data], text=True).splitlines():
        for source in json.loads(report)["files"]:
            path = Path(source["file"]).resolve()
            if ROOT / "csrc" not in path.parents:
                continue
            ran = found[str(path.relative_to(ROOT / "csrc"))]
            for line in source["lines"]:
                number = line["line_number"]
                ran[number] = ran.get(number, False) or line["count"] > 0
    return found


def is_in_wheel(source: str) -> bool:
    """Return whether it is not called by benchmarks and tests alone."""
    return not source.startswith("checks/") and "for_tests" not in source


def main() -> None:
    build()
    for path in BUILD.rglob("*.gcda"):
        path.unlink()
    environment = {**os.environ, "EDGEGRAD_KERNEL": str(BUILD / "_core.abi3.so")}
    # In one process: that of a worker of pytest-xdist ends without writing what it counted.
    tests = [
        sys.executable,
        "-m",
        "pytest",
        "-q",
        "-m",
        "watched and not slow and not unwatched",
        "--deselect",
        "tests/kernel/test_sanitizers.py",
    ]
    if subprocess.run(tests, cwd=ROOT, env=environment).returncode:
        print("Some tests fail; what they reach counts all the same.")
    found, missed = lines(), []
    for name in sorted(found):
        count, share = len(found[name]), sum(found[name].values()) / max(len(found[name]), 1)
        print(f"{share:6.0%} of {count:4} lines  {name}")
        if share < LEAST and count >= FEW and is_in_wheel(name):
            missed.append(name)
    total = sum(map(len, found.values()))
    print(f"{sum(sum(ran.values()) for ran in found.values()) / total:6.0%} of {total} lines of {len(found)} sources")
    whole = {str(path.relative_to(ROOT / "csrc")) for path in (ROOT / "csrc").rglob("*.cpp")}
    missed += sorted(filter(is_in_wheel, whole - set(found)))
    if missed:
        sys.exit("The tests reach too little of " + ", ".join(missed))


if __name__ == "__main__":
    main()
