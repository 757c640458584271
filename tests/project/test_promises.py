"""Every promise has tests that exist and report a figure, and the plugin shows what they reported."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers.promises import PAGE, PROMISES, ROOT, reporting_files

pytest_plugins = ["pytester"]


def test_every_line_of_the_table_is_a_promise() -> None:
    rows = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
    assert len(PROMISES) == len(rows) >= 30


def test_files_of_every_promise_exist_and_report_a_figure() -> None:
    reporting = reporting_files()
    assert set(reporting) == set(PROMISES)
    for promise in PROMISES.values():
        assert [name for name in promise.files if not (ROOT / name).is_file()] == []
        assert reporting[promise.name] & set(promise.files), promise.name


def test_list_shows_figures_failures_and_skipped_tests(pytester: pytest.Pytester) -> None:
    pytester.makeini(f"[pytest]\npythonpath = {ROOT / 'tests'}")
    pytester.makeconftest('pytest_plugins = ["helpers.promise_report"]')
    for promise, lines in {"workers": "", "verify": "    assert False\n", "patches": "    pytest.skip()\n"}.items():
        path = Path(pytester.path, PROMISES[promise].files[0])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'import pytest\n\n\ndef test_it(figure):\n    figure("{promise}", "3 of 3")\n{lines}')

    lines = pytester.runpytest_inprocess("--promises", "-p", "no:cacheprovider").stdout

    lines.fnmatch_lines(
        ["workers: 1 passed: *", "    3 of 3", "patches: 1 skipped: *", "verify: 1 failed: *", "repair: not run: *"]
    )
    assert lines.str().count("    3 of 3") == 1
