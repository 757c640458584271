"""Measure the cost of accuracy and update its pages: python .readme/draw_accuracy.py [overrides].

Run `gen-dataset accuracy` with the overrides (source.root=photos). Save its figure as accuracy.png in this folder, and
its conclusion and tables between the marks in docs/accuracy.md (errors) and docs/performance.md (times). It takes some
minutes; stop other programs meanwhile.
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
from unprocess_gen.reports.benchmark.report import METHOD_COLUMNS, RECOMMENDATIONS, RUN_COLUMNS, table
from unprocess_gen.reports.html_pages import PageTable

HERE = Path(__file__).parent
ERRORS, TIMES = (HERE.parent / "docs" / name for name in ("accuracy.md", "performance.md"))
CONCLUSION = re.compile(r"^In a complete run of .*?(?=\n\n)", re.MULTILINE | re.DOTALL)
TEXTS = ("stage", "method", "tier", "error_unit", "setting", "noise")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the lines of a CSV file of the report, with numbers as numbers and empty values as None."""
    with path.open(newline="", encoding="utf-8") as lines:
        return [
            {name: text if name in TEXTS else float(text) if text else None for name, text in line.items()}
            for line in csv.DictReader(lines)
        ]


def markdown(table: PageTable, left_out: tuple[str, ...] = ()) -> str:
    """Return a table in Markdown without some of its columns."""
    kept = [index for index, heading in enumerate(table.headings) if heading not in left_out]
    rule = "|".join("--:" if index in table.numeric else "---" for index in kept)
    lines = [f"| {' | '.join(line[index] for index in kept)} |" for line in (table.headings, *table.lines)]
    return "\n".join([lines[0], f"|{rule}|", *lines[1:]])


def replace_part(path: Path, name: str, content: str) -> None:
    """Replace the content between the marks of a part of a page."""
    part = re.compile(rf"(<!-- accuracy {name}: [^>]*-->\n).*?(<!-- end of accuracy {name} -->)", re.DOTALL)
    changed, count = part.subn(lambda found: f"{found[1]}{content}\n{found[2]}", path.read_text(encoding="utf-8"))
    assert count == 1, f"{path} has no part {name}"
    path.write_text(changed, encoding="utf-8")


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
    times = ("of exact", "ns per pixel", "decode", "simulate", "write")
    errors = ("noise", "changed", "max DN", "RMS DN", "max σ", "RMS σ")
    replace_part(TIMES, "conclusion", conclusion[0])
    replace_part(TIMES, "runs", markdown(table(RUN_COLUMNS, runs), errors))
    replace_part(ERRORS, "recommendations", markdown(RECOMMENDATIONS))
    with_errors = [run for run in runs if run.noisy_changed_share]
    replace_part(ERRORS, "runs", markdown(table(RUN_COLUMNS, with_errors), times))
    inexact = [method for method in methods if method.error_max]
    replace_part(ERRORS, "methods", markdown(table(METHOD_COLUMNS, inexact), ("ns per pixel", "of reference")))


if __name__ == "__main__":
    main()
