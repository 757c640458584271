"""Measure the cost of accuracy and update docs/accuracy.md: python .readme/draw_accuracy.py [overrides].

Run `gen-dataset accuracy` with the overrides (source.root=photos). Save its figure as accuracy.png in this folder, and
its table between the two marks in docs/accuracy.md. It takes about a minute; stop other programs meanwhile.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from unprocess_gen.reports.benchmark.measure import Measurement
from unprocess_gen.reports.benchmark.tables import markdown_table

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "accuracy.md"
TABLE = re.compile(r"(<!-- accuracy: [^>]*-->\n).*?(<!-- end of accuracy -->)", re.DOTALL)
TEXTS = ("stage", "method", "tier", "error_unit")


def read_measurement(line: dict[str, str]) -> Measurement:
    """Return the measurement of a line of accuracy.csv."""
    return Measurement(
        **{name: text if name in TEXTS else float(text) if text else None for name, text in line.items()}
    )


def main() -> None:
    """Measure, then replace table and figure."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "unprocess_gen", "accuracy", *sys.argv[1:], f"out={folder}/report"]
        subprocess.run(command, check=True)
        report = Path(folder) / "report"
        shutil.copy(report / "accuracy.png", HERE / "accuracy.png")
        with (report / "accuracy.csv").open(newline="", encoding="utf-8") as lines:
            table = markdown_table([read_measurement(line) for line in csv.DictReader(lines)])
    text = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(TABLE.sub(lambda found: found[1] + table + "\n" + found[2], text), encoding="utf-8")


if __name__ == "__main__":
    main()
