"""Measure all that the captures of one ISO show: darks, flats, and the noise that follows from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from unprocess_gen.calibration.capture_checks import check_dark, check_flat, is_clipped
from unprocess_gen.calibration.captures import LEAST_FRAMES, Capture, CaptureSet, Sensor, place_of
from unprocess_gen.calibration.frame_sums import (
    INNER,
    NONE_KNOWN,
    ROUNDING_DN2,
    SMOOTH,
    WINDOW,
    FrameSums,
    Measurement,
    find_pattern,
)
from unprocess_gen.calibration.gain import (
    LEAST_LEVELS,
    RANGES,
    Estimate,
    Transfer,
    estimate,
    fit_gain,
    gain_change,
    root_estimate,
    weighted_mean,
)
from unprocess_gen.calibration.planes import planes_of
from unprocess_gen.calibration.shape import Histogram, ReadShape, fill_histogram, fit_shape
from unprocess_gen.core.arrays import Bool, Float
from unprocess_gen.core.errors import ConfigError

Watch = Callable[[Iterable[Capture]], Iterable[Capture]]
"""Function that passes frames on while they are read, and shows progress."""

NOTED_SHARE = 1e-3
"""Share of hot and dead sites from which it is noted."""
FULL_SHARE = 1e-4
"""Largest share of values at white in a level that is fitted."""
ROUNDED_STD_DN = 0.7
"""Noise below which variances are taken from the fitted distribution, because rounding distorts them."""
STILL_RISING = 0.9
"""Least variance of brighter levels that are not saturated, relative to the largest."""


@dataclass(frozen=True, slots=True)
class Dark:
    """Darks of one exposure: frames, noise, and the values of their fixed pattern above a threshold, in DN."""

    frames: list[Capture]
    measured: Measurement
    hot_dn: Float
    hot_threshold_dn: float

    @property
    def exposure_s(self) -> float:
        """Exposure time; 0 if it is not stated."""
        return self.frames[0].exposure_s or 0.0


@dataclass(frozen=True, slots=True)
class Flat:
    """Flats of one level: frames, noise, the darks of the nearest exposure, and True if values reach white.

    ``signals_dn`` are the means of the planes minus the means of the darks; light is rarely neutral in raw values.
    """

    frames: list[Capture]
    measured: Measurement
    dark: Dark
    is_full: bool
    signals_dn: Float

    @property
    def signal_dn(self) -> float:
        """Mean signal of the planes."""
        return float(self.signals_dn.mean())


@dataclass(frozen=True, slots=True)
class IsoResult:
    """Measurement noise of one ISO.

    ``numbers`` are the estimates by name: of the sensor, then of each plane of `TILE` if planes may differ. ``dark``
    are the darks from which read noise and offsets are measured. ``prnu_square`` is the square of the PRNU, and its
    standard error.
    """

    iso: float
    numbers: dict[str, list[Estimate]]
    curves: list[Transfer]
    darks: list[Dark]
    dark: Dark
    levels: list[Flat]
    shape: ReadShape
    histogram: Histogram
    prnu_square: tuple[float, float] | None

    def __getitem__(self, name: str) -> Estimate:
        """An estimate of the sensor."""
        return self.numbers[name][0]


def measure_iso(captures: CaptureSet, iso: float, watch: Watch, gain: Estimate | None = None) -> IsoResult:
    """Measure the captures of one ISO, or darks alone if the ``gain`` is given; ConfigError if a check fails."""
    sensor, (darks, defects) = captures.sensor, _darks(captures, iso, watch)
    dark = max(darks, key=lambda dark: dark.measured.count)
    levels = [] if gain else _levels(iso, _flats(captures, iso, darks, defects, watch), sensor)
    histogram = fill_histogram((frame.pixels() for frame in watch(dark.frames)), dark.measured, defects)
    shape = fit_shape(histogram)
    curves = _curves(levels, shape) if levels else []
    if curves and (change := gain_change(curves, float(dark.measured.variance.mean()))).low * change.high > 0:
        value, low, high = (f"{share:+.1%}" for share in (change.value, change.low, change.high))
        captures.notes.append(f"calibrate: ISO {iso:g}: the gain differs by {value} ({low} to {high}) in bright flats")
    gains = [gain] if gain else fit_gain(curves, sensor.span_dn)
    return IsoResult(
        iso=iso,
        numbers={"dn_per_e": gains} | _dark_numbers(dark.measured, sensor, shape),
        curves=curves,
        darks=darks,
        dark=dark,
        levels=levels,
        shape=shape,
        histogram=histogram,
        prnu_square=_prnu_square(captures, levels, defects, watch) if levels else None,
    )


def _darks(captures: CaptureSet, iso: float, watch: Watch) -> tuple[list[Dark], Bool]:
    """Measure the darks of one ISO, in ascending order of exposures, and find defects [4, H, W]; refuse no darks."""
    darks, defects = list[Dark](), NONE_KNOWN
    for frames in captures.groups("dark", iso):
        sums = _summed(frames, captures.sensor, watch)
        measured = sums.measure()
        if darks and is_clipped(measured):  # by the dark current of a long exposure
            captures.notes.append(f"{place_of(frames)}: black is clipped by the dark current; left out")
            continue
        check_dark(captures, frames, measured)
        threshold = max(pattern.limit for pattern in sums.patterns)
        strengths = (np.array([pattern.deviation for pattern in sums.patterns]) * sums.defects)[:, *INNER]
        darks.append(Dark(frames, measured, strengths[strengths > threshold], threshold / SMOOTH))
        defects = defects | sums.defects
    if not darks:
        raise ConfigError(f"calibrate: ISO {iso:g} has fewer than {LEAST_FRAMES} darks of one exposure; record them")
    if (share := float(defects.mean())) > NOTED_SHARE:
        captures.notes.append(f"calibrate: ISO {iso:g}: {share:.2%} of sites are hot or dead; left out elsewhere")
    return darks, defects


def _summed(frames: Sequence[Capture], sensor: Sensor, watch: Watch) -> FrameSums:
    """Sum frames; ConfigError names one of another size."""
    sums = FrameSums()
    for frame in watch(frames):
        mosaic = frame.pixels()
        if mosaic.shape != sensor.shape or int(mosaic.max()) >= 2**sensor.bits:
            (height, width), (rows, columns) = mosaic.shape, sensor.shape
            problem = f"has {width} x {height} values up to {mosaic.max()} DN"
            expected = f"expected {columns} x {rows}, as the first frame has, and {sensor.bits} bits"
            raise ConfigError(f"calibrate: {frame.path}: {problem}; {expected}; remove it, or correct bits")
        sums.add(mosaic)
    return sums


def _flats(captures: CaptureSet, iso: float, darks: Sequence[Dark], defects: Bool, watch: Watch) -> list[Flat]:
    """Measure the levels that are not saturated, in ascending order."""
    sensor, flats = captures.sensor, []
    for frames in captures.groups("flat", iso):
        sums = _summed(frames, sensor, watch)
        measured = sums.measure(defects)
        seconds = frames[0].exposure_s or 0.0
        dark = min(darks, key=lambda dark: abs(dark.exposure_s - seconds))
        signals = measured.mean_dn - dark.measured.mean_dn
        full_share = float(measured.codes[:, int(sensor.white_dn) :].sum() / measured.codes.sum())
        if full_share > FULL_SHARE:
            captures.notes.append(f"{place_of(frames)}: {full_share:.2%} of the values are at white; left out of fits")
        else:
            check_flat(captures, frames, measured, dark.measured)
        flats.append(Flat(frames, measured, dark, full_share > FULL_SHARE, signals))
    return sorted(flats, key=lambda flat: flat.signal_dn)


def _levels(iso: float, flats: Sequence[Flat], sensor: Sensor) -> list[Flat]:
    """The levels below saturation: not at white, and no plane beyond its largest variance; refuse too few."""
    below = [flat for flat in flats if not flat.is_full]
    variances = np.array([flat.measured.variance for flat in below]).reshape(-1, 4)
    is_rising = variances > variances.max(axis=0, initial=0) * STILL_RISING
    is_rising |= np.arange(len(below))[:, None] <= np.argmax(np.vstack([variances, np.zeros(4)]), axis=0)
    levels = [flat for flat, is_below in zip(below, is_rising.all(axis=1), strict=True) if is_below]
    darkest = min((flat.signal_dn / sensor.span_dn for flat in levels), default=0.0)
    if len(levels) < LEAST_LEVELS:
        problem = f"has {len(levels)} levels of {LEAST_FRAMES} flats that are not saturated; expected {LEAST_LEVELS}"
    elif darkest <= 0:
        problem = "has flats that are not brighter than the darks; correct kind"
    elif darkest > RANGES[0]:
        problem = f"has a darkest level of {darkest:.0%} of white; expected one below {RANGES[0]:.0%}"
    else:
        return levels
    raise ConfigError(f"calibrate: ISO {iso:g} {problem}")


# --------------------------------------------------------------------------------------------------------------- noise


def _variances(measured: Measurement, shape: ReadShape) -> tuple[Float, Float]:
    """Variance of a site without rounding, and its error; from the fitted distribution where rounding distorts it."""
    variances, errors = measured.variance - ROUNDING_DN2, np.hypot(measured.error, measured.fixed_error)
    is_weak = variances <= ROUNDED_STD_DN**2
    return np.where(is_weak, shape.std_dn**2, variances), np.where(is_weak, errors, measured.error)


def _curves(flats: Sequence[Flat], shape: ReadShape) -> list[Transfer]:
    """The photon transfer curve of each plane."""
    dark_variances, dark_errors = zip(*(_variances(flat.dark.measured, shape) for flat in flats), strict=True)
    variances = np.array([flat.measured.variance - ROUNDING_DN2 for flat in flats]) - dark_variances
    signals, errors = [flat.signals_dn for flat in flats], [flat.measured.error for flat in flats]
    darks = np.array([id(flat.dark) for flat in flats])
    by_plane = np.array([signals, variances, errors, dark_errors]).transpose(2, 0, 1)
    return [Transfer(signal, variance, error, dark, darks) for signal, variance, error, dark in by_plane]


def _dark_numbers(measured: Measurement, sensor: Sensor, shape: ReadShape) -> dict[str, list[Estimate]]:
    """The estimates that darks give."""
    columns, fixed_column = measured.column, measured.fixed_column
    temporal = columns[0] if columns[0] > 3 * columns[1] else 0.0
    variances, errors = _variances(measured, shape)
    variances, errors = variances - temporal, np.hypot(errors, columns[1] if temporal else 0.0)
    row, (correlation, error) = root_estimate(*measured.row), measured.row_correlation
    dsnu_errors = np.linalg.norm(measured.fixed_error) / 4, measured.hidden.mean(), fixed_column[1]
    return {
        "read_std_dn": [
            root_estimate(float(variances.mean()), float(np.linalg.norm(errors)) / 4),
            *map(root_estimate, variances.tolist(), errors.tolist()),
        ],
        "read_shape": [shape.interval],
        "row_std_dn": [row],
        "row_correlation": [estimate(correlation, error) if row.value else estimate(0.0, 1.0)],
        "column_std_dn": [root_estimate(*fixed_column)],
        "column_temporal_std_dn": [root_estimate(*columns)],
        "dsnu_std_dn": [root_estimate(float(measured.dsnu.mean()), math.hypot(*dsnu_errors))],
        "black_error_dn": [
            estimate(float(mean) - sensor.black_dn, float(error))
            for mean, error in zip(_with_mean(measured.mean_dn), _black_errors(measured, variances), strict=True)
        ],
    }


def _with_mean(planes: Float) -> Float:
    """Mean of the numbers of the planes, and these numbers."""
    return np.append(planes.mean(axis=-1, keepdims=True), planes, axis=-1)


def _black_errors(measured: Measurement, variances: Float) -> Float:
    """Standard errors of the black of all planes, and of each; two planes share the offset of a line."""
    height, width = np.outer(measured.shape, [2, 1, 1, 1, 1])
    sites = np.array([4, 1, 1, 1, 1]) * measured.sites
    drift = _with_mean(measured.frame_means).var(axis=0, ddof=1) / measured.count
    per_line = max(measured.fixed_column[0], 0.0) / width + max(measured.fixed.mean(), 0.0) / sites
    own = (_with_mean(measured.variance) / sites + max(measured.row[0], 0.0) / height) / measured.count
    ripple = math.exp(-2 * math.pi**2 * float(variances.mean())) / math.pi
    drifts = drift > own * (1 + 4 * math.sqrt(2 / (measured.count - 1)))  # the black level changes between frames
    return np.asarray(np.sqrt(np.where(drifts, drift, own) + per_line + ripple**2))


def _prnu_square(captures: CaptureSet, flats: Sequence[Flat], defects: Bool, watch: Watch) -> tuple[float, float]:
    """Square of the PRNU, and its standard error, from the mean of all frames of all levels minus their darks.

    Frames have the weight signal/variance, which gives the mean of frame/signal the least noise. The variance of its
    fixed pattern contains the temporal noise.
    """
    weights = np.array([flat.measured.count * flat.signal_dn / flat.measured.variance.mean() for flat in flats])
    groups: list[tuple[Flat | Dark, float]] = list(zip(flats, weights, strict=True))
    for dark in {id(flat.dark): flat.dark for flat in flats}.values():
        groups.append((dark, -float(weights @ [flat.dark is dark for flat in flats])))
    total = np.zeros(1)
    for group, weight in groups:
        for frame in watch(group.frames):
            total = total + np.float32(weight / group.measured.count) * frame.pixels()
    scales = weights @ [flat.signals_dn for flat in flats]
    shares = np.array([weight**2 / group.measured.count for group, weight in groups])
    rows = shares @ [max(group.measured.row[0], 0.0) for group, _ in groups] / scales**2 * (1 - 1 / WINDOW)
    noise = shares @ [group.measured.variance for group, _ in groups] / scales**2
    patterns = [find_pattern(*both) for both in zip(planes_of(total) / scales[:, None, None], defects, strict=True)]
    others = [pattern.deviation[INNER][~pattern.is_far[INNER]] for pattern in patterns]
    spread, sites = np.transpose([(values.var(), values.size) for values in others])
    degrees = sum(flat.measured.count - 1 for flat in flats)
    errors = np.sqrt(2 / sites) * np.hypot(spread, noise / math.sqrt(degrees))
    square, error = weighted_mean((spread - rows) / SMOOTH - noise, errors)
    hidden, hot = (float(np.mean([getattr(pattern, name) for pattern in patterns])) for name in ("hidden", "hot"))
    if hot > NOTED_SHARE:
        place = place_of(flats[-1].frames)
        captures.notes.append(f"{place}: {hot:.2%} of the sites are hot in flats alone; record darks of this exposure")
    return square - hidden, math.hypot(error, hidden)
