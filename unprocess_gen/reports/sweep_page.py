"""Write the page of a sweep: a grid of its swept keys, with pictures of a pair and a link to the page of each dataset.

Datasets without a page of their own get one, so that all links lead somewhere.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from urllib.parse import quote

import numpy as np

from unprocess_gen.core.errors import UnprocessGenError
from unprocess_gen.core.files import write_file
from unprocess_gen.dataset.reader import RawPairs, mosaic_dn
from unprocess_gen.dataset.row import plan_from_row
from unprocess_gen.pipeline.progress import with_bar
from unprocess_gen.reports import panels
from unprocess_gen.reports.dataset_page import write_dataset_report
from unprocess_gen.reports.pages import data_uri, page_file, render_page
from unprocess_gen.reports.pictures import picture_jpeg

JPEG_QUALITY = 70


class SweepCell(NamedTuple):
    """A job of ``sweep.csv``, the address of its page and a picture, or the reason why it has none."""

    job: Mapping[str, str]
    link: str = ""
    picture: str = ""
    problem: str = ""


def write_sweep_page(
    folder: Path, jobs: Sequence[Mapping[str, str]], swept: Sequence[str], to: Path | None = None
) -> Path:
    """Write the page of a sweep from the rows of ``sweep.csv``; values of the last ``swept`` key are side by side."""
    file = page_file(folder, to)
    *down, across = swept or [""]
    rows: dict[tuple[str, ...], dict[str, SweepCell]] = {}
    windows: dict[tuple[int, ...], panels.Window] = {}
    for job in with_bar(jobs, "dataset", len(jobs)):
        row = rows.setdefault(tuple(job.get(key, "") for key in down), {})
        row[job.get(across, "")] = _sweep_cell(folder / job["folder"], job, file.parent, windows)
    values = list(dict.fromkeys(job.get(across, "") for job in jobs))
    title = f"Sweep {folder.absolute().name}"
    page = render_page("sweep.html", title=title, down=down, across=across, values=values, rows=rows, jobs=jobs)
    write_file(file, page)
    return file


def _sweep_cell(
    folder: Path, job: Mapping[str, str], start: Path, windows: dict[tuple[int, ...], panels.Window]
) -> SweepCell:
    """The finest detail of the first pair, clean and noisy, one pixel per site; the reason without a readable dataset.

    All frames of a size have one window, so that cells can be compared.
    """
    try:
        pairs, page = RawPairs(folder), page_file(folder)
        frames = [
            panels.common_stretch(mosaic_dn(dn, row), plan_from_row(row)) for *pair, row in pairs[:1] for dn in pair
        ]
        if not page.exists():
            write_dataset_report(folder)
    except (UnprocessGenError, OSError) as error:
        return SweepCell(job, problem=str(error))
    for clean in frames[:1]:
        planes = panels.average_planes(clean, (clean.shape[0] // 2, clean.shape[1] // 2))
        place = [2 * at for at in panels.finest_detail(planes, (panels.CELL_PX[0] // 2, panels.CELL_PX[1] // 2))]
        windows.setdefault(clean.shape, panels.detail_window(clean.shape, panels.CELL_PX, place))
    details = [frame[windows[frame.shape]] for frame in frames]
    picture = data_uri(picture_jpeg(panels.byte_codes(np.hstack(details)), JPEG_QUALITY), "jpeg") if details else ""
    return SweepCell(job, quote(os.path.relpath(page, start)), picture)
