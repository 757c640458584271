"""The page of hard cases contains the figures that its script measures, and names tests that exist."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import hard_cases  # noqa: E402

PAGE = hard_cases.PAGE.read_text(encoding="utf-8")
NAMED = re.findall(r"`(tests/[\w/]+\.py)`", PAGE)


def changed(cases: list[hard_cases.Case]) -> list[str]:
    """Return the measured rows that are not in the page."""
    return [row for row in map(hard_cases.row, cases) if row not in PAGE]


def test_exact_figures_of_the_page_are_measured_again() -> None:
    assert changed([one for one in hard_cases.CASES if one.is_exact]) == []


def test_tables_of_the_page_contain_every_case() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("| ") and not line.startswith("| quantity ")]
    assert sorted(row.split(" | ")[0] for row in rows) == sorted(f"| {one.quantity}" for one in hard_cases.CASES)


@pytest.mark.slow
def test_figures_that_depend_on_libraries_are_near_those_of_the_page() -> None:
    """Another library may change the last digits of an error, so a factor of four is allowed."""
    for one in hard_cases.CASES:
        if not one.is_exact:
            (line,) = [line for line in PAGE.splitlines() if line.startswith(f"| {one.quantity} |")]
            before = [float(cell.rsplit(": ", 1)[1]) for cell in line.strip("| ").split(" | ")[1:]]
            for old, new in zip(before, one.measure(), strict=True):
                assert new is not None and abs(new) <= 4 * abs(old), one.quantity


def test_modules_named_in_the_page_exist() -> None:
    assert len(NAMED) >= 15
    assert [path for path in NAMED if not (ROOT / path).is_file()] == []
