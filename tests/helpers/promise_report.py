"""Collect the figures that tests measured, and print a table of the promises (a pytest plugin).

The table is printed at the end of ``pytest -m slow``, and of any run with ``--promises``.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from helpers.promises import BY_ID, PROMISES, RECORDED, Figures, Promise, one_line, recorded_figures

Figure = Callable[[str, str], None]

PROPERTY = "promise"
"""Name of the user property that carries a figure from a worker of pytest-xdist to the coordinator."""

OUTCOMES = ("passed", "failed", "error", "skipped", "xfailed", "xpassed")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the options of the table."""
    group = parser.getgroup("promises")
    group.addoption("--promises", action="store_true", help="print the table of promises with the figures of this run")
    group.addoption(
        "--record-figures", action="store_true", help=f"update the figures of passed tests in docs/{RECORDED.name}"
    )


@pytest.fixture
def figure(record_property: Callable[[str, object], None]) -> Figure:
    """Return a function that reports a number which the test measured: identifier of the promise, text."""

    def report(promise: str, text: str) -> None:
        assert promise in BY_ID, f"{promise}: no such promise in helpers/promises.py"
        record_property(PROPERTY, [promise, text])

    return report


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Print the table, and update the recorded figures if asked to."""
    record = config.getoption("--record-figures")
    if not (record or config.getoption("--promises") or config.getoption("markexpr") == "slow"):
        return
    reports = [
        (outcome, report)
        for outcome in OUTCOMES
        for report in terminalreporter.stats.get(outcome, [])
        if isinstance(report, pytest.TestReport)
    ]
    figures = measured_figures(reports)
    before = recorded_figures()
    terminalreporter.section("promises")
    for promise in PROMISES:
        shown = figures.get(promise.id, {})
        terminalreporter.write_line(f"{promise.id}: {status(promise, reports)}")
        terminalreporter.write_line(f"    {promise.sentence}")
        if shown:
            terminalreporter.write_line(f"    shown in this run: {one_line(shown)}")
        elif promise.id in before:
            terminalreporter.write_line(f"    shown in an earlier run: {one_line(before[promise.id])}")
    if record:
        merged = {promise.id: before.get(promise.id, {}) | figures.get(promise.id, {}) for promise in PROMISES}
        merged = {name: dict(sorted(tests.items())) for name, tests in merged.items() if tests}
        RECORDED.write_text(json.dumps(merged, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def measured_figures(reports: list[tuple[str, pytest.TestReport]]) -> Figures:
    """Return the figures of passed tests."""
    figures: Figures = {}
    for outcome, report in reports:
        if outcome == "passed" and report.when == "call":
            for promise, text in (value for name, value in report.user_properties if name == PROPERTY):
                cases = figures.setdefault(promise, {}).setdefault(report.nodeid.split("[")[0], {})
                cases[text] = cases.get(text, 0) + 1
    return figures


def status(promise: Promise, reports: list[tuple[str, pytest.TestReport]]) -> str:
    """Return what became of the tests in the files of a promise."""
    own = [(outcome, report) for outcome, report in reports if report.nodeid.split("::")[0] in promise.files]
    failed = sum(outcome in ("failed", "error", "xpassed") for outcome, _ in own)
    passed = sum(outcome in ("passed", "xfailed") for outcome, _ in own)
    skipped = [report for outcome, report in own if outcome == "skipped"]
    if failed:
        return f"FAILED ({failed} of {len(own)} tests)"
    if passed:
        return f"passed ({passed} {'test' if passed == 1 else 'tests'}{f', {len(skipped)} skipped' if skipped else ''})"
    return f"skipped ({skip_reason(skipped[0])})" if skipped else "not run"


def skip_reason(report: pytest.TestReport) -> str:
    """Return the reason of a skipped test."""
    text = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    return str(text).removeprefix("Skipped: ")
