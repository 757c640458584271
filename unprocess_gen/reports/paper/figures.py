"""Draw Figures 2 to 7 of the article from a photograph: ``fig2.png`` … ``fig7.png`` and a page with captions.

The figures are computed with the code that makes datasets. Captions give the numbers of the photograph, and differences
from the article's text. Raw frames are grey, from the lowest DN (black) to the highest (white), as in the article. The
article's photographs are not published, so its claims are checked on other photographs: those of Figure 6 on up to
`PHOTOGRAPHS_COUNTED`.

Figure 6 of the article has two interpretations (`paper.sources.INTERPRETATIONS`). The formula divides by g_rgb, so the
largest g_rgb gives the darkest raw frame. The caption describes the most saturation for the largest g_rgb, which
multiplication by g_rgb gives.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from unprocess_gen.config.schema import Config
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.sequences import evenly_spaced
from unprocess_gen.reports.html_pages import PageTable, render_page
from unprocess_gen.reports.paper.curves import draw_gamma, draw_highlight_function, draw_tone
from unprocess_gen.reports.paper.pictures import PaperFigure
from unprocess_gen.reports.paper.raw_frames import draw_default_raw, draw_highlights, draw_saturation
from unprocess_gen.reports.paper.sources import (
    AUTHORS_NOISE,
    GAINS,
    PaperOptions,
    count_saturation,
    load_figure_source,
)
from unprocess_gen.reports.report_files import write_files
from unprocess_gen.sources.loader import list_photographs

__all__ = ["AUTHORS_NOISE", "GAINS", "PaperFigure", "PaperOptions", "draw_figures", "write_figures"]

PAGE = "figures.html"
PHOTOGRAPHS_COUNTED = 40
"""Largest number of photographs, evenly spaced, whose saturated sites are counted."""


def draw_figures(config: Config, options: PaperOptions) -> list[PaperFigure]:
    """Draw all figures for the first readable photograph of the source.

    Parameters
    ----------
    config : Config
        Validated config; source, camera, sensor and seed are used.
    options : PaperOptions
        Gains and noise profile that the article fixes.

    Returns
    -------
    list of PaperFigure
        Figures 2 to 7.

    Raises
    ------
    ConfigError
        If no photograph can be read, or ``source.patch`` is set.
    """
    if config.source.patch is not None:
        raise ConfigError(
            f"source.patch={config.source.patch}: the figures show complete photographs; expected null; leave it out"
        )
    sources = list_photographs(config.source).sources
    source = load_figure_source(config, options, sources)
    counts = count_saturation(config, options, evenly_spaced(sources, PHOTOGRAPHS_COUNTED))
    return [
        draw_tone(source),
        draw_gamma(source),
        draw_highlight_function(source),
        draw_default_raw(source),
        draw_saturation(source, counts),
        draw_highlights(source),
    ]


def write_figures(figures: Sequence[PaperFigure], out: Path, command: str) -> list[str]:
    """Write the figures and their page.

    Parameters
    ----------
    figures : sequence of PaperFigure
        The figures.
    out : Path
        Folder to write to.
    command : str
        The command line, which the page quotes.

    Returns
    -------
    list of str
        Names of the files.

    Raises
    ------
    MachineError
        If a file cannot be written.
    """
    contents = {**{figure.file: figure.png for figure in figures}, PAGE: figures_page(figures, command).encode()}
    write_files(out, contents)
    return list(contents)


def figures_page(figures: Sequence[PaperFigure], command: str) -> str:
    """Return the page of all figures with captions; it refers to the PNG files next to it."""
    return render_page(
        "paper_figures.html",
        title="Figures of the article",
        command=command,
        figures=[
            {
                "title": figure.title,
                "file": figure.file,
                "caption": figure.caption,
                "table": PageTable(figure.table[0], figure.table[1:], range(1, len(figure.table[0])))
                if figure.table
                else None,
            }
            for figure in figures
        ],
    )
