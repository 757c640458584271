"""Write the report of a benchmark: ``accuracy.csv``, ``accuracy.png`` and ``accuracy.html``."""

from __future__ import annotations

from pathlib import Path

from unprocess_gen.reports.benchmark.figure import benchmark_figure
from unprocess_gen.reports.benchmark.measure import BenchmarkReport
from unprocess_gen.reports.benchmark.tables import HEADINGS, NUMERIC, csv_text, table_cells, text_table
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.report_files import write_files

__all__ = ["FILES", "benchmark_page", "text_table", "write_benchmark"]

FILES = ("accuracy.csv", "accuracy.png", "accuracy.html")


def write_benchmark(report: BenchmarkReport, out: Path) -> None:
    """Write the three files of a report, replacing those of an earlier one.

    Parameters
    ----------
    report : BenchmarkReport
        The measurements.
    out : Path
        Folder to write to.

    Raises
    ------
    MachineError
        If a file cannot be written.
    """
    picture = benchmark_figure(report.rows)
    contents = (csv_text(report.rows).encode(), picture, benchmark_page(report, picture).encode())
    write_files(out, dict(zip(FILES, contents, strict=True)))


NOTES = (
    "Errors of the stages curve, colour, mosaic and quantise: clean frame at 14 bits, in DN, with all other stages "
    "exact. Error of normal: in σ, against the exact quantile. Error of shot: the maximum is the largest difference of "
    "the distribution functions of shot plus read noise; the RMS is measured on photographs, in σ of shot and read "
    "noise. Error of effects: noisy frame at 14 bits without shot noise, in DN.",
    "End-to-end rows of the tiers: tier is the clean frame at 14 bits with two-parameter noise, tier_noisy its noisy "
    "frame in σ, tier_electrons the noisy frame of the physical profile in σ, and tier_own the clean frame of the "
    "given settings.",
    "Times of curve, colour and mosaic run from the codes to the end of the stage, because the kernels fuse these "
    "stages. Times of effects are the differences they make to a pair. The last column is the median of the ratios "
    "within a round. A dash means that the value was not measured separately.",
)


def benchmark_page(report: BenchmarkReport, picture: bytes) -> str:
    """Return ``accuracy.html``, one file that contains the figure."""
    stages = [None, *(row.stage for row in report.rows)]
    groups = [index for index, row in enumerate(report.rows) if row.stage != stages[index]]
    return render_page(
        "benchmark.html",
        title="Cost of accuracy",
        figure=data_uri(picture),
        measurements=PageTable(HEADINGS, list(map(table_cells, report.rows)), NUMERIC, groups),
        notes=NOTES,
        conditions=report.conditions,
    )
