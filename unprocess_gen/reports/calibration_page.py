"""Draw what was measured on captures, and write it as an HTML page next to the noise profile."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from unprocess_gen.calibration.iso_laws import gain_law, std_law
from unprocess_gen.calibration.measure import IsoResult, usable
from unprocess_gen.calibration.profile import ENDS, Calibration, NamedNumber, estimates, iso_branches, site_names
from unprocess_gen.calibration.shape import probabilities
from unprocess_gen.config.option_files import conf_dir, group_options
from unprocess_gen.config.serialization import read_option
from unprocess_gen.core.errors import ConfigError
from unprocess_gen.core.files import machine_errors
from unprocess_gen.core.output_paths import check_output_file
from unprocess_gen.core.types import Float
from unprocess_gen.planning.noise_profile import evaluate
from unprocess_gen.reports.encoding import figure_png
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.report_files import require_libraries
from unprocess_gen.statistics.scores import NORMAL_95

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {"R": "#c0392b", "Gr": "#27ae60", "Gb": "#145a32", "B": "#2c6fbb", "": "#444444"}
DPI = 90


def check_page(page: Path) -> None:
    """Refuse, before any work, a file to which the page cannot be written."""
    if page.suffix.lower() != ".html":
        raise ConfigError(f"--report {page}: is no HTML file; expected a name that ends with .html")
    require_libraries(f"--report {page}")
    check_output_file(page, f"--report {page}", "an HTML page", b"<!doctype html")


def write_page(calibration: Calibration, name: str, command: str, page: Path) -> None:
    """Write the page of a calibration."""
    sites = site_names(calibration.sensor)
    figures = [(f"ISO {result.iso:g}", data_uri(_drawn(result, sites), "png")) for result in calibration.isos]
    text = render_page(
        "calibration.html",
        title=f"Calibration of {name}",
        command=command,
        frames=len(calibration.captures.captures),
        notes=calibration.notes,
        figures=figures,
        against_iso=data_uri(_against_iso(calibration)) if len(calibration.isos) > 1 else "",
        table=_table(estimates(calibration)),
        sensors=_sensors(calibration, name),
    )
    with machine_errors(page):
        page.write_text(text, encoding="utf-8")


def _table(named: list[NamedNumber]) -> PageTable:
    """Return the estimates of all sites together as a table."""
    lines = []
    for entry in (entry for entry in named if entry.site is None):
        ends = [short_number(getattr(entry.number, end), 4) if entry.number else "–" for end in ENDS]
        lines.append((entry.name, f"{entry.iso:g}" if entry.iso else "", *ends, entry.unit))
    return PageTable(("number", "ISO", "value", "from", "to", "unit"), lines, numeric=(1, 2, 3, 4))


def _sensors(calibration: Calibration, name: str) -> PageTable:
    """Return gain and read noise of this sensor and of the built-in profiles, in electrons."""
    span_dn, lines = calibration.sensor.span_dn, []
    for result in calibration.isos:
        gain, *stds = (result[key].value for key in ("dn_per_e", "read_std_dn", "row_std_dn"))
        lines.append(_sensor_line(f"{name}, measured", result.iso, gain, (*stds, span_dn)))
    for option in group_options("noise"):
        if "branches:" not in (conf_dir() / "noise" / f"{option}.yaml").read_text(encoding="utf-8"):
            continue  # two numbers, which may depend on the sensor
        noise = read_option("noise", option)
        span_dn = noise.white_level_dn - noise.black_level_dn
        for branch, iso in itertools.product(noise.branches, calibration.captures.isos):
            if branch.iso[0] <= iso <= branch.iso[1]:
                gain = evaluate(branch.dn_per_e, iso=iso)
                laws = (branch.read_std_dn, branch.row_std_dn)
                stds = [evaluate(law, iso=iso, gain=gain) for law in laws]
                lines.append(_sensor_line(option, iso, gain, (*stds, span_dn)))
    headings = ("sensor", "ISO", "DN per electron", "read noise (e)", "row noise (e)", "electrons at white")
    return PageTable(headings, lines, numeric=(1, 2, 3, 4, 5))


def _sensor_line(name: str, iso: float, gain: float, numbers_dn: Iterable[float]) -> tuple[str, ...]:
    electrons = (short_number(number / gain, 3) for number in numbers_dn)
    return name, f"{iso:g}", short_number(gain, 3), *electrons


# ------------------------------------------------------------------------------------------------------------- figures


def _drawn(result: IsoResult, sites: list[str]) -> bytes:
    """Draw the photon transfer curve with residuals, the histogram, spectra, and the map of the darks, of one ISO."""
    from matplotlib.figure import Figure

    figure, measured = Figure(figsize=(14, 8), layout="constrained"), result.dark.measured
    axes = figure.subplots(2, 3)
    _draw_transfer(axes[0, 0], axes[1, 0], result, sites)
    _draw_histogram(axes[0, 1], result)
    _draw_spectrum(axes[1, 1], "rows of a dark", measured.row_offsets.reshape(2, 2, -1).mean(axis=1))
    _draw_spectrum(axes[1, 2], "columns of the mean dark", measured.column_offsets.reshape(2, 2, -1).mean(axis=0))
    image = axes[0, 2].imshow(measured.shading - np.median(measured.shading), cmap="RdBu_r", aspect="auto")
    axes[0, 2].set(title="fixed pattern of the darks, block means (DN)", xticks=[], yticks=[])
    figure.colorbar(image, ax=axes[0, 2])
    return figure_png(figure, DPI)


def _draw_spectrum(axes: Axes, name: str, lines: Float) -> None:
    """Draw the power of offsets of even and odd lines, [2, N]."""
    offsets = lines.T.ravel()
    power = np.abs(np.fft.rfft(offsets - offsets.mean()))[1:-1] ** 2 / len(offsets)
    axes.loglog(np.arange(1, len(power) + 1) / len(offsets), power, linewidth=0.6, color=COLOURS[""])
    axes.set(title=f"spectrum of the {name}", xlabel="periods per line", ylabel="power (DN²)")


def _draw_transfer(curve_axes: Axes, residual_axes: Axes, result: IsoResult, sites: list[str]) -> None:
    """Draw variance against signal, and what the line with the gain of the sensor leaves."""
    gain = result["dn_per_e"].value
    for name, curve in zip(sites or ["", "", "", ""], result.curves, strict=True):
        line = gain * curve.signal
        style: dict[str, Any] = {"fmt": "o", "markersize": 3, "color": COLOURS[name], "linewidth": 0.8}
        error = NORMAL_95 * np.hypot(curve.error, curve.dark_error)
        curve_axes.errorbar(curve.signal, curve.variance, error, label=name or None, **style)
        residual_axes.errorbar(curve.signal, (curve.variance / line - 1) * 100, error / line * 100, **style)
    ends = np.array([0.0, usable(result.flats)[-1].signal_dn])
    curve_axes.plot(ends, gain * ends, color="#888888", linewidth=1)
    residual_axes.axhline(0, color="#888888", linewidth=1)
    curve_axes.set(title="photon transfer", xlabel="signal (DN)", ylabel="variance above the darks (DN²)")
    residual_axes.set(title="residuals", xlabel="signal (DN)", ylabel="variance against the line (%)")
    if sites:
        curve_axes.legend()


def _draw_histogram(axes: Axes, result: IsoResult) -> None:
    """Draw the histogram of the darks against both fitted distributions."""
    histogram, shape = result.histogram, result.shapes[0]
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


AGAINST_ISO = (
    ("dn_per_e", "DN per electron", 0, gain_law),
    ("read_std_dn", "read noise (DN)", 1, std_law),
    ("row_std_dn", "row noise (DN)", 1, std_law),
)
"""Numbers that are drawn against ISO: name, label, place of the axes, and function that fits a law."""


def _against_iso(calibration: Calibration) -> bytes:
    """Draw gain, read noise and row noise against ISO, with intervals and the laws of the profile."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    both, isos = figure.subplots(1, 2), calibration.captures.isos
    for place, (name, label, side, law) in enumerate(AGAINST_ISO):
        axes, numbers = both[side], [result[name] for result in calibration.isos]
        values = [number.value or math.nan for number in numbers]
        errors = [[number.value - number.low for number in numbers], [number.high - number.value for number in numbers]]
        axes.errorbar(isos, values, np.maximum(errors, 0), fmt="o", markersize=3, label=label, color=f"C{place}")
        for branch in iso_branches(calibration.isos):
            form = law([isos[index] for index in branch], [numbers[index] for index in branch])
            grid = np.geomspace(isos[branch[0]], isos[branch[-1]], 50)
            laws = [evaluate(form, iso=iso) or math.nan for iso in grid.tolist()]
            axes.plot(grid, laws, linewidth=0.8, color=f"C{place}")
        axes.set(xscale="log", yscale="log", xlabel="ISO")
        axes.legend()
    return figure_png(figure, DPI)
