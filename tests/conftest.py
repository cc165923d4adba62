"""How tests run: on one thread each, for several run at a time, and within a budget of processor time."""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).parents[1]
# Tests use scenes and references of benchmarks/, objects of examples/, and helpers of any folder of tests/.
FOLDERS = sorted(path for path in Path(__file__).parent.iterdir() if path.is_dir())
sys.path += map(str, (ROOT, ROOT / "examples", *FOLDERS))
torch.set_num_threads(1)
signal.signal(signal.SIGINT, signal.default_int_handler)  # what started the tests may have it ignored, as nohup does
# Tests start Python some hundred times, and each would compile all that it imports where it may not keep it.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
gc.disable()  # until tests are collected: there is no garbage among them, and each look at so many objects takes 0.3 s


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--budget", type=float, help="seconds of processor time that a test may take if it is not slow")
    parser.addoption(
        "--failures", type=Path, help="file to which failures are written as they come, so also when interrupted"
    )
    parser.addoption(
        "--dearest", type=int, default=10, help="how many of the tests that took most are listed at the end"
    )


class Failures:
    """Shows the report of each failed test at once and appends it to a file."""

    def __init__(self, config: pytest.Config, path: Path) -> None:
        self.config, self.path = config, path
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("", encoding="utf-8")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            captured = "".join(f"\n-- {title} --\n{text}" for title, text in report.sections)
            whole = f"==== {report.nodeid} ({report.when})\n{report.longreprtext}{captured}\n"
            with self.path.open("a", encoding="utf-8") as file:
                file.write(whole)
            terminal = self.config.pluginmanager.get_plugin("terminalreporter")
            if terminal is not None:
                terminal.ensure_newline()
                terminal.write_line(whole)


@pytest.hookimpl(trylast=True)
def pytest_configure(config: pytest.Config) -> None:
    path = config.getoption("failures")
    if path is not None and not hasattr(
        config, "workerinput"
    ):  # the workers of xdist send their reports to one process
        config.pluginmanager.register(Failures(config, path))


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


def processor_time() -> float:
    """Seconds of this process, and of the children it waited for. Those on the clock would depend on what else runs."""
    return sum(os.times()[:4])


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    began = processor_time()
    yield
    taken, budget = processor_time() - began, item.config.getoption("budget")
    item.user_properties.append(("processor time", taken))
    if budget is not None and taken > budget and item.get_closest_marker("slow") is None:
        pytest.fail(
            f"took {taken:.1f} s of processor time, may take {budget:g} s; make it shorter, or mark it slow", False
        )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The tests that took most, so that one sees what to make shorter."""
    reports = terminalreporter.stats.get("passed", [])
    times = {r.nodeid: dict(r.user_properties).get("processor time", 0.0) for r in reports if r.when == "call"}
    listed = terminalreporter.config.getoption("dearest")
    if terminalreporter.config.getoption("budget") is not None and times:
        terminalreporter.section(f"{sum(times.values()):.0f} s of processor time")
        for name in sorted(times, key=times.__getitem__, reverse=True)[:listed]:
            terminalreporter.line(f"{times[name]:6.1f} s  {name}")


@pytest.fixture(autouse=True)
def _same_seeds() -> None:
    """Renders without a seed draw theirs from torch's generator, which is the same for each test."""
    torch.manual_seed(0)
