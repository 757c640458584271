"""Read the project's promises and their tests from docs/evidence.md.

A test reports the number that it measured with the fixture ``figure`` (`promise_report`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "evidence.md"


class Promise(NamedTuple):
    """Hold one promise: its name, the sentence, and the files of its tests."""

    name: str
    sentence: str
    files: tuple[str, ...]


def read_promises(page: str) -> dict[str, Promise]:
    """Return the promises of the page's table by name."""
    rows = re.findall(r"^\| `([\w-]+)` \| (.+?) \| (?:.+?) \| (.+) \|$", page, re.MULTILINE)
    return {name: Promise(name, text, tuple(re.findall(r"tests/[\w/.]+", tests))) for name, text, tests in rows}


PROMISES = read_promises(PAGE.read_text(encoding="utf-8"))


def reporting_files() -> dict[str, set[str]]:
    """Return for each promise the test files that contain a call of ``figure`` for it."""
    reporting: dict[str, set[str]] = {name: set() for name in PROMISES}
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for name in re.findall(r'\bfigure\(\s*"([a-z0-9-]+)"', path.read_text(encoding="utf-8")):
            reporting.setdefault(name, set()).add(path.relative_to(ROOT).as_posix())
    return reporting
