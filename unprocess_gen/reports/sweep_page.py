"""Write the page of a sweep: a grid of its swept keys, with pictures, noise, time and bytes of each dataset.

The page is one file without scripts. Datasets without a page of their own get one, so that all links lead somewhere.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from unprocess_gen.core.errors import UnprocessGenError
from unprocess_gen.core.types import Float
from unprocess_gen.dataset.manifest import plan_from_row
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.training import noise_std
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.pipeline.targets import noise_law
from unprocess_gen.pipeline.workspace import REPORT
from unprocess_gen.reports.dataset_page.page import write_dataset_report
from unprocess_gen.reports.encoding import picture_jpeg
from unprocess_gen.reports.formatting import byte_size, counted
from unprocess_gen.reports.html_pages import data_uri, render_page
from unprocess_gen.reports.report_files import check_page_file, require_libraries, write_files
from unprocess_gen.reports.sheets import panels
from unprocess_gen.reports.sheets.contact_sheet import common_stretch, develop_detail

JPEG_QUALITY = 70
COLUMNS_ACROSS = 5
"""Values of the key across the table, if one has as many: they fit a window of 1200 pixels."""
CURVE_LEVELS = 64
CURVE_PX = (120, 48)
"""Width and height of the curve of the noise."""

Table = Sequence[Mapping[str, str]]


class SweepCell(NamedTuple):
    """Folder and link of a job, pictures and their captions, the curve of its noise in DN, and lines of text."""

    folder: str
    link: str
    pictures: tuple[tuple[str, str], ...]
    std_dn: Float
    lines: tuple[str, ...]


def write_sweep_page(folder: Path, jobs: Table, swept: Sequence[str], to: Path | None = None) -> Path:
    """Write the page of a sweep, whose ``sweep.csv`` has the rows ``jobs`` and a column for each key in ``swept``.

    ``report.html`` in the folder, unless ``to`` names another file. ConfigError if a library is missing or the file may
    not be written; MachineError if that fails.
    """
    require_libraries("report")
    file = folder / REPORT if to is None else to
    if to is not None:
        check_page_file(to, f"--to {to}")
    cells = {job["folder"]: _job_cell(folder, job, file.parent) for job in with_bar(jobs, "dataset", len(jobs))}
    highest_dn = max((float(cell.std_dn.max(initial=0)) for cell in cells.values()), default=0.0)
    counts = {key: len({job.get(key, "") for job in jobs}) for key in swept}
    across = min(swept, key=lambda key: abs(counts[key] - COLUMNS_ACROSS), default="") if len(swept) > 1 else ""
    down = [key for key in swept if key != across]
    content = render_page(
        "sweep.html",
        title=f"Sweep {folder.absolute().name}",
        across=across,
        down=down,
        columns=list(dict.fromkeys(job.get(across, "") for job in jobs)) if across else [],
        rows=_grid_rows(jobs, across, down, cells),
        curve=lambda cell: _curve_points(cell.std_dn, highest_dn),
        highest_dn=highest_dn,
        jobs=len(jobs),
        finished=sum(bool(cell.pictures) for cell in cells.values()),
        size=CURVE_PX,
    )
    write_files(file.parent, {file.name: content.encode()})
    return file


def _grid_rows(
    jobs: Table, across: str, down: Sequence[str], cells: Mapping[str, SweepCell]
) -> list[tuple[list[str], dict[str, list[SweepCell]]]]:
    """Group the cells by the values of the keys ``down``, then of the key ``across``, as in the table of the sweep."""
    rows: dict[tuple[str, ...], dict[str, list[SweepCell]]] = {}
    for job in jobs:
        row = rows.setdefault(tuple(job.get(key, "") for key in down), {})
        row.setdefault(job.get(across, ""), []).append(cells[job["folder"]])
    return [(list(values), row) for values, row in rows.items()]


def _job_cell(sweep: Path, job: Mapping[str, str], start: Path) -> SweepCell:
    """Describe a job; one without a readable dataset has no pictures, and the reason in its lines."""
    name = job["folder"]
    folder = sweep / name
    link = quote(os.path.relpath(folder / REPORT, start))
    try:
        pictures, std_dn = _pictures(folder)
        if not (folder / REPORT).exists():
            write_dataset_report(folder)
    except (UnprocessGenError, OSError) as error:
        reason = f"exit code {job.get('exit') or 'unknown'}; {error}" if job.get("exit") != "0" else str(error)
        return SweepCell(name, "", (), np.zeros(0), (reason,))
    share = job.get("saturated_share")
    lines = (
        f"saturated {float(share):.3%}" if share else "saturated: not known",
        f"{counted(int(job.get('rows') or 0), 'row')}, {job.get('failed') or 0} failed",
        f"{float(job.get('seconds') or 0):.1f} s, {byte_size(int(job.get('bytes') or 0))}",
    )
    return SweepCell(name, link, pictures, std_dn, lines)


def _pictures(folder: Path) -> tuple[tuple[tuple[str, str], ...], Float]:
    """Draw the centre of the first pair, one pixel per site, and compute its noise by signal; none without a pair."""
    pairs = RawPairs(folder)
    if not len(pairs):
        return (), np.zeros(0)
    clean, noisy, row = pairs[0]
    plan, frames = plan_from_row(row), [mosaic_dn(frame, row) for frame in (clean, noisy)]
    window = panels.detail_window(frames[0].shape, panels.STRIP_PX)
    raw = [common_stretch(frame[window], plan) for frame in frames]
    drawn = {"clean raw": raw[0], "noisy raw": raw[1], "noisy, developed": develop_detail(frames[1], plan, window)}
    signal_dn = np.linspace(plan.sensor.black_level_dn, plan.sensor.white_level_dn, CURVE_LEVELS)
    std_dn = noise_std(signal_dn, noise_law(plan)).astype(np.float64)
    pictures = (
        (title, data_uri(picture_jpeg(panels.byte_codes(picture), JPEG_QUALITY), "jpeg"))
        for title, picture in drawn.items()
        if picture is not None
    )
    return tuple(pictures), std_dn


def _curve_points(std_dn: Float, highest_dn: float) -> str:
    """Return the points of an SVG polyline."""
    width, height = CURVE_PX
    x = np.linspace(0, width, len(std_dn))
    y = height - std_dn / (highest_dn or 1) * (height - 2) - 1
    return " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
