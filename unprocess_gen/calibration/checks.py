"""Check captures before they are fitted: refuse what cannot be measured, and warn of what makes numbers doubtful."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from unprocess_gen.calibration.captures import Capture, Sensor
from unprocess_gen.calibration.frame_sums import Measured
from unprocess_gen.core.errors import ConfigError

LEAST_DARK_STD_DN = 0.4
"""Least noise of darks without rounding: below it, the variance of rounded values is no measure of the noise."""
LEAST_DARK_STD_8_BITS_DN = 1.0
"""The same for 8 bits, whose curve is mostly rounding."""
CLIPPED_SHARE = 0.005
GAPS_REFUSED, GAPS_DOUBTFUL = 0.25, 0.02
"""Shares of values that never occur within the noise of a frame."""
SMOOTHED_REFUSED, SMOOTHED_DOUBTFUL = 0.08, 0.025
"""Correlations of neighbouring sites; real sensors reach 0.03 (EMVA 1288 reference set 001)."""
CHANGE_REFUSED, CHANGE_DOUBTFUL = 0.02, 0.005
"""Relative changes of the light between frames of a level."""
BANDS_REFUSED, BANDS_DOUBTFUL = 0.01, 0.002
"""Standard deviations of bands of rows, relative to the light."""
BLOCKS_REFUSED, BLOCKS_DOUBTFUL = 0.5, 0.8
"""Least light of a sixteenth of the frame over the largest."""
NOISE_CHANGE = 1.2
"""Largest ratio of the variances of darks of one ISO and exposure."""
BRIGHTEST_DARK = 0.05
"""Largest mean of darks above black, as a fraction of white above black."""


def place(frames: Sequence[Capture]) -> str:
    """Return the name of a measurement for messages: its first frame, ISO and number of frames."""
    first = frames[0]
    light = f", level {first.level}" if first.level else ""
    return f"calibrate: {first.path} ({first.kind}, ISO {first.iso:g}{light}, {len(frames)} frames)"


def check_dark(frames: Sequence[Capture], sensor: Sensor, dark: Measured, notes: list[str]) -> None:
    """Refuse darks that are clipped, contain light or differ; warn of doubtful ones."""
    start = place(frames)
    if abs(float(dark.mean_dn.mean()) - sensor.black_dn) > BRIGHTEST_DARK * sensor.span_dn:
        raise ConfigError(
            f"{start}: the mean is {dark.mean_dn.mean():.1f} DN, and black is {sensor.black_dn:g} DN; expected frames "
            "without light; correct kind, or black_level_dn in captures.csv"
        )
    clipped = clipped_share(dark)
    if clipped > CLIPPED_SHARE:
        raise ConfigError(
            f"{start}: {clipped:.1%} of the values are the lowest that occurs: black is clipped, and a part of the "
            "noise is missing; expected raw frames with an offset"
        )
    variances = dark.frame_variances
    if variances.max() > NOISE_CHANGE * variances.min():
        factor = math.sqrt(variances.max() / variances.min())
        raise ConfigError(
            f"{start}: the noise of the frames differs by a factor of {factor:.2f};"
            " expected frames of one ISO and exposure; remove those of another"
        )
    check_pixels(frames, dark, notes)


def clipped_share(dark: Measured) -> float:
    """Return the share of the lowest value, 0 if the histogram falls to both sides alike."""
    shares = []
    for codes in dark.codes:
        used, peak = np.flatnonzero(codes), int(np.argmax(codes))
        is_skewed = int(used[-1]) - peak > 2 * (peak - int(used[0])) + 2
        shares.append(is_skewed * codes[used[0]] / float(codes.sum()))
    return float(max(shares))


def check_pixels(frames: Sequence[Capture], measured: Measured, notes: list[str]) -> None:
    """Refuse frames whose values have gaps or whose neighbours are correlated; warn of doubtful ones."""
    start, gaps = place(frames), max(map(_gaps, measured.codes))
    if gaps > GAPS_REFUSED:
        raise ConfigError(
            f"{start}: {gaps:.0%} of the values within the noise never occur; expected values of the "
            "converter, not scaled ones, or ones of fewer bits"
        )
    if gaps > GAPS_DOUBTFUL:
        notes.append(f"{start}: {gaps:.0%} of the values within the noise never occur; the camera scales its values")
    name, correlation = max(measured.correlation.items(), key=lambda item: abs(item[1]))
    noise = 6 / math.sqrt(4 * measured.sites) + 1 / min(measured.shape)
    if abs(correlation) > SMOOTHED_REFUSED + noise:
        raise ConfigError(
            f"{start}: the noise of {name} has a correlation of {correlation:.2f}; expected raw frames without noise "
            "reduction or sharpening; switch off long-exposure and high-ISO noise reduction"
        )
    if abs(correlation) > SMOOTHED_DOUBTFUL + noise:
        notes.append(f"{start}: the noise of {name} has a correlation of {correlation:.3f}; the profile has none")


def _gaps(codes: np.ndarray) -> float:
    """Return the share of values within a standard deviation of the mean that never occur."""
    total, values = float(codes.sum()), np.arange(len(codes))
    mean = float(codes @ values) / total
    std = math.sqrt(max(float(codes @ (values - mean) ** 2) / total, 0.0))
    inner = codes[max(math.ceil(mean - std), 0) : math.floor(mean + std) + 1]
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
    start = place(frames)
    signal = float(flat.mean_dn.mean() - dark.mean_dn.mean())
    means = flat.frame_means.mean(axis=1)
    jitter = 4 * math.sqrt(max(float(dark.frame_means.mean(axis=1).var(ddof=1)), flat.total.mean() / flat.sites / 4))
    change = (float(np.ptp(means)) - jitter) / max(signal, 1.0)
    if change > CHANGE_REFUSED:
        raise ConfigError(
            f"{start}: the mean differs by {np.ptp(means) / max(signal, 1.0):.1%} between the frames; expected one "
            "exposure in steady light; correct level and exposure_s, or use a lamp that does not flicker"
        )
    if change > CHANGE_DOUBTFUL:
        notes.append(f"{start}: the light changes by {change:.1%} between the frames")
    bands = flat.row[0] - dark.row[0] - 5 * flat.row[1]
    share = math.sqrt(max(bands, 0.0)) / max(signal, 1.0)
    if share > BANDS_REFUSED:
        raise ConfigError(
            f"{start}: rows change by {share:.1%} from frame to frame: the lamp flickers; expected steady light, or "
            "exposures of many periods of the mains"
        )
    if share > BANDS_DOUBTFUL:
        notes.append(f"{start}: rows change by {share:.2%} from frame to frame: the lamp flickers")
    darkest, brightest = (block - sensor.black_dn for block in flat.blocks)
    if darkest < BLOCKS_REFUSED * brightest:
        raise ConfigError(
            f"{start}: the darkest sixteenth of the frame has {darkest / brightest:.0%} of the light of the brightest; "
            "expected even light; defocus, use a diffuser, or stop down"
        )
    if darkest < BLOCKS_DOUBTFUL * brightest:
        notes.append(f"{start}: the darkest sixteenth of the frame has {darkest / brightest:.0%} of the brightest")
    check_pixels(frames, flat, notes)
