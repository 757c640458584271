"""Draw what was measured on captures, and write it as an HTML page next to the noise profile."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unprocess_gen.calibration.calibrate import Calibration
from unprocess_gen.calibration.deviations import NORMAL_95
from unprocess_gen.calibration.iso_results import IsoResult
from unprocess_gen.calibration.profile import AGAINST_ISO, ENDS, estimates, site_names
from unprocess_gen.calibration.shape import probabilities
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import write_file
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.pages import PageTable, data_uri, render_page, require_libraries
from unprocess_gen.reports.pictures import figure_png, new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"R": "#c0392b", "Gr": "#27ae60", "Gb": "#145a32", "B": "#2c6fbb", "": "#444444"}
DPI, SIZE = 120, (4.6, 3.6)
"""Resolution, and width and height of a figure in inches."""


def check_page(page: Path) -> None:
    """Refuse, before any work, a file to which the page cannot be written."""
    if page.suffix.lower() != ".html":
        raise ConfigError(f"--report {page}: is no HTML file; expected a name that ends with .html")
    require_libraries(f"--report {page}")
    check_output_file(page, f"--report {page}", "an HTML page", b"<!doctype html")


def write_page(calibration: Calibration, name: str, command: str, page: Path) -> None:
    """Write the page of a calibration."""
    sites = site_names(calibration.captures.sensor)
    lines = []
    for entry in (entry for entry in estimates(calibration) if entry.site is None):
        ends = (short_number(getattr(entry.number, end, None), 4) for end in ENDS)
        lines.append([entry.name, f"{entry.iso:g}" if entry.iso else "", *ends, entry.unit])
    text = render_page(
        "calibration.html",
        title=f"Calibration of {name}",
        command=command,
        frames=len(calibration.captures.captures),
        notes=calibration.captures.notes,
        figures=[*_against_iso(calibration), *(_drawn(result, sites) for result in calibration.isos)],
        table=PageTable(("number", "ISO", "value", "from", "to", "unit"), lines, numeric=(1, 2, 3, 4)),
    )
    write_file(page, text)


# ------------------------------------------------------------------------------------------------------------- figures


Section = tuple[str, dict[str, str]]
"""Heading, and addresses of pictures by their titles."""


def _section(heading: str, drawn: Mapping[str, Figure]) -> Section:
    return heading, {name: data_uri(figure_png(figure, DPI)) for name, figure in drawn.items()}


def _drawn(result: IsoResult, sites: list[str]) -> Section:
    """The photon transfer curve with residuals, and the histogram of the darks, of one ISO."""
    figures, axes = zip(*(new_figure(*SIZE) for _ in range(3)), strict=True)
    _draw_transfer(axes[0], axes[1], result, sites)
    _draw_histogram(axes[2], result)
    return _section(
        f"ISO {result.iso:g}", dict(zip(("photon transfer", "residuals", "read noise"), figures, strict=True))
    )


def _draw_transfer(curve_axes: Axes, residual_axes: Axes, result: IsoResult, sites: list[str]) -> None:
    """Draw variance against signal, and what the line with the gain of the sensor leaves."""
    gain = result["dn_per_e"].value
    for name, curve in zip(sites or ["", "", "", ""], result.curves, strict=True):
        line = gain * curve.signal
        style: dict[str, Any] = {"fmt": "o", "markersize": 3, "color": COLOURS[name], "linewidth": 0.8}
        error = NORMAL_95 * np.hypot(curve.error, curve.dark_error)
        curve_axes.errorbar(curve.signal, curve.variance, error, label=name or None, **style)
        residual_axes.errorbar(curve.signal, (curve.variance / line - 1) * 100, error / line * 100, **style)
    ends = np.array([0.0, result.levels[-1].signal_dn])
    curve_axes.plot(ends, gain * ends, color="#888888", linewidth=1)
    residual_axes.axhline(0, color="#888888", linewidth=1)
    curve_axes.set(title="photon transfer", xlabel="signal (DN)", ylabel="variance above the darks (DN²)")
    residual_axes.set(title="residuals", xlabel="signal (DN)", ylabel="variance against the line (%)")
    if sites:
        curve_axes.legend()


def _draw_histogram(axes: Axes, result: IsoResult) -> None:
    """Draw the histogram of the darks against both fitted distributions."""
    histogram, shape = result.histogram, result.shape
    group = max(1, round(1 / histogram.width))  # a bin for each DN, because values are integers
    edges = np.arange(0, len(histogram.counts), group)
    counts, moments = (
        np.add.reduceat(values, edges) for values in (histogram.counts, histogram.counts * histogram.centres)
    )
    means = moments / np.maximum(counts, 1)
    shares = counts / counts.sum() / (group * histogram.width)
    axes.semilogy(means, np.maximum(shares, 1e-9), ".", markersize=4, color="#444444", label="darks")
    tukey = f"Tukey, λ {shape.shape:.3f}"
    for label, std, power in (("normal", shape.normal_std_dn, None), (tukey, shape.tukey_std_dn, shape.shape)):
        likelihoods = probabilities(histogram.centres, std, power)
        axes.semilogy(histogram.centres, np.maximum(likelihoods, 1e-9), linewidth=1, label=label)
    axes.set(title="read noise", xlabel="DN from the mean of the row", ylabel="share", ylim=(1e-8, 1))
    axes.legend()


def _against_iso(calibration: Calibration) -> Iterator[Section]:
    """Draw gain, read noise and row noise against ISO, with intervals, if there are several ISOs."""
    isos = calibration.captures.isos
    drawn: dict[str, Figure] = {}
    for name, label in AGAINST_ISO.items():
        drawn[label], axes = new_figure(*SIZE)
        values, lows, highs = (np.array([getattr(result[name], end) for result in calibration.isos]) for end in ENDS)
        errors = np.maximum([values - lows, highs - values], 0)
        axes.errorbar(isos, values, errors, fmt="o-", markersize=3)
        axes.set(xscale="log", xlabel="ISO", title=label)
        axes.set_xticks(isos, [f"{iso:g}" for iso in isos], rotation=90 if len(isos) > 8 else 0)
        axes.xaxis.set_minor_formatter("")
        axes.set_yscale("log", subs=(2, 5))
        axes.yaxis.set_major_formatter("{x:.3g}")
        axes.yaxis.set_minor_formatter("{x:.3g}")
    if len(isos) > 1:
        yield _section("Against ISO", drawn)
