"""Measure the cost of accuracy and update docs/accuracy.md: python .readme/draw_accuracy.py [overrides].

Run `gen-dataset accuracy` with the overrides (source.root=photos). Save its figure as accuracy.png in this folder, and
its conclusion and tables between the marks in docs/accuracy.md. It takes about a minute; stop other programs meanwhile.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from unprocess_gen.reports.benchmark.complete_runs import RunMeasurement
from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.benchmark.tables import markdown_table, method_table, recommendation_table, run_table

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "accuracy.md"
CONCLUSION = re.compile(r"^In a complete run of .*?(?=\n\n)", re.MULTILINE | re.DOTALL)
TEXTS = ("stage", "method", "tier", "error_unit", "setting", "noise")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a CSV file of the report, with numbers as numbers and empty values as None."""
    with path.open(newline="", encoding="utf-8") as lines:
        return [
            {name: text if name in TEXTS else float(text) if text else None for name, text in line.items()}
            for line in csv.DictReader(lines)
        ]


def replace_part(page: str, name: str, content: str) -> str:
    """Return the page with other content between the marks of a part."""
    part = re.compile(rf"(<!-- accuracy {name}: [^>]*-->\n).*?(<!-- end of accuracy {name} -->)", re.DOTALL)
    changed, count = part.subn(lambda found: f"{found[1]}{content}\n{found[2]}", page)
    assert count == 1, f"{PAGE} has no part {name}"
    return changed


def main() -> None:
    """Measure, then replace conclusion, tables and figure."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "unprocess_gen", "accuracy", *sys.argv[1:], f"out={folder}/report"]
        printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
        report = Path(folder) / "report"
        shutil.copy(report / "accuracy.png", HERE / "accuracy.png")
        methods = [Measurement(**row) for row in read_rows(report / "accuracy.csv")]
        runs = [RunMeasurement(**row) for row in read_rows(report / "accuracy_runs.csv")]
    conclusion = CONCLUSION.search(printed)
    assert conclusion is not None
    page = PAGE.read_text(encoding="utf-8")
    for name, content in (
        ("conclusion", conclusion[0]),
        ("runs", markdown_table(run_table(runs))),
        ("recommendations", markdown_table(recommendation_table())),
        ("methods", markdown_table(method_table(methods))),
    ):
        page = replace_part(page, name, content)
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
