"""Draw what was measured on captures, and write it as an HTML page next to the noise profile."""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

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
from unprocess_gen.planning.noise_profile import evaluate
from unprocess_gen.reports.formatting import short_number
from unprocess_gen.reports.html_pages import PageTable, data_uri, render_page
from unprocess_gen.reports.report_files import require_libraries

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"R": "#c0392b", "Gr": "#27ae60", "Gb": "#145a32", "B": "#2c6fbb", "": "#444444"}


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
    lines = [
        (
            name,
            "" if iso is None else f"{iso:g}",
            *(["–"] * 3 if number is None else [short_number(getattr(number, end), 4) for end in ENDS]),
            unit,
        )
        for name, iso, site, number, unit in named
        if site is None
    ]
    return PageTable(("number", "ISO", "value", "from", "to", "unit"), lines, numeric=(1, 2, 3, 4))


def _sensors(calibration: Calibration, name: str) -> PageTable:
    """Return gain and read noise of this sensor and of the built-in profiles, in electrons."""
    lines = []
    for result in calibration.isos:
        gain = result.gain.sensor.value
        electrons = [short_number(value / gain, 3) for value in (result.read.value, result.row.value)]
        full = short_number(calibration.sensor.span_dn / gain, 3)
        lines.append((f"{name}, measured", f"{result.iso:g}", short_number(gain, 3), *electrons, full))
    isos = {result.iso for result in calibration.isos}
    for option in group_options("noise"):
        if "branches:" not in (conf_dir() / "noise" / f"{option}.yaml").read_text(encoding="utf-8"):
            continue  # two numbers, which may depend on the sensor
        noise = read_option("noise", option)
        span = noise.white_level_dn - noise.black_level_dn
        for branch in noise.branches:
            for iso in sorted(iso for iso in isos if branch.iso[0] <= iso <= branch.iso[1]):
                gain = evaluate(branch.dn_per_e, iso=iso)
                stds = (evaluate(getattr(branch, key), iso=iso, gain=gain) for key in ("read_std_dn", "row_std_dn"))
                electrons = [short_number(std / gain, 3) for std in stds]
                lines.append((option, f"{iso:g}", short_number(gain, 3), *electrons, short_number(span / gain, 3)))
    headings = ("sensor", "ISO", "DN per electron", "read noise (e)", "row noise (e)", "electrons at white")
    return PageTable(headings, lines, numeric=(1, 2, 3, 4, 5))


# ------------------------------------------------------------------------------------------------------------- figures


def _png(figure: Figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=90)
    return file.getvalue()


def _drawn(result: IsoResult, sites: list[str]) -> bytes:
    """Draw the photon transfer curve with residuals, the histogram, spectra, and the map of the darks, of one ISO."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(14, 8), layout="constrained")
    axes = figure.subplots(2, 3)
    _draw_transfer(axes[0, 0], axes[1, 0], result, sites)
    _draw_histogram(axes[0, 1], result)
    for axis, profile, kind in (
        (axes[1, 1], result.dark.measured.row_profile, "rows of a dark"),
        (axes[1, 2], result.dark.measured.column_profile, "columns of the mean dark"),
    ):
        power = np.abs(np.fft.rfft(profile - profile.mean()))[1:-1] ** 2 / len(profile)
        axis.loglog(np.arange(1, len(power) + 1) / len(profile), power, linewidth=0.6, color=COLOURS[""])
        axis.set(title=f"spectrum of the {kind}", xlabel="periods per line", ylabel="power (DN²)")
    shading = result.dark.shading
    image = axes[0, 2].imshow(shading - np.median(shading), cmap="RdBu_r")
    axes[0, 2].set(title="fixed pattern of the darks, block means (DN)", xticks=[], yticks=[])
    figure.colorbar(image, ax=axes[0, 2])
    return _png(figure)


def _draw_transfer(curve_axes: Axes, residual_axes: Axes, result: IsoResult, sites: list[str]) -> None:
    """Draw variance against signal, and what the line with the gain of the sensor leaves."""
    gain = result.gain.sensor.value
    for name, curve in zip(sites or ["", "", "", ""], result.curves, strict=True):
        curve_axes.plot(curve.signal, curve.variance, "o", markersize=3, color=COLOURS[name], label=name or None)
        error = 1.96 * np.hypot(curve.error, curve.dark_error) / (gain * curve.signal) * 100
        rest = (curve.variance / (gain * curve.signal) - 1) * 100
        residual_axes.errorbar(curve.signal, rest, error, fmt="o", markersize=3, color=COLOURS[name], linewidth=0.8)
    ends = np.array([0.0, usable(result.flats)[-1].signal_dn])
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
    for label, std, power in (("normal", shape.normal_std_dn, None), ("Tukey, λ", shape.tukey_std_dn, shape.shape)):
        likelihoods = probabilities(histogram.centres, std, power)
        label += "" if power is None else f" {power:.3f}"
        axes.semilogy(histogram.centres, np.maximum(likelihoods, 1e-9), linewidth=1, label=label)
    axes.set(title="read noise", xlabel="DN from the mean of the row", ylabel="share", ylim=(1e-8, 1))
    axes.legend()


def _against_iso(calibration: Calibration) -> bytes:
    """Draw gain, read noise and row noise against ISO, with intervals and the laws of the profile."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 4), layout="constrained")
    left, right = figure.subplots(1, 2)
    isos = [result.iso for result in calibration.isos]
    for place, (axes, label, law, numbers) in enumerate(
        (
            (left, "DN per electron", gain_law, [result.gain.sensor for result in calibration.isos]),
            (right, "read noise (DN)", std_law, [result.read for result in calibration.isos]),
            (right, "row noise (DN)", std_law, [result.row for result in calibration.isos]),
        )
    ):
        values = [number.value or math.nan for number in numbers]
        errors = [[number.value - number.low for number in numbers], [number.high - number.value for number in numbers]]
        axes.errorbar(isos, values, np.maximum(errors, 0), fmt="o", markersize=3, label=label, color=f"C{place}")
        for branch in iso_branches(calibration.isos):
            form = law([isos[index] for index in branch], [numbers[index] for index in branch])
            grid = np.geomspace(isos[branch[0]], isos[branch[-1]], 50)
            laws = [evaluate(form, iso=iso) or math.nan for iso in grid.tolist()]
            axes.plot(grid, laws, linewidth=0.8, color=f"C{place}")
    for axes in (left, right):
        axes.set(xscale="log", yscale="log", xlabel="ISO")
        axes.legend()
    return _png(figure)
