"""Check captures before they are fitted: refuse what cannot be measured, and warn of what makes numbers doubtful."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from unprocess_gen.calibration.captures import Capture, Sensor
from unprocess_gen.calibration.frame_sums import Measured
from unprocess_gen.core.errors import ConfigError


class StatisticLimit(NamedTuple):
    """Limits of a statistic: from which value frames are doubtful, and refused; what it means, and what is expected."""

    doubtful: float
    refused: float
    meaning: str
    expected: str


LIMITS = {
    "light in darks": StatisticLimit(
        math.inf,
        0.05,
        "the mean is {value:.1%} of white away from black",
        "frames without light; correct kind, or black_level_dn in captures.csv",
    ),
    "clipped black": StatisticLimit(
        math.inf,
        0.005,
        "{value:.1%} of the values are the lowest that occurs: black is clipped, and a part of the noise is missing",
        "raw frames with an offset",
    ),
    "frames differ": StatisticLimit(
        math.inf,
        1.2,
        "the variances of the frames differ by a factor of {value:.2f}",
        "frames of one ISO and exposure; remove those of another",
    ),
    "missing codes": StatisticLimit(
        0.02,
        0.25,
        "{value:.0%} of the values within the noise never occur: the camera scales its values",
        "values of the converter, not scaled ones, or ones of fewer bits",
    ),
    "neighbours": StatisticLimit(
        0.025,  # real sensors reach 0.03 (EMVA 1288 reference set 001)
        0.08,
        "the noise of neighbouring sites has a correlation of {value:.3f}; a profile has none",
        "raw frames without noise reduction or sharpening; switch off long-exposure and high-ISO noise reduction",
    ),
    "flicker": StatisticLimit(
        0.005,
        0.02,
        "the mean differs by {value:.1%} between the frames",
        "one exposure in steady light; correct level and exposure_s, or use a lamp that does not flicker",
    ),
    "bands": StatisticLimit(
        0.002,
        0.01,
        "rows change by {value:.2%} from frame to frame: the lamp flickers",
        "steady light, or exposures of many periods of the mains",
    ),
    "vignetting": StatisticLimit(
        0.2,
        0.5,
        "the darkest sixteenth of the frame has {value:.0%} less light than the brightest",
        "even light; defocus, use a diffuser, or stop down",
    ),
}
"""Limits of the statistics of one measurement, by name."""
LEAST_DARK_STD_DN, LEAST_DARK_STD_8_BITS_DN = 0.4, 1.0
"""Least noise of darks without rounding, which hides the noise below; values of 8 bits are mostly rounding."""


def place(frames: Sequence[Capture]) -> str:
    """Return the name of a measurement for messages: its first frame, ISO and number of frames."""
    first = frames[0]
    light = f", level {first.level}" if first.level else ""
    return f"calibrate: {first.path} ({first.kind}, ISO {first.iso:g}{light}, {len(frames)} frames)"


def _check(frames: Sequence[Capture], values: dict[str, float], notes: list[str]) -> None:
    """Compare statistics with `LIMITS`: raise ConfigError, or add a note."""
    for name, value in values.items():
        limit = LIMITS[name]
        text = f"{place(frames)}: {limit.meaning.format(value=value)}"
        if value > limit.refused:
            raise ConfigError(f"{text}; expected {limit.expected}")
        if value > limit.doubtful:
            notes.append(text)


def check_dark(frames: Sequence[Capture], sensor: Sensor, dark: Measured, notes: list[str]) -> None:
    """Refuse darks that are clipped, contain light or differ; warn of doubtful ones."""
    variances = dark.frame_variances
    noise = 7 * math.sqrt(6 / dark.sites)  # of the ratio of two of them
    values = {
        "light in darks": abs(float(dark.mean_dn.mean()) - sensor.black_dn) / sensor.span_dn,
        "clipped black": clipped_share(dark),
        "frames differ": float(variances.max() / max(variances.min(), 1e-9)) - noise,
    }
    _check(frames, values | _pixel_statistics(dark), notes)


def is_clipped(dark: Measured) -> bool:
    """True if black is clipped."""
    return clipped_share(dark) > LIMITS["clipped black"].refused


def clipped_share(dark: Measured) -> float:
    """Return the share of the lowest value, 0 if the histogram falls to both sides alike."""
    shares = []
    for codes in dark.codes:
        used, peak = np.flatnonzero(codes), int(np.argmax(codes))
        is_skewed = int(used[-1]) - peak > 2 * (peak - int(used[0])) + 2
        shares.append(is_skewed * codes[used[0]] / float(codes.sum()))
    return float(max(shares))


def _pixel_statistics(measured: Measured) -> dict[str, float]:
    """Return the share of missing values, and the largest correlation of neighbours beyond its own noise."""
    noise = 6 / math.sqrt(4 * measured.sites) + 1 / min(measured.shape)
    correlation = max(map(abs, measured.correlation.values()))
    return {"missing codes": max(map(_gaps, measured.codes)), "neighbours": correlation - noise}


def _gaps(codes: np.ndarray) -> float:
    """Return the share of values among the middle 68 % that never occur; hot pixels are rarer, and far away."""
    total, below = float(codes.sum()), np.cumsum(codes)
    low, high = np.searchsorted(below, (0.16 * total, 0.84 * total))
    inner = codes[low : high + 1]
    return float(np.mean(inner == 0)) if len(inner) >= 4 and total > 100 * len(inner) else 0.0


def check_dark_noise(frames: Sequence[Capture], sensor: Sensor, std_dn: float) -> None:
    """Refuse data whose noise is too small against rounding."""
    least = LEAST_DARK_STD_8_BITS_DN if sensor.bits <= 8 else LEAST_DARK_STD_DN
    if std_dn < least:
        raise ConfigError(
            f"{place(frames)}: the noise without light is {std_dn:.3f} DN at {sensor.bits} bits; expected {least:g} "
            "DN or more: rounding hides it, and variances are no measure; record with more bits, or at a higher gain"
        )


def check_flat(frames: Sequence[Capture], sensor: Sensor, flat: Measured, dark: Measured, notes: list[str]) -> None:
    """Refuse flats whose light changes in time or over the frame; warn of doubtful ones."""
    signal, means = max(float(flat.mean_dn.mean() - dark.mean_dn.mean()), 1.0), flat.frame_means.mean(axis=1)
    jitter = 4 * math.sqrt(max(float(dark.frame_means.mean(axis=1).var(ddof=1)), flat.total.mean() / flat.sites / 4))
    darkest, brightest = (block - sensor.black_dn for block in flat.blocks)
    values = {
        "flicker": (float(np.ptp(means)) - jitter) / signal,
        "bands": math.sqrt(max(flat.row[0] - dark.row[0] - 5 * flat.row[1], 0.0)) / signal,
        "vignetting": 1 - darkest / brightest if brightest > 0 else 0.0,
    }
    _check(frames, values | _pixel_statistics(flat), notes)
