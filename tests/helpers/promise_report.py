"""Collect the figures that tests measured, and print a list of the promises (a pytest plugin).

The list is printed at the end of ``pytest -m slow``, and of any run with ``--promises``.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from helpers.promises import PROMISES

Figure = Callable[[str, str], None]

PROPERTY = "promise"
"""Name of the user property that carries a figure from a worker of pytest-xdist to the coordinator."""

FAILED = ("failed", "error", "xpassed")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that prints the list."""
    text = "print the promises with the figures of this run"
    parser.getgroup("promises").addoption("--promises", action="store_true", help=text)


@pytest.fixture
def figure(record_property: Callable[[str, object], None]) -> Figure:
    """Return a function that reports a number which the test measured: name of the promise, text."""

    def report(promise: str, text: str) -> None:
        assert promise in PROMISES, f"{promise}: no such promise in docs/evidence.md"
        record_property(PROPERTY, [promise, text])

    return report


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the list."""
    if not (config.getoption("--promises") or config.getoption("markexpr") == "slow"):
        return
    terminalreporter.section("promises")
    for promise in PROMISES.values():
        outcomes: Counter[str] = Counter()
        figures: Counter[str] = Counter()
        for outcome in (*FAILED, "passed", "xfailed", "skipped"):
            for report in terminalreporter.stats.get(outcome, []):
                if isinstance(report, pytest.TestReport) and report.nodeid.split("::")[0] in promise.files:
                    outcomes["failed" if outcome in FAILED else outcome] += 1
                    if outcome == "passed" and report.when == "call":
                        figures.update(value[1] for _, value in report.user_properties if value[0] == promise.name)
        state = ", ".join(f"{count} {outcome}" for outcome, count in outcomes.items()) or "not run"
        terminalreporter.write_line(f"{promise.name}: {state}: {promise.sentence}")
        for text, count in figures.items():
            terminalreporter.write_line(f"    {text}{f' ({count} cases)' if count > 1 else ''}")
