"""Check captures before they are fitted: refuse what cannot be measured, and warn of what makes numbers doubtful.

Statistics are scores, as in ``verify --noise``: a limit is exceeded if noise would exceed it with the probability of an
alarm. The limits themselves are what real sensors and lamps show, or what changes the estimates little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from unprocess_gen.calibration.captures import Capture, CaptureSet, place_of
from unprocess_gen.calibration.deviations import UNFORESEEN, Score, alarm_limit
from unprocess_gen.calibration.frame_sums import ROUNDING_DN2, Measurement
from unprocess_gen.core.errors import ConfigError


class Bounds(NamedTuple):
    """From which value of a statistic frames are doubtful, and refused; what it means, and what is expected."""

    doubtful: float
    refused: float
    meaning: str
    expected: str


LIMITS = {
    "light in darks": Bounds(
        *(math.inf, 0.05, "the mean is {:.1%} of white away from black"),
        "frames without light; correct kind, or black_level_dn in captures.csv",
    ),
    "clipped black": Bounds(
        *(math.inf, 0.005, "{:.1%} of the values are the lowest that occurs: black is clipped, and noise is missing"),
        "raw frames with an offset",
    ),
    "frames differ": Bounds(
        *(math.inf, 1.2, "the variances of the frames differ by a factor of {:.2f}"),
        "frames of one ISO and exposure; remove those of another",
    ),
    "missing codes": Bounds(
        *(0.02, 0.25, "{:.0%} of the values within the noise never occur: the camera scales its values"),
        "values of the converter, not scaled ones, or ones of fewer bits",
    ),
    "neighbours": Bounds(  # real sensors reach 0.03 (EMVA 1288 reference set 001)
        *(0.025, 0.08, "the noise of neighbouring sites has a correlation of {:.3f}; a profile has none"),
        "raw frames without noise reduction or sharpening; switch off long-exposure and high-ISO noise reduction",
    ),
    "flicker": Bounds(
        *(0.005, 0.02, "the mean differs by {:.1%} between the frames"),
        "one exposure in steady light; correct level and exposure_s, or use a lamp that does not flicker",
    ),
    "bands": Bounds(
        *(0.002, 0.01, "rows change by {:.2%} from frame to frame: the lamp flickers"),
        "steady light, or exposures of many periods of the mains",
    ),
    "vignetting": Bounds(
        *(0.2, 0.5, "the darkest sixteenth of the frame has {:.0%} less light than the brightest"),
        "even light; defocus, use a diffuser, or stop down",
    ),
}
"""Limits of the statistics of one measurement, by name."""
ALARM = alarm_limit(100 * len(LIMITS))
"""Surprise beyond which a limit is exceeded, for up to a hundred measurements."""
LEAST_DARK_STD_DN, LEAST_DARK_STD_8_BITS_DN = 0.35, 1.0
"""Least noise of darks without rounding, which hides the noise below; values of 8 bits are mostly rounding."""
LEAST_OF_CODE = 100
"""Mean number of values from which none is hardly by chance."""


def _exceeds(score: Score, limit: float) -> bool:
    return limit < math.inf and score._replace(low=-limit, high=limit).surprise > ALARM


def _check(captures: CaptureSet, frames: Sequence[Capture], scores: dict[str, Score]) -> None:
    """Compare statistics with `LIMITS`: raise ConfigError, or add a note."""
    for name, score in scores.items():
        doubtful, refused, meaning, expected = LIMITS[name]
        text = f"{place_of(frames)}: {meaning.format(score.total)}"
        if _exceeds(score, refused):
            raise ConfigError(f"{text}; expected {expected}")
        if _exceeds(score, doubtful):
            captures.notes.append(text)


def check_dark(captures: CaptureSet, frames: Sequence[Capture], dark: Measurement) -> None:
    """Refuse darks that are clipped, contain light or differ; warn of doubtful ones."""
    sensor = captures.sensor
    std_dn = math.sqrt(max(float((dark.variance + dark.dsnu).mean()) - ROUNDING_DN2, 0.0))  # both are dither
    least = LEAST_DARK_STD_8_BITS_DN if sensor.bits <= 8 else LEAST_DARK_STD_DN
    if std_dn < least:
        raise ConfigError(
            f"{place_of(frames)}: the noise without light is {std_dn:.3f} DN at {sensor.bits} bits; expected {least:g} "
            "DN or more: rounding hides it, and variances are no measure; record with more bits, or at a higher gain"
        )
    variances, mean_variance = dark.frame_variances, float(dark.variance.mean()) / dark.sites
    light = abs(float(dark.mean_dn.mean()) - sensor.black_dn) / sensor.span_dn
    # a variance has half as many differences as a plane has sites, and neighbouring ones share a site
    ratio = Score(float(variances.max() / max(variances.min(), 1e-9)), 1.0, 12 / dark.sites)
    scores = {
        "light in darks": Score(light, 1.0, mean_variance / sensor.span_dn**2),
        "clipped black": clipped_black(dark),
        "frames differ": ratio,
    }
    _check(captures, frames, scores | _pixel_scores(dark))


def is_clipped(dark: Measurement) -> bool:
    """True if black is clipped."""
    return _exceeds(clipped_black(dark), LIMITS["clipped black"].refused)


def clipped_black(dark: Measurement) -> Score:
    """Score the share of the lowest value, 0 if the histogram falls to both sides alike."""
    shares = []
    for codes in dark.codes:
        used, peak = np.flatnonzero(codes), int(np.argmax(codes))
        is_skewed = int(used[-1]) - peak > 2 * (peak - int(used[0])) + 2
        shares.append(is_skewed * codes[used[0]] / float(codes.sum()))
    return Score(float(max(shares)), 1.0, float(max(shares)) / dark.sites / dark.count)


def _pixel_scores(measured: Measurement) -> dict[str, Score]:
    """Score missing values, and the correlation of neighbours, which subtracted means of lines change by 1/length."""
    correlation = measured.correlation
    moved = min(abs(correlation.total), 1 / min(measured.shape))
    correlation = correlation._replace(total=correlation.total - math.copysign(moved, correlation.total))
    return {"missing codes": max(map(_missing_codes, measured.codes)), "neighbours": correlation}


def _missing_codes(codes: np.ndarray) -> Score:
    """Score the share of values among the middle 68 % that never occur; hot pixels are rarer, and far away."""
    total, below = float(codes.sum()), np.cumsum(codes)
    low, high = np.searchsorted(below, (0.16 * total, 0.84 * total))
    inner = codes[low : high + 1]
    if len(inner) < 4 or total < LEAST_OF_CODE * len(inner):
        return Score(0.0, 1.0, 0.0)
    # a value that is expected n times is missing with the probability exp(-n)
    step = 3 / LEAST_OF_CODE / len(inner)
    return Score(float(np.mean(inner == 0)), 1.0, UNFORESEEN / len(inner), step=step)


def check_flat(captures: CaptureSet, frames: Sequence[Capture], flat: Measurement, dark: Measurement) -> None:
    """Refuse flats whose light changes in time or over the frame; warn of doubtful ones."""
    signal = max(float(flat.mean_dn.mean() - dark.mean_dn.mean()), 1.0)
    noise = float(flat.variance.mean()) / flat.sites / signal**2  # of the mean of a plane
    drift = float(dark.frame_means.mean(axis=1).var(ddof=1)) / signal**2
    rows = max(flat.row[0] - dark.row[0], 0.0) / signal**2
    bands, blocks = math.sqrt(rows), flat.shading - captures.sensor.black_dn
    scores = {
        "flicker": Score(float(np.ptp(flat.frame_means.mean(axis=1))) / signal, 1.0, 2 * max(drift, noise / 4)),
        "bands": Score(bands, 1.0, (flat.row[1] / signal**2 / 2 / bands) ** 2 if rows else 0.0),
        "vignetting": Score(1 - float(blocks.min() / max(blocks.max(), 1.0)), 1.0, 8 * noise / flat.count),
    }
    _check(captures, frames, scores | _pixel_scores(flat))
