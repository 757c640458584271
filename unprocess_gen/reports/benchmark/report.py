"""Write the report of a benchmark: ``accuracy.csv``, ``accuracy_runs.csv``, ``accuracy.png`` and ``accuracy.html``."""

from __future__ import annotations

import textwrap
from pathlib import Path

from unprocess_gen.reports.benchmark.figure import benchmark_figure
from unprocess_gen.reports.benchmark.measure import BenchmarkReport
from unprocess_gen.reports.benchmark.tables import (
    csv_text,
    method_table,
    recommendation_table,
    run_table,
    runs_csv_text,
    text_table,
)
from unprocess_gen.reports.html_pages import data_uri, render_page
from unprocess_gen.reports.report_files import write_files

__all__ = ["FILES", "benchmark_page", "report_text", "write_benchmark"]

COLUMNS = 120
"""Width of printed sentences."""

FILES = ("accuracy.csv", "accuracy_runs.csv", "accuracy.png", "accuracy.html")


def report_text(report: BenchmarkReport) -> str:
    """Return what the verb prints: methods, complete runs, the conclusion, and the recommended tiers.

    Parameters
    ----------
    report : BenchmarkReport
        The measurements.

    Returns
    -------
    str
        Several lines without a final newline.
    """
    return "\n".join(
        [
            text_table(method_table(report.rows)),
            "",
            "complete runs, from files to committed shards: processor time and its shares; errors of the noisy frames",
            text_table(run_table(report.runs)),
            "",
            textwrap.fill(report.conclusion, COLUMNS, break_on_hyphens=False),
            "",
            "recommended tiers",
            *(_recommended(*line) for line in recommendation_table().lines),
        ]
    )


def _recommended(use: str, tier: str, reason: str) -> str:
    text = f"{use}: {tier}; {reason}"
    return textwrap.fill(text, COLUMNS, initial_indent="  ", subsequent_indent="    ", break_on_hyphens=False)


def write_benchmark(report: BenchmarkReport, out: Path) -> None:
    """Write the files of a report, replacing those of an earlier one.

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
    picture = benchmark_figure(report.rows, report.runs)
    texts = (csv_text(report.rows), runs_csv_text(report.runs))
    contents = (*(text.encode() for text in texts), picture, benchmark_page(report, picture).encode())
    write_files(out, dict(zip(FILES, contents, strict=True)))


NOTES = (
    "Errors of the stages curve, colour, mosaic and quantise: clean frame at 14 bits, in DN, with all other stages "
    "exact. Error of normal: in σ, against the exact quantile. Error of shot: the maximum is the largest difference of "
    "the distribution functions of shot plus read noise; the RMS is measured on photographs, in σ of shot and read "
    "noise. Error of effects: noisy frame at 14 bits without shot noise, in DN.",
    "End-to-end rows of the tiers: tier is the clean frame at 14 bits with two-parameter noise, tier_noisy its noisy "
    "frame in σ, tier_electrons the noisy frame of the physical profile in σ, and tier_own the clean frame of the "
    "given settings. The noisy frame of the given settings is in the table of complete runs.",
    "Times of curve, colour and mosaic run from the codes to the end of the stage, because the kernels fuse these "
    "stages. Times of effects are the differences they make to a pair. The last column is the median of the ratios "
    "within a round. A dash means that the value was not measured separately.",
)

RUN_NOTES = (
    "A run reads files and commits shards with one worker. Time is processor time of all threads; of exact is its "
    "ratio to the exact tier. Decode, simulate and write are shares of the run; write includes hashing and committing.",
    "Errors are those of the noisy frames against the reference, which uses the same uniform random numbers: the share "
    "of sites that differ, and the largest and RMS error in DN and in standard deviations (σ) of shot, read and "
    "rounding noise. The settings given are those of the command, whose clean frames are the stage tier_own below.",
)


def benchmark_page(report: BenchmarkReport, picture: bytes) -> str:
    """Return ``accuracy.html``, one file that contains the figure."""
    return render_page(
        "benchmark.html",
        title="Cost of accuracy",
        figure=data_uri(picture),
        conclusion=report.conclusion,
        runs=run_table(report.runs),
        recommendations=recommendation_table(),
        measurements=method_table(report.rows),
        run_notes=RUN_NOTES,
        notes=NOTES,
        conditions=report.conditions,
    )
