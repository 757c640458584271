"""Every promise has tests that exist and report a figure, and the plugin shows what they reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.promises import BY_ID, PROMISES, ROOT, one_line, reporting_files

pytest_plugins = ["pytester"]


def test_identifiers_are_unique() -> None:
    assert len(BY_ID) == len(PROMISES)


def test_files_of_every_promise_exist() -> None:
    assert [(promise.id, name) for promise in PROMISES for name in promise.files if not (ROOT / name).is_file()] == []


def test_every_promise_has_a_test_that_reports_a_figure() -> None:
    reporting = reporting_files()
    assert [promise.id for promise in PROMISES if not reporting[promise.id] & set(promise.files)] == []


def test_every_reported_promise_exists() -> None:
    assert set(reporting_files()) == set(BY_ID)


EXAMPLES = {
    "tests/pipeline/test_generate.py": """
def test_passes(figure):
    figure("workers", "3 of 3 runs")
""",
    "tests/pipeline/test_verify.py": """
def test_fails(figure):
    figure("verify", "never shown")
    assert False
""",
    "tests/sources/video/test_decode.py": """
import pytest

@pytest.mark.skip(reason="no camera here")
def test_is_skipped(figure):
    figure("video", "never shown")
""",
}


def test_table_shows_figures_failures_and_reasons(pytester: pytest.Pytester) -> None:
    pytester.makeini(f"[pytest]\npythonpath = {ROOT / 'tests'}")
    pytester.makeconftest('pytest_plugins = ["helpers.promise_report"]')
    for name, text in EXAMPLES.items():
        path = Path(pytester.path, name)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    result = pytester.runpytest_inprocess("--promises", "-p", "no:cacheprovider")
    result.stdout.fnmatch_lines(
        [
            "workers: passed (1 test)",
            "    shown in this run: 3 of 3 runs",
            "video: skipped (no camera here)",
            "verify: FAILED (1 of 1 tests)",
            "repair: not run",
        ]
    )
    assert "never shown" not in result.stdout.str().split(" promises ")[1]


def test_counts_of_cases_are_added_and_other_numbers_become_ranges() -> None:
    figures = {
        "tests/test_a.py::test_b": {"3 of 4 files": 2, "1,000 of 1,000 files": 1, "0.5 codes": 1, "0.25 codes": 1}
    }
    assert one_line(figures) == "1,006 of 1,008 files (3 cases); 0.25 to 0.5 codes (2 cases)"
