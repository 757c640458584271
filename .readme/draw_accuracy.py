"""Measure the cost of accuracy and update its pages: python .readme/draw_accuracy.py [overrides].

Run `gen-dataset accuracy` with the overrides (source.root=photos), and with a physical profile by day and by night.
Save the figure of the first as accuracy.png in this folder, its errors in docs/accuracy.md, and the times of all in
docs/performance.md, between the marks. It takes some minutes; stop other programs meanwhile.
"""

from __future__ import annotations

import csv
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from unprocess_gen.reports.accuracy_page import accuracy_table
from unprocess_gen.reports.tier_costs import STAGES, Measurement

HERE = Path(__file__).parent
ERRORS, TIMES = (HERE.parent / "docs" / name for name in ("accuracy.md", "performance.md"))
CONCLUSION = re.compile(r"^In a complete run of .*?\.$", re.MULTILINE | re.DOTALL)
RUNS: dict[str, tuple[str, ...]] = {
    "default": (),
    "`sony_a7s2`, daylight": ("noise=sony_a7s2", "scene=daylight"),
    "`sony_a7s2`, night": ("noise=sony_a7s2", "scene=night"),
}
"""Overrides of each run by the name of its noise."""


def measure(overrides: Sequence[str], out: Path) -> tuple[str, list[Measurement]]:
    """Run the command; return its conclusion and the rows of its table."""
    command = [sys.executable, "-m", "unprocess_gen", "accuracy", *overrides, f"out={out}"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    conclusion = CONCLUSION.search(printed)
    assert conclusion is not None
    with (out / "accuracy.csv").open(newline="", encoding="utf-8") as lines:
        rows = [list(line.values()) for line in csv.DictReader(lines)]
    numbers = [[None if text == "" else float(text) for text in row[2:]] for row in rows]
    return conclusion[0], [Measurement(*row[:2], *of_row) for row, of_row in zip(rows, numbers, strict=True)]


def errors_table(rows: Sequence[Measurement]) -> str:
    """Return the errors of the tier fast as a table in Markdown."""
    table = accuracy_table([row for row in rows if row.tier == "fast" and row.stage in ("clean", "noise")])
    lines = ["| frame | " + " | ".join(table.headings[4:]) + " |", "|---|" + "--:|" * 5]
    frames = zip(("clean", "noisy"), table.lines, strict=True)
    return "\n".join([*lines, *(f"| {frame} | {' | '.join(line[4:])} |" for frame, line in frames)])


def times_table(runs: dict[str, list[Measurement]]) -> str:
    """Return the times of all tiers as a table in Markdown, with the stages side by side."""
    lines = [f"| noise | tier | of exact | {' | '.join(STAGES)} |", "|---|---|" + "--:|" * (1 + len(STAGES))]
    for name, rows in runs.items():
        cells = list(accuracy_table(rows).lines)
        for first in range(0, len(cells), len(STAGES)):
            stages = cells[first : first + len(STAGES)]
            lines.append(f"| {name} | {stages[0][0]} | {stages[-1][3]} | {' | '.join(line[2] for line in stages)} |")
    return "\n".join(lines)


def replace_part(path: Path, name: str, content: str) -> None:
    """Replace the content between the marks of a part of a page."""
    part = re.compile(rf"(<!-- accuracy {name}: [^>]*-->\n).*?(<!-- end of accuracy {name} -->)", re.DOTALL)
    changed, count = part.subn(lambda found: f"{found[1]}{content}\n{found[2]}", path.read_text(encoding="utf-8"))
    assert count == 1, f"{path} has no part {name}"
    path.write_text(changed, encoding="utf-8")


def main() -> None:
    """Measure, then replace conclusion, tables and figure."""
    with tempfile.TemporaryDirectory() as folder:
        measured = {
            name: measure((*sys.argv[1:], *overrides), Path(folder) / str(number))
            for number, (name, overrides) in enumerate(RUNS.items())
        }
        shutil.copy(Path(folder) / "0" / "accuracy.png", HERE / "accuracy.png")
    replace_part(TIMES, "conclusion", measured["default"][0])
    replace_part(TIMES, "times", times_table({name: rows for name, (_, rows) in measured.items()}))
    replace_part(ERRORS, "errors", errors_table(measured["default"][1]))


if __name__ == "__main__":
    main()
