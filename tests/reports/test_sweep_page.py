"""Tests of the page of a sweep."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from urllib.parse import unquote

from helpers.commands import RunMain


def test_page_has_a_cell_for_each_job(run_main: RunMain, tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    swept = ("gains.red=2,2.2", "noise=imx385_iso3200,imx385_iso25600")
    assert run_main("-m", *swept, "source.limit=1", "source.downscale=8", "n_jobs=1", f"out={sweep}", "-q").code == 0
    shutil.rmtree(next(sweep.glob("*iso3200*")))
    assert run_main("report", str(sweep), "-q").code == 0
    page = (sweep / "report.html").read_text(encoding="utf-8")
    assert page.count('class="job"') == 4 and page.count("<img ") == 3
    assert page.count("exit code 0; ") == 1
    links = re.findall(r'href="([^"]+)"', page)
    assert len(links) == 3 and not re.search(r'(src|href)="https?:', page)
    assert all((sweep / unquote(link)).is_file() for link in links)
